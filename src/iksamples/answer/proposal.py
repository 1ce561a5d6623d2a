"""Where to record next: the points that trained networks know least about."""

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iksamples.arm.chain import Floats, SerialChain
from iksamples.errors import IksamplesError
from iksamples.network import StackedMLP
from iksamples.region import Region
from iksamples.samples.dataset import SampleSet
from iksamples.samples.record import region_points
from iksamples.task import Task


Strategy = Literal["disagreement", "worst"]

_BLOCK = 8192
_CANDIDATES = 4096
_CANDIDATES_PER_POINT = 16
# The worst points: networks searched, and how far each search goes. No clock, so that the same
# question has the same answer on every machine.
_SEARCHED = 8
_RTOL = 0.02
_MAX_BOXES = 20_000
_MAX_TILES_PER_AXIS = 8


def propose(
    task: Task,
    samples: SampleSet,
    network: StackedMLP,
    k: int,
    strategy: Strategy = "disagreement",
) -> Floats:
    """The next positions to record, most wanted first.

    One after another, the candidate is taken whose weight times its distance to the nearest
    position that is recorded or taken is largest: a farthest-point design in which distances count
    more where the networks know less. Candidates are usable points of the workspace.

    * ``disagreement``: the weight is how far apart the seeds send the arm (``disagreement_mm``).
    * ``worst``: the weight is the largest position error of any seed. The workspace is cut into
      tiles, and the candidates are each seed's worst point of each tile, found by the search that
      certifies the worst error. Errors are those of the arm's model, so nothing is recorded for it.

    Args:
        task: Its task.
        samples: What is recorded so far.
        network: Networks trained on it, at least two seeds for ``disagreement``.
        k: How many positions.
        strategy: What makes a position worth recording.

    Returns:
        Positions [mm], shape (k, 3).

    Raises:
        IksamplesError: There is no such strategy, k is not positive, too few of the networks are
            finite, or the workspace has too few usable points.
    """
    if strategy not in get_args(Strategy):
        raise IksamplesError(
            f"no strategy '{strategy}'; there are {', '.join(get_args(Strategy))}."
        )
    if k < 1:
        raise IksamplesError(f"{k} positions asked for; ask for at least 1.")
    network = finite(network)
    wanted = max(_CANDIDATES, 2 ** int(np.ceil(np.log2(_CANDIDATES_PER_POINT * k))))
    mm = task.x.as_lengths
    if strategy == "disagreement":
        if network.n_seeds < 2:
            raise IksamplesError(
                "Only one finite network, so no seeds that could disagree. Train more seeds, or "
                "use the strategy 'worst'."
            )
        points = region_points(task.region, wanted)
        weights = disagreement_mm(network, task.drawing, points)
        return spread(points * mm, weights, samples.x * mm, k) / mm
    points = _worst_points(task, network, k)
    weights = largest_error_mm(network, task, points)
    found = spread(points * mm, weights, samples.x * mm, k, True) / mm
    if len(found) == k:
        return found
    # The worst points were too few, or are recorded already: the workspace has others.
    points = region_points(task.region, wanted)
    have = np.concatenate([samples.x, found])
    weights = largest_error_mm(network, task, points)
    rest = spread(points * mm, weights, have * mm, k - len(found)) / mm
    return np.concatenate([found, rest])


def disagreement_mm(network: StackedMLP, chain: SerialChain, x: ArrayLike) -> Floats:
    """How far the seeds send the arm from where they send it on average.

    The root mean square over the seeds of the distance to their mean position, a deep ensemble's
    standard deviation (Lakshminarayanan et al. 2017) taken after the forward kinematics.

    Args:
        network: The seeds.
        chain: The arm.
        x: Inputs [mm or rad], shape (points, d).

    Returns:
        Shape (points,) [mm].
    """

    def block(points: Floats) -> Floats:
        reached = chain.forward_mm(network.predict(points))
        return np.sqrt(np.mean(np.sum((reached - reached.mean(axis=0)) ** 2, axis=-1), axis=0))

    return np.concatenate([block(part) for part in _blocks(np.asarray(x, float))])


def largest_error_mm(network: StackedMLP, task: Task, x: Floats) -> Floats:
    """The largest position error of any seed, by the arm's model.

    Args:
        network: The seeds.
        task: What they have learnt.
        x: Inputs [mm or rad], shape (points, d).

    Returns:
        Shape (points,) [mm].
    """

    def block(points: Floats) -> Floats:
        joints = network.predict(points)
        return task.target.position_error_mm(task.drawing, joints, points).max(axis=0)

    return np.concatenate([block(part) for part in _blocks(x)])


def spread(
    candidates_mm: Floats, weight: Floats, recorded_mm: Floats, k: int, fewer: bool = False
) -> Floats:
    """Greedy choice of points by weight times distance to what is there.

    Args:
        candidates_mm: Points to choose from [mm], shape (n, 3).
        weight: How much a distance counts at each, shape (n,); all alike if all are zero.
        recorded_mm: Positions that are there already [mm], shape (any, 3).
        k: How many to choose.
        fewer: Whether fewer are an answer, where the others have no weight or are there already.

    Returns:
        Points in the order they were chosen [mm], shape (k, 3).

    Raises:
        IksamplesError: There are too few candidates that are not there already.
    """
    from scipy.spatial import KDTree

    if not np.any(weight > 0):
        weight = np.ones(len(candidates_mm))
    distance = np.full(len(candidates_mm), np.inf)
    if len(candidates_mm):
        distance, _ = KDTree(recorded_mm).query(candidates_mm)
    chosen: list[int] = []
    while len(chosen) < k:
        score = weight * distance
        best = int(np.argmax(score)) if len(score) else -1
        if best < 0 or score[best] <= 0:
            break
        chosen.append(best)
        away = np.linalg.norm(candidates_mm - candidates_mm[best], axis=1)
        distance = np.minimum(distance, away)
    if len(chosen) < k and not fewer:
        raise IksamplesError(
            f"The workspace: {k} positions are to be proposed, but only {len(chosen)} usable ones "
            "are not recorded yet. Ask for fewer, or widen the workspace."
        )
    return candidates_mm[chosen]


def finite(network: StackedMLP) -> StackedMLP:
    """The seeds whose weights are finite.

    Raises:
        IksamplesError: There is none.
    """
    good = network.finite_rows()
    if not good:
        raise IksamplesError(
            "All networks have diverged, so they say nothing about where to record. Lower "
            "training.learning_rate."
        )
    return network.select(good)


def _worst_points(task: Task, network: StackedMLP, k: int) -> Floats:
    """Each seed's worst point of each tile of the workspace, where usable, shape (n, d)."""
    from iksamples.certify.search import certify_stack

    some = network.select(np.arange(min(network.n_seeds, _SEARCHED)))
    d = len(task.x)
    # About twice as many tiles as points, so that neighbours need not both be taken.
    per_axis = min(int(np.ceil((2 * k) ** (1 / d))), _MAX_TILES_PER_AXIS)
    edges = np.linspace(task.x.lower, task.x.upper, per_axis + 1)
    axes = np.arange(d)
    found = []
    for tile in np.ndindex(*[per_axis] * d):
        corner = np.array(tile)
        certificates = certify_stack(
            some,
            task.drawing,
            Region.box(edges[corner, axes], edges[corner + 1, axes]),
            rtol=_RTOL,
            max_boxes=_MAX_BOXES,
            target=task.target,
        )
        found += [certificate.argmax for certificate in certificates]
    points = np.unique(np.array(found), axis=0)
    points = points[task.region.contains(points)]
    return points[task.reach(points).usable]


def _blocks(x: Floats) -> list[NDArray[np.float64]]:
    return np.split(x, range(_BLOCK, len(x), _BLOCK))
