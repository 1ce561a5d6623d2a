"""Branch and bound: the largest value over a box, from below and from above."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iksamples.arm.chain import SerialChain
from iksamples.certify.enclosure import corners
from iksamples.certify.residual import Comparison, ErrorOverBoxes
from iksamples.certify.tiling import tiles_unit_box
from iksamples.errors import IksamplesError
from iksamples.network import StackedMLP


Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_BATCH = 1024
"""Boxes bounded in one round, or a quarter of those that wait where that is more."""
_FILL = 96
"""While fewer boxes than this are left, each is split along several axes at once."""
_STARTS, _STEPS = 8, 12
"""Points that a large round improves, and steps of each."""
_SMALLEST = 2.0**-48
"""Edges, as a share of the region's, are not halved below this; they stay exact in float64."""


class Objective(Protocol):
    """Something to maximise, for several networks at once."""

    lower_mm: Floats
    upper_mm: Floats

    @property
    def n_networks(self) -> int:
        """Number of networks."""

    def values(self, which: Ints, points_mm: Floats) -> Floats:
        """Values at points, shape (points,)."""

    def upper_bounds(
        self, which: Ints, centre_mm: Floats, radius_mm: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Upper bounds over boxes, promising points of each, and the weight of each axis.

        Shapes (boxes,), (boxes, points, d), (boxes, d).
        """


@dataclass(frozen=True, eq=False)
class Leaves:
    """The boxes that a search ended with; together they tile the region.

    Attributes:
        lower: Lower corners as shares of the region's edges, exact binary fractions, (n, d).
        upper: Upper corners, likewise.
        bound: The upper bound over each box, shape (n,).
    """

    lower: Floats
    upper: Floats
    bound: Floats


@dataclass(frozen=True, eq=False)
class Supremum:
    """A supremum over the region, enclosed.

    Attributes:
        lower: A value that is taken.
        upper: No value exceeds this.
        argmax_mm: Where ``lower`` is taken, shape (d,).
        boxes: Boxes bounded.
        seconds: Time spent; a share of it where several networks were searched together.
        complete: Whether the two met to the tolerance asked for. ``upper`` holds in any case.
        leaves: The boxes of the proof, if kept.
    """

    lower: float
    upper: float
    argmax_mm: Floats
    boxes: int
    seconds: float
    complete: bool
    leaves: Leaves | None = None


@dataclass(frozen=True, eq=False)
class Certificate:
    """A certified worst-case position error over a box.

    Attributes:
        lower_mm: An error that is taken, at ``argmax_mm`` [mm].
        upper_mm: No position of the box has a larger error [mm].
        argmax_mm: Where the largest known error is [mm], shape (d,).
        boxes: Boxes bounded.
        seconds: Time spent.
        complete: Whether upper and lower met to the tolerance. ``upper_mm`` holds in any case.
        box_lower_mm: Lower corner of the box [mm].
        box_upper_mm: Upper corner of the box [mm].
        compare: What is compared.
        leaves: The boxes of the proof, for the checker; None unless kept.
    """

    lower_mm: float
    upper_mm: float
    argmax_mm: Floats
    boxes: int
    seconds: float
    complete: bool
    box_lower_mm: Floats
    box_upper_mm: Floats
    compare: Comparison
    leaves: Leaves | None = None


def certify_sup(
    network: StackedMLP,
    row: int,
    chain: SerialChain,
    lower_mm: ArrayLike,
    upper_mm: ArrayLike,
    *,
    rtol: float = 1e-3,
    seeds_mm: ArrayLike | None = None,
    max_boxes: int = 1_000_000,
    time_limit_s: float = 60.0,
    keep_leaves: bool = False,
    start: Leaves | None = None,
    compare: Comparison | None = None,
) -> Certificate:
    """The largest position error of one network over a box, enclosed by branch and bound.

    Args:
        network: Stacked networks.
        row: Which of them.
        chain: The arm.
        lower_mm: Lower corner of the box [mm], shape (in,).
        upper_mm: Upper corner of the box [mm], shape (in,).
        rtol: The search ends once upper <= (1 + rtol) lower.
        seeds_mm: Points of the box worth trying, such as the training points, shape (n, in).
        max_boxes: Boxes to bound, at most.
        time_limit_s: Time to spend, at most [s].
        keep_leaves: Whether to keep the boxes of the proof.
        start: Boxes to start from, such as the leaves for a similar network. Many similar networks
            are certified faster together, by ``certify_stack``.
        compare: What is compared; the first coordinates with the first inputs if None.

    Raises:
        IksamplesError: The network has a number that is not finite or an unknown activation, the
            box is empty, or things do not fit together.
    """
    [certificate] = certify_stack(
        network.select([row]),
        chain,
        lower_mm,
        upper_mm,
        rtol=rtol,
        seeds_mm=seeds_mm,
        max_boxes=max_boxes,
        time_limit_s=time_limit_s,
        keep_leaves=keep_leaves,
        start=start,
        compare=compare,
    )
    return certificate


def certify_stack(
    network: StackedMLP,
    chain: SerialChain,
    lower_mm: ArrayLike,
    upper_mm: ArrayLike,
    *,
    rtol: float = 1e-3,
    seeds_mm: ArrayLike | None = None,
    max_boxes: int = 1_000_000,
    time_limit_s: float = 60.0,
    keep_leaves: bool = False,
    start: Leaves | None = None,
    compare: Comparison | None = None,
) -> list[Certificate]:
    """``certify_sup`` for every network of a stack, searched together, which is faster.

    ``max_boxes`` and ``time_limit_s`` count per network. One certificate per network, in order.
    """
    objective = ErrorOverBoxes(network, chain, lower_mm, upper_mm, compare)
    first = None
    if start is not None:
        if start.lower.shape[1:] != objective.lower_mm.shape or not tiles_unit_box(
            start.lower, start.upper
        ):
            raise IksamplesError("the boxes to start from do not tile the region.")
        first = start.lower, start.upper - start.lower
    found = maximise(
        objective,
        rtol=rtol,
        atol=float(2.0 * objective.slack_mm.max()),
        seeds_mm=seeds_mm,
        max_boxes=max_boxes,
        time_limit_s=time_limit_s,
        keep_leaves=keep_leaves,
        first=first,
    )
    return [
        Certificate(
            max(item.lower - float(objective.slack_mm[row]), 0.0),
            item.upper,
            item.argmax_mm,
            item.boxes,
            item.seconds,
            item.complete,
            objective.lower_mm,
            objective.upper_mm,
            objective.compare,
            item.leaves,
        )
        for row, item in enumerate(found)
    ]


def maximise(
    objective: Objective,
    *,
    rtol: float,
    atol: float = 0.0,
    seeds_mm: ArrayLike | None = None,
    max_boxes: int = 1_000_000,
    time_limit_s: float = 60.0,
    keep_leaves: bool = False,
    first: tuple[Floats, Floats] | None = None,
) -> list[Supremum]:
    """Encloses the supremum over the objective's box for each network.

    A box whose upper bound is within the tolerance of the best value found anywhere is a leaf; any
    other is halved along the axis that weighs most. The supremum is at most the largest bound of
    any leaf and of any box still waiting when the search is cut short.

    Args:
        objective: What to maximise.
        rtol: Relative tolerance.
        atol: Absolute tolerance, in the objective's unit.
        seeds_mm: Points of the region worth trying, shape (n, d).
        max_boxes: Boxes to bound per network, at most.
        time_limit_s: Time to spend per network, at most [s].
        keep_leaves: Whether to keep the leaves.
        first: Lower corners and edges, as shares of the region's edges, of the boxes to start
            from; they must tile the region.
    """
    began = time.perf_counter()
    n, size = objective.n_networks, objective.upper_mm - objective.lower_mm
    best, argmax = _first_values(objective, size, seeds_mm)
    low, edge = first or _first_boxes(len(size))
    which = np.repeat(np.arange(n), len(low))
    low, edge = np.tile(low, (n, 1)), np.tile(edge, (n, 1))
    hopes = np.full(len(low), np.inf)  # what is known about a waiting box: its parent's bound

    boxes, settled = np.zeros(n, int), np.full(n, -np.inf)
    kept: list[tuple[Ints, Floats, Floats, Floats]] = []
    while len(low):
        spent = time.perf_counter() - began > time_limit_s * n
        allowed = (boxes < max_boxes)[which] & (not spent) & (edge.max(axis=1) > _SMALLEST)
        allowed |= np.isinf(hopes)  # a first bound of everything, whatever the limits
        if not allowed.all():
            _keep(kept, settled, keep_leaves, which, low, edge, hopes, ~allowed)
            which, low, edge, hopes = which[allowed], low[allowed], edge[allowed], hopes[allowed]
            if not len(low):
                break
        # The most promising boxes first, so that a search that is cut short has done most.
        now = np.arange(len(low))
        batch = max(_BATCH, len(now) // 4)
        if len(now) > batch:
            now = np.argpartition(-hopes, batch)[:batch]
        wait = np.ones(len(low), bool)
        wait[now] = False

        w, lo, ed = which[now], low[now], edge[now]
        radius = 0.5 * size * ed
        centre = objective.lower_mm + size * (lo + 0.5 * ed)
        bound, candidate, weight = objective.upper_bounds(w, centre, radius)
        boxes += np.bincount(w, minlength=n)
        _try(objective, best, argmax, w, bound, centre, candidate, len(now) >= _BATCH)

        done = bound <= np.maximum((1.0 + rtol) * best, best + atol)[w]
        _keep(kept, settled, keep_leaves, w, lo, ed, bound, done)
        w, lo, ed, bound, weight = w[~done], lo[~done], ed[~done], bound[~done], weight[~done]
        w, lo, ed, bound = _split(w, lo, ed, bound, weight, int(wait.sum()))
        which, low = np.concatenate([which[wait], w]), np.concatenate([low[wait], lo])
        edge, hopes = np.concatenate([edge[wait], ed]), np.concatenate([hopes[wait], bound])

    seconds = (time.perf_counter() - began) / n
    threshold = np.maximum((1.0 + rtol) * best, best + atol)
    leaves = _gather(kept, n) if keep_leaves else [None] * n
    return [
        Supremum(
            float(best[row]),
            float(max(settled[row], best[row])),
            argmax[row],
            int(boxes[row]),
            seconds,
            bool(settled[row] <= threshold[row]),
            leaves[row],
        )
        for row in range(n)
    ]


def _first_values(
    objective: Objective, size: Floats, seeds_mm: ArrayLike | None
) -> tuple[Floats, Floats]:
    """The best values at the corners and the seeds, and where."""
    n, d = objective.n_networks, len(size)
    points = np.where(corners(d) > 0, objective.upper_mm, objective.lower_mm)
    if seeds_mm is not None:
        seeds = np.array(seeds_mm, float).reshape(-1, d)
        inside = np.all((seeds >= objective.lower_mm) & (seeds <= objective.upper_mm), axis=1)
        points = np.concatenate([points, seeds[inside]])
    best, argmax = np.full(n, -np.inf), np.empty((n, d))
    step = max(1, 65_536 // len(points))
    for row in range(0, n, step):
        rows = np.arange(row, min(row + step, n))
        values = objective.values(np.repeat(rows, len(points)), np.tile(points, (len(rows), 1)))
        values = values.reshape(len(rows), -1)
        top = values.argmax(axis=1)
        best[rows], argmax[rows] = values[np.arange(len(rows)), top], points[top]
    return best, argmax


def _first_boxes(d: int) -> tuple[Floats, Floats]:
    """Lower corners and edges, as shares of the region's, of the boxes to begin with."""
    per_axis = 4 if d <= 3 else 2
    axis = np.arange(per_axis) / per_axis
    low = np.stack(np.meshgrid(*[axis] * d, indexing="ij"), axis=-1).reshape(-1, d)
    return low, np.full_like(low, 1.0 / per_axis)


def _try(
    objective: Objective,
    best: Floats,
    argmax: Floats,
    which: Ints,
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
    owner = np.repeat(which[top], points.shape[1])
    # Rounding may have put a corner of the region a last place outside it.
    points = np.clip(points.reshape(len(owner), -1), objective.lower_mm, objective.upper_mm)
    values = objective.values(owner, points)
    if climb:
        start = np.argsort(best[owner] - values)[:_STARTS]
        owner, points, values = owner[start], points[start], values[start]
        _climb(objective, owner, points, values)
    order = np.argsort(values)  # the last assignment to a row is its largest value
    order = order[values[order] > best[owner[order]]]
    best[owner[order]], argmax[owner[order]] = values[order], points[order]


def _climb(objective: Objective, which: Ints, points: Floats, values: Floats) -> None:
    """Moves points of the region uphill along the axes, in place."""
    size = objective.upper_mm - objective.lower_mm
    n, d = points.shape
    moves = size * np.concatenate([np.eye(d), -np.eye(d)])
    step, rows, owner = np.full(n, 0.25), np.arange(n), np.repeat(which, 2 * d)
    for _ in range(_STEPS):
        tried = np.clip(
            points[:, None] + step[:, None, None] * moves, objective.lower_mm, objective.upper_mm
        )
        found = objective.values(owner, tried.reshape(-1, d)).reshape(n, -1)
        top = found.argmax(axis=1)
        better = found[rows, top] > values
        values[better] = found[rows, top][better]
        points[better] = tried[rows, top][better]
        step[~better] *= 0.5


def _split(
    which: Ints, low: Floats, edge: Floats, bound: Floats, weight: Floats, waiting: int
) -> tuple[Ints, Floats, Floats, Floats]:
    """Halves boxes; several times where few are left, since a call costs more than a box."""
    for _ in range(low.shape[1]):
        rows = np.arange(len(low))
        axis = np.where(edge > _SMALLEST, weight, -1.0).argmax(axis=1)
        edge, weight, twin = edge.copy(), weight.copy(), low.copy()
        edge[rows, axis] *= 0.5
        weight[rows, axis] *= 0.5
        twin[rows, axis] += edge[rows, axis]
        low, edge = np.concatenate([low, twin]), np.concatenate([edge, edge])
        which, bound = np.concatenate([which, which]), np.concatenate([bound, bound])
        weight = np.concatenate([weight, weight])
        if 2 * len(low) + waiting > _FILL:
            break
    return which, low, edge, bound


def _keep(
    kept: list[tuple[Ints, Floats, Floats, Floats]],
    settled: Floats,
    keep_leaves: bool,
    which: Ints,
    low: Floats,
    edge: Floats,
    bound: Floats,
    mask: NDArray[np.bool_],
) -> None:
    """Settles the boxes of a mask."""
    np.maximum.at(settled, which[mask], bound[mask])
    if keep_leaves:
        kept.append((which[mask], low[mask], edge[mask], bound[mask]))


def _gather(kept: Sequence[tuple[Ints, Floats, Floats, Floats]], n: int) -> list[Leaves]:
    """Leaves by network."""
    which, low, edge, bound = (np.concatenate(parts) for parts in zip(*kept, strict=True))
    rows = [np.flatnonzero(which == row) for row in range(n)]
    return [Leaves(low[row], low[row] + edge[row], bound[row]) for row in rows]
