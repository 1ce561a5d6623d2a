"""Branch and bound: the largest value over a region, from below and from above."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iksamples.arm.chain import SerialChain
from iksamples.arm.target import Target
from iksamples.certify.compared import Measure
from iksamples.certify.enclosure import corners
from iksamples.certify.residual import ErrorOverBoxes
from iksamples.certify.table import Table
from iksamples.network import StackedMLP
from iksamples.region import Region


Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_BATCH = 1024
"""Boxes bounded in one round, or a quarter of those that wait where that is more."""
_FILL = 96
"""While fewer boxes than this are left, each is split along several axes at once."""
_STARTS, _STEPS = 8, 12
"""Points that a large round improves, and steps of each."""
_FINE = 1e-6
"""Rounding that no tolerance is too fine for, in the objective's unit."""
_NO_BOUND = float(np.finfo(float).max)
_SMALLEST = 2.0**-48
"""Edges, as a share of the region's, are not halved below this; they stay exact in float64."""
_MOST_BOXES = 1_000_000
_WORK, _OVERHEAD = 2.5e9, 1000
"""Of a search without limits, in weights: what it may come to, and what a box costs beside the
network's own. That is a minute, more or less (2 cores of 2026); counted, so that no number depends
on what else runs."""


@dataclass(frozen=True, eq=False)
class Leaves:
    """The boxes that a search ended with; together they tile the region.

    Attributes:
        part: The box of the region that each is a part of, shape (n,).
        lower: Lower corners as shares of that box's edges, exact binary fractions, (n, d).
        upper: Upper corners, likewise.
        bound: The upper bound over each, shape (n,).
    """

    part: Ints
    lower: Floats
    upper: Floats
    bound: Floats


@dataclass(frozen=True, eq=False)
class Certificate:
    """A largest value over a region, enclosed.

    What the search states is not proved until ``checker.verify`` has proved it.

    Attributes:
        lower: A value that is taken, at ``argmax``, in the objective's unit.
        upper: No value over the region is larger; infinite where the search knows no bound.
        argmax: Where the largest known value is, shape (d,).
        boxes: Boxes bounded.
        seconds: Time spent; a share of it where several networks were searched together.
        complete: Whether the two met to the tolerance asked for. ``upper`` holds in any case.
        leaves: The boxes of the proof, for the checker; None unless kept.
    """

    lower: float
    upper: float
    argmax: Floats
    boxes: int
    seconds: float
    complete: bool
    leaves: Leaves | None = None


def certify_stack(
    network: StackedMLP | Table,
    chain: SerialChain,
    region: Region,
    *,
    rtol: float = 1e-3,
    atol: float = 0.0,
    seeds: ArrayLike | None = None,
    max_boxes: int | None = None,
    time_limit_s: float = np.inf,
    keep_leaves: bool = False,
    target: Target | None = None,
    measure: Measure = "position",
) -> list[Certificate]:
    """The largest error of each network of a stack, or of a look-up table, over a region.

    Enclosed by branch and bound, all networks together: a box whose upper bound is within the
    tolerance of the best value found anywhere is a leaf, any other is halved along the axis that
    weighs most. The supremum is at most the largest bound of any leaf and of any box still waiting
    when the search is cut short. One certificate per network, in order.

    Args:
        network: Stacked networks, or a look-up table.
        chain: The arm.
        region: The inputs that it is about.
        rtol: The search ends once upper <= (1 + rtol) lower,
        atol: or upper <= lower + atol [mm or rad], or both are nearer than rounding.
        seeds: Points of the region worth trying, such as the training points, shape (n, in).
        max_boxes: Boxes to bound per network, at most; ``affordable_boxes`` if None.
        time_limit_s: Time to spend per network, at most [s]. What a search that it cuts short
            finds depends on the machine.
        keep_leaves: Whether to keep the boxes of the proof.
        target: What is asked of the tool; ``compared.target_of`` the inputs if None.
        measure: ``"position"`` [mm] or ``"angle"`` [rad].

    Raises:
        IksamplesError: A network has a number that is not finite or an unknown activation, or
            things do not fit together.
    """
    began = time.perf_counter()
    objective = ErrorOverBoxes(network, chain, region, target, measure)
    n, region, slack = objective.n_networks, objective.region, objective.slack
    max_boxes = affordable_boxes(network) if max_boxes is None else max_boxes
    # A table that keeps the orientation exactly has an error of 0, which no share comes near.
    near = np.maximum(3.0 * slack, max(atol, _FINE))
    best, argmax = _first_values(objective, seeds)
    part, low, edge = _first_boxes(region)
    which = np.repeat(np.arange(n), len(low))
    part, low, edge = np.tile(part, n), np.tile(low, (n, 1)), np.tile(edge, (n, 1))
    hopes = np.full(len(low), np.inf)  # what is known about a waiting box: its parent's bound

    boxes, settled = np.zeros(n, int), np.full(n, -np.inf)
    kept: list[tuple[Ints, Ints, Floats, Floats, Floats]] = []
    while len(low):
        spent = time.perf_counter() - began > time_limit_s * n
        allowed = (boxes < max_boxes)[which] & (not spent) & (edge.max(axis=1) > _SMALLEST)
        allowed |= np.isinf(hopes)  # a first bound of everything, whatever the limits
        if not allowed.all():
            _keep(kept, settled, keep_leaves, which, part, low, edge, hopes, ~allowed)
            which, part, hopes = which[allowed], part[allowed], hopes[allowed]
            low, edge = low[allowed], edge[allowed]
            if not len(low):
                break
        # The most promising boxes first, so that a search that is cut short has done most.
        now = np.arange(len(low))
        batch = max(_BATCH, len(now) // 4)
        if len(now) > batch:
            now = np.argpartition(-hopes, batch)[:batch]
        wait = np.ones(len(low), bool)
        wait[now] = False

        w, at, lo, ed = which[now], part[now], low[now], edge[now]
        size = (region.upper - region.lower)[at]
        radius = 0.5 * size * ed
        centre = region.lower[at] + size * (lo + 0.5 * ed)
        bound, candidate, weight = objective.upper_bounds(w, centre, radius)
        boxes += np.bincount(w, minlength=n)
        _try(objective, best, argmax, w, at, bound, centre, candidate, len(now) >= _BATCH)

        # Where an enclosure overflowed, the longest edge is as good as any.
        weight = np.where(np.isfinite(weight).all(axis=1, keepdims=True), weight, ed)
        done = bound <= np.maximum((1.0 + rtol) * best, best + near)[w]
        _keep(kept, settled, keep_leaves, w, at, lo, ed, bound, done)
        of, lo, ed = _split(lo[~done], ed[~done], weight[~done], int(wait.sum()))
        w, at, bound = w[~done][of], at[~done][of], bound[~done][of]
        which, part = np.concatenate([which[wait], w]), np.concatenate([part[wait], at])
        low, edge = np.concatenate([low[wait], lo]), np.concatenate([edge[wait], ed])
        # Only what is not bounded yet has no finite hope.
        hopes = np.concatenate([hopes[wait], np.minimum(bound, _NO_BOUND)])

    seconds = (time.perf_counter() - began) / n
    threshold = np.maximum((1.0 + rtol) * best, best + near)
    # Bounds that meet within more rounding than this have not met.
    fine = np.maximum(rtol * best, max(atol, _FINE))
    leaves = _gather(kept, n) if keep_leaves else [None] * n
    return [
        Certificate(
            float(best[row]),
            float(max(settled[row], best[row])) if settled[row] < _NO_BOUND else np.inf,
            argmax[row],
            int(boxes[row]),
            seconds,
            bool(settled[row] <= min(threshold[row], _NO_BOUND) and slack[row] <= fine[row]),
            leaves[row],
        )
        for row in range(n)
    ]


def affordable_boxes(answers: StackedMLP | Table) -> int:
    """Boxes that are bounded in about a minute, at most a million: fewer for a larger network."""
    weights = sum(one[0].size for one in answers.weights) if isinstance(answers, StackedMLP) else 0
    return int(min(_MOST_BOXES, _WORK / (_OVERHEAD + weights)))


def _first_values(objective: ErrorOverBoxes, seeds: ArrayLike | None) -> tuple[Floats, Floats]:
    """The best values at the corners and the seeds, and where."""
    n, region = objective.n_networks, objective.region
    d = region.n_inputs
    points = np.where(corners(d) > 0, region.upper[:, None], region.lower[:, None]).reshape(-1, d)
    if seeds is not None:
        seeds = np.array(seeds, float).reshape(-1, d)
        points = np.concatenate([points, seeds[region.contains(seeds)]])
    best, argmax = np.full(n, -np.inf), np.empty((n, d))
    step = max(1, 65_536 // len(points))
    for row in range(0, n, step):
        rows = np.arange(row, min(row + step, n))
        values = objective.values(np.repeat(rows, len(points)), np.tile(points, (len(rows), 1)))
        values = values.reshape(len(rows), -1)
        top = values.argmax(axis=1)
        best[rows], argmax[rows] = values[np.arange(len(rows)), top], points[top]
    return best, argmax


def _first_boxes(region: Region) -> tuple[Ints, Floats, Floats]:
    """The boxes to begin with: which box of the region, lower corners and edges as its shares."""
    n, d = region.lower.shape
    per_axis = 4 if d <= 3 else 2
    while per_axis > 1 and n > 1 and n * per_axis**d > _FILL:
        per_axis //= 2
    axis = np.arange(per_axis) / per_axis
    low = np.stack(np.meshgrid(*[axis] * d, indexing="ij"), axis=-1).reshape(-1, d)
    part = np.repeat(np.arange(n), len(low))
    return part, np.tile(low, (n, 1)), np.full((len(part), d), 1.0 / per_axis)


def _try(
    objective: ErrorOverBoxes,
    best: Floats,
    argmax: Floats,
    which: Ints,
    part: Ints,
    bound: Floats,
    centre: Floats,
    candidate: Floats,
    climb: bool,
) -> None:
    """Evaluates the most promising centres and corners; updates the best values in place.

    Args:
        objective: What is maximised.
        best: Best value of each network.
        argmax: Where it is.
        which: The network that each box is for.
        part: The box of the region that each is in.
        bound: Upper bounds over the boxes.
        centre: Their centres.
        candidate: Promising points of each.
        climb: Whether to improve the best of these points by steps along the axes. That is cheap
            beside a large round of boxes, and a better best value settles more of them.
    """
    promise = bound - best[which]
    top = np.argsort(-promise)[: 16 + 4 * len(best)]
    top = top[promise[top] > 0]
    if not len(top):
        return
    points = np.concatenate([centre[top, None], candidate[top]], axis=1)
    owner, part = np.repeat(which[top], points.shape[1]), np.repeat(part[top], points.shape[1])
    # Rounding may have put a corner of the region a last place outside it.
    walls = objective.region.lower[part], objective.region.upper[part]
    points = np.clip(points.reshape(len(owner), -1), *walls)
    values = objective.values(owner, points)
    if climb:
        start = np.argsort(best[owner] - values)[:_STARTS]
        owner, points, values = owner[start], points[start], values[start]
        _climb(objective, owner, part[start], points, values)
    order = np.argsort(values)  # the last assignment to a row is its largest value
    order = order[values[order] > best[owner[order]]]
    best[owner[order]], argmax[owner[order]] = values[order], points[order]


def _climb(
    objective: ErrorOverBoxes, which: Ints, part: Ints, points: Floats, values: Floats
) -> None:
    """Moves points of boxes of the region uphill along the axes, in place."""
    lower, upper = objective.region.lower[part, None], objective.region.upper[part, None]
    n, d = points.shape
    moves = (upper - lower) * np.concatenate([np.eye(d), -np.eye(d)])
    step, rows, owner = np.full(n, 0.25), np.arange(n), np.repeat(which, 2 * d)
    for _ in range(_STEPS):
        tried = np.clip(points[:, None] + step[:, None, None] * moves, lower, upper)
        found = objective.values(owner, tried.reshape(-1, d)).reshape(n, -1)
        top = found.argmax(axis=1)
        better = found[rows, top] > values
        values[better] = found[rows, top][better]
        points[better] = tried[rows, top][better]
        step[~better] *= 0.5


def _split(low: Floats, edge: Floats, weight: Floats, waiting: int) -> tuple[Ints, Floats, Floats]:
    """Halves boxes; several times where few are left, since a call costs more than a box.

    Returns:
        The box that each half is of; lower corners; edges.
    """
    of = np.arange(len(low))
    for _ in range(low.shape[1]):
        low, edge, weight = halved(low, edge, weight)
        of = np.concatenate([of, of])
        if 2 * len(low) + waiting > _FILL:
            break
    return of, low, edge


def halved(low: Floats, edge: Floats, weight: Floats) -> tuple[Floats, Floats, Floats]:
    """All lower, then all upper halves of boxes, each cut along the axis that weighs most.

    Args:
        low: Lower corners as shares of edges, shape (n, d).
        edge: Edges, likewise.
        weight: What is lost along each axis, shape (n, d).

    Returns:
        The same three of the halves, shape (2 n, d).
    """
    rows = np.arange(len(low))
    axis = np.where(edge > _SMALLEST, weight, -1.0).argmax(axis=1)
    edge, weight, twin = edge.copy(), weight.copy(), low.copy()
    edge[rows, axis] *= 0.5
    weight[rows, axis] *= 0.5
    twin[rows, axis] += edge[rows, axis]
    return (
        np.concatenate([low, twin]),
        np.concatenate([edge, edge]),
        np.concatenate([weight, weight]),
    )


def _keep(
    kept: list[tuple[Ints, Ints, Floats, Floats, Floats]],
    settled: Floats,
    keep_leaves: bool,
    which: Ints,
    part: Ints,
    low: Floats,
    edge: Floats,
    bound: Floats,
    mask: NDArray[np.bool_],
) -> None:
    """Settles the boxes of a mask."""
    np.maximum.at(settled, which[mask], bound[mask])
    if keep_leaves:
        kept.append((which[mask], part[mask], low[mask], edge[mask], bound[mask]))


def _gather(kept: Sequence[tuple[Ints, Ints, Floats, Floats, Floats]], n: int) -> list[Leaves]:
    """Leaves by network."""
    which, part, low, edge, bound = (np.concatenate(parts) for parts in zip(*kept, strict=True))
    rows = [np.flatnonzero(which == row) for row in range(n)]
    return [Leaves(part[row], low[row], low[row] + edge[row], bound[row]) for row in rows]
