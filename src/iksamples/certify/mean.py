"""The mean error over a region, and the share of it under a tolerance, enclosed."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from iksamples.arm.chain import SerialChain
from iksamples.arm.target import Target
from iksamples.certify.enclosure import corners
from iksamples.certify.residual import ErrorOverBoxes, Residual
from iksamples.certify.search import affordable_boxes, halved
from iksamples.certify.table import Table
from iksamples.errors import IksamplesError
from iksamples.network import StackedMLP
from iksamples.region import Region


Floats = NDArray[np.float64]

_FIRST = 8
"""Cells per axis to begin with, up to three dimensions."""
_ROUND = 4096
"""Cells halved at once, at most; fewer are halved several times."""
_AIM = 0.8
"""Share of the allowed gap that a round of splits aims at."""
_LARGEST = 1e100  # what a cell counts for whose bounds overflowed
_FLAT = 1e-3
"""Slopes below this share of the steepest one are raised to it; less would cost digits."""
_SHARE_SLACK = 1e-7


@dataclass(frozen=True)
class MeanError:
    """The mean position error over the region, enclosed.

    Attributes:
        lower_mm: The mean is at least this [mm].
        upper_mm: The mean is at most this [mm].
        boxes: Cells bounded.
        seconds: Time spent.
        complete: Whether the two met to the tolerance asked for; they hold in any case.
    """

    lower_mm: float
    upper_mm: float
    boxes: int
    seconds: float
    complete: bool


@dataclass(frozen=True, eq=False)
class Coverage:
    """The share of the region where the error is at most a tolerance, enclosed.

    Attributes:
        tolerance_mm: The tolerance [mm].
        lower: At least this share of the region is under the tolerance.
        upper: At most this share is.
        bad_lower_mm: Lower corners of cells where the error is above the tolerance everywhere
            [mm], shape (cells, d).
        bad_upper_mm: Their upper corners [mm], shape (cells, d).
        mixed: Share of the region in cells that are neither good nor bad throughout.
        boxes: Cells bounded.
        seconds: Time spent.
        complete: Whether the tolerances asked for were met; the bounds hold in any case.
    """

    tolerance_mm: float
    lower: float
    upper: float
    bad_lower_mm: Floats
    bad_upper_mm: Floats
    mixed: float
    boxes: int
    seconds: float
    complete: bool


def certify_mean(
    network: StackedMLP | Table,
    row: int,
    chain: SerialChain,
    region: Region,
    *,
    rtol: float = 0.025,
    atol_mm: float = 0.0,
    max_boxes: int | None = None,
    target: Target | None = None,
) -> MeanError:
    """The mean position error over a region, uniformly weighted.

    Args:
        network: Stacked networks, or a look-up table.
        row: Which of them.
        chain: The arm.
        region: The inputs that it is about.
        rtol: The bounds end up within this share of their middle,
        atol_mm: or within this length of it [mm], if that is more.
        max_boxes: Cells to bound, at most; ``search.affordable_boxes`` if None.
        target: What is asked of the tool; ``compared.target_of`` the inputs if None.

    Raises:
        IksamplesError: As ``certify_stack``.
    """
    began = time.perf_counter()
    errors = _errors(network, row, chain, region, target)
    cells = _Cells(errors)
    most_boxes = affordable_boxes(network) if max_boxes is None else max_boxes
    while True:
        cells.bound_new(_mean_of_cells)
        volume = cells.volume
        least = float(volume @ cells.least) - float(errors.slack[0])
        most = float(volume @ cells.most) + float(errors.slack[0])
        allowed = max(rtol * (least + most), 2 * atol_mm)
        done = np.isfinite(most) and most - least <= allowed
        spent = time.perf_counter() - began
        if done or cells.bounded >= most_boxes:
            return MeanError(max(least, 0.0), most, cells.bounded, spent, done)
        cells.split(volume * (cells.most - cells.least), allowed)


def certify_coverage(
    network: StackedMLP | Table,
    row: int,
    chain: SerialChain,
    region: Region,
    tolerance_mm: float,
    *,
    atol: float = 0.02,
    mixed: float = 1.0,
    max_boxes: int | None = None,
    target: Target | None = None,
) -> Coverage:
    """The share of a region where the position error is at most a tolerance.

    Args:
        network: Stacked networks, or a look-up table.
        row: Which of them.
        chain: The arm.
        region: The inputs that it is about.
        tolerance_mm: The tolerance [mm].
        atol: The bounds of the share end up this close.
        mixed: Cells that are neither good nor bad throughout end up with at most this share of the
            region. The share itself needs no such limit; a drawing of the bad cells does.
        max_boxes: Cells to bound, at most; ``search.affordable_boxes`` if None.
        target: What is asked of the tool; ``compared.target_of`` the inputs if None.

    Raises:
        IksamplesError: As ``certify_stack``, or the tolerance is not positive.
    """
    if not (np.isfinite(tolerance_mm) and tolerance_mm > 0):
        raise IksamplesError(f"the tolerance must be a positive length; got {tolerance_mm} mm.")
    began = time.perf_counter()
    errors = _errors(network, row, chain, region, target)
    slack = float(errors.slack[0])
    cells = _Cells(errors)
    most_boxes = affordable_boxes(network) if max_boxes is None else max_boxes
    while True:
        cells.bound_new(lambda residual: _share_of_cells(residual, tolerance_mm, slack))
        volume = cells.volume
        undecided = (cells.least < 1.0) & (cells.most > 0.0)
        least, most = float(volume @ cells.least), float(volume @ cells.most)
        left = float(volume @ undecided)
        done = most - least <= atol and left <= mixed
        spent = time.perf_counter() - began
        if done or cells.bounded >= most_boxes:
            bad = cells.corners_mm(cells.most <= 0.0)
            limit_mm = float(tolerance_mm)
            return Coverage(limit_mm, least, most, *bad, left, cells.bounded, spent, done)
        if most - least > atol:
            cells.split(volume * (cells.most - cells.least), atol)
        else:
            cells.split(volume * undecided, mixed)


def _errors(
    network: StackedMLP | Table, row: int, chain: SerialChain, region: Region, target: Target | None
) -> ErrorOverBoxes:
    one = network if isinstance(network, Table) else network.select([row])
    return ErrorOverBoxes(one, chain, region, target)


class _Cells:
    """Cells that tile the region; the new ones wait at the end to be bounded.

    Attributes:
        least: Of each cell that is bounded, at least the value sought.
        most: At most the value sought.
        weight: What is lost along each axis.
    """

    def __init__(self, errors: ErrorOverBoxes) -> None:
        self.region = errors.region
        n, d = self.region.lower.shape
        per_axis = _FIRST if d <= 3 else 2
        while per_axis > 1 and n > 1 and n * per_axis**d > _FIRST**3:
            per_axis //= 2
        axis = np.arange(per_axis) / per_axis
        low = np.stack(np.meshgrid(*[axis] * d, indexing="ij"), axis=-1).reshape(-1, d)
        # Corners and edges are shares of the edges of the region's box that a cell is in.
        self.part, self.low = np.repeat(np.arange(n), len(low)), np.tile(low, (n, 1))
        self.edge = np.full_like(self.low, 1.0 / per_axis)
        self.errors = errors
        self.bounded = 0
        self.new = len(self.low)
        self.least, self.most, self.weight = np.empty(0), np.empty(0), np.empty((0, d))

    @property
    def volume(self) -> Floats:
        """Each cell's share of the region."""
        return np.array(self.region.shares[self.part] * np.prod(self.edge, axis=1))

    def corners_mm(self, mask: NDArray[np.bool_]) -> tuple[Floats, Floats]:
        """Lower and upper corners [mm] of some cells."""
        part = self.part[mask]
        size = (self.region.upper - self.region.lower)[part]
        low = self.region.lower[part] + size * self.low[mask]
        return low, low + size * self.edge[mask]

    def bound_new(self, bound: Callable[[Residual], tuple[Floats, Floats]]) -> None:
        """Bounds the new cells."""
        parts = [(self.least, self.most, self.weight)]
        for first in range(len(self.low) - self.new, len(self.low), 1024):
            some = slice(first, first + 1024)
            at, low, edge = self.part[some], self.low[some], self.edge[some]
            size = (self.region.upper - self.region.lower)[at]
            centre = self.region.lower[at] + size * (low + 0.5 * edge)
            which = np.zeros(len(low), int)
            [residual] = self.errors.residuals(which, centre, 0.5 * size * edge, average=True)
            with np.errstate(all="ignore"):
                weight = _weight(residual)
                known = np.isfinite(weight).all(axis=1, keepdims=True)
                parts.append((*bound(residual), np.where(known, weight, edge)))
        self.bounded += self.new
        self.least, self.most, self.weight = (
            np.concatenate(column) for column in zip(*parts, strict=True)
        )

    def split(self, loss: Floats, allowed: float) -> None:
        """Halves the cells that lose most, several times where far too much is lost.

        A halving is taken to halve a loss, and as few cells are halved as that makes enough.
        """
        loss = np.minimum(loss, _LARGEST)
        excess = loss.sum() / max(_AIM * allowed, 1.0 / _LARGEST)
        halvings = int(np.clip(np.ceil(np.log2(excess)), 1, self.low.shape[1]))
        order = np.argsort(-loss)[: min(2 * _ROUND >> halvings, np.count_nonzero(loss))]
        gain = np.cumsum(loss[order]) * (1.0 - 0.5**halvings)
        chosen = order[: np.searchsorted(gain, loss.sum() - _AIM * allowed) + 1]
        low, edge, weight = self.low[chosen], self.edge[chosen], self.weight[chosen]
        for _ in range(halvings):
            low, edge, weight = halved(low, edge, weight)
        kept = np.delete(np.arange(len(loss)), chosen)
        self.part = np.concatenate([self.part[kept], *[self.part[chosen]] * 2**halvings])
        self.low = np.concatenate([self.low[kept], low])
        self.edge = np.concatenate([self.edge[kept], edge])
        self.least, self.most, self.weight = self.least[kept], self.most[kept], self.weight[kept]
        self.new = len(low)


@dataclass(frozen=True, eq=False)
class _Cut:
    """The residual over cells, cut along and across its mean.

    The error is within ``blur`` of ``|z|`` with z a polynomial, and on average over the cell within
    ``mean_blur``. Along n, the direction of the mean of z, it is ``mean + slope s`` to within
    ``bend`` and varies by ``variance``; what is across n has the mean square ``across`` and a
    square of at most ``across_max``.
    """

    mean: Floats
    slope: Floats
    bend: Floats
    variance: Floats
    across: Floats
    across_max: Floats
    blur: Floats
    mean_blur: Floats


def _cut(residual: Residual) -> _Cut:
    d = residual.linear_mm.shape[1]
    squares, mixed = residual.quadratic_mm[:, :d], residual.quadratic_mm[:, d:]
    centre = residual.centre_mm + squares.sum(axis=1) / 3.0  # the mean of s^2 is 1/3
    mean = np.linalg.norm(centre, axis=1)
    direction = np.where(
        mean[:, None] > 0, centre / np.maximum(mean, np.finfo(float).tiny)[:, None], 0.0
    )
    direction[mean == 0, 0] = 1.0

    # Terms s_a, s_a^2 - 1/3 and s_a s_b: no mean, not correlated; largest value and mean square.
    terms = np.concatenate([residual.linear_mm, squares, mixed], axis=1)
    kinds = np.repeat([0, 1, 2], [d, d, mixed.shape[1]])
    largest = np.array([1.0, 2.0 / 3.0, 1.0])[kinds]
    square = np.array([1.0 / 3.0, 4.0 / 45.0, 1.0 / 9.0])[kinds]
    along = np.einsum("btk,bk->bt", terms, direction)
    across = np.linalg.norm(terms - along[:, :, None] * direction[:, None], axis=2)
    size = np.abs(residual.noise_mm)
    noise = np.linalg.norm(size.sum(axis=1), axis=1)
    mean_noise = noise
    if not residual.one_sided:
        each = residual.mean_reach[:, 0] * np.linalg.norm(size, axis=2)
        mean_noise = np.minimum(noise, each.sum(axis=1))
    return _Cut(
        mean,
        along[:, :d],
        np.abs(along[:, d:]) @ largest[d:],
        along**2 @ square,
        across**2 @ square,
        (across @ largest) ** 2,
        noise + residual.remainder_mm.max(axis=1),
        mean_noise + residual.mean_remainder_mm[:, 0],
    )


def _weight(residual: Residual) -> Floats:
    """What is lost along each axis: by the enclosure, and by taking a norm of what is not constant.

    The norm of something affine bends by about the square of its slope over its size.
    """
    slope = np.linalg.norm(residual.linear_mm, axis=2)
    size = np.linalg.norm(residual.centre_mm, axis=1) + slope.sum(axis=1)
    return residual.weight_mm + slope**2 / np.maximum(size, np.finfo(float).tiny)[:, None]


def _mean_of_cells(residual: Residual) -> tuple[Floats, Floats]:
    """Bounds of the mean error over each cell.

    With t along and q the square of what is across, ``|z| = t + g(t, q)``, where
    ``g = sqrt(t^2 + q) - t`` falls with t and is concave in q. So the mean of g is at most
    ``g(least t, mean q)``, by Jensen's inequality, and at least ``g(largest t, largest q) (mean q)
    / (largest q)``, by the chord. The mean of z^2 gives a second upper bound.
    """
    cut = _cut(residual)
    reach = np.abs(cut.slope).sum(axis=1) + cut.bend
    above = cut.mean + _bulge(cut.mean - reach, cut.across)
    above = np.minimum(above, np.sqrt(cut.mean**2 + cut.variance + cut.across))
    part = cut.across / np.maximum(cut.across_max, np.finfo(float).tiny)
    below = cut.mean + _bulge(cut.mean + reach, cut.across_max) * np.minimum(part, 1.0)
    return np.fmax(below - cut.mean_blur, 0.0), np.fmin(above + cut.mean_blur, residual.most_mm)


def _share_of_cells(
    residual: Residual, tolerance_mm: float, slack_mm: float
) -> tuple[Floats, Floats]:
    """Bounds of the share of each cell where the error is at most the tolerance.

    The error is at least ``mean + slope s - bend - blur`` and at most
    ``mean + slope s + bend + bulge + blur``; both cut the cell along planes.
    """
    cut = _cut(residual)
    reach = np.abs(cut.slope).sum(axis=1) + cut.bend
    blur = cut.blur + slack_mm
    bulge = _bulge(cut.mean - reach, cut.across_max)
    room = tolerance_mm - cut.mean
    below = _share_under_plane(cut.slope, room - cut.bend - bulge - blur, -1.0)
    above = _share_under_plane(cut.slope, room + cut.bend + blur, 1.0)
    good = np.fmin(residual.largest() + slack_mm, residual.most_mm) <= tolerance_mm
    return np.where(good, 1.0, below), np.where(good, 1.0, above)


def _bulge(along: Floats, across: Floats) -> Floats:
    """``sqrt(t^2 + q) - t``, without cancellation for t > 0."""
    root = np.sqrt(along**2 + across)
    safe = np.maximum(root + along, np.finfo(float).tiny)
    return np.where(along > 0, across / safe, root - along)


def _share_under_plane(slope: Floats, room: Floats, side: float) -> Floats:
    """Share of [-1, 1]^d where ``slope s <= room``, bounded from one side.

    For k steep slopes a it is the inclusion-exclusion sum over the corners v of [0, 1]^k,
    ``sum (-1)^|v| max(0, room + sum(a) - 2 a v)^k / (k! prod(2 a))``. Only the three steepest are
    used, and none below a thousandth of the steepest, which keeps the sum accurate; what that
    changes shifts the plane.

    Args:
        slope: Shape (cells, d).
        room: Shape (cells,).
        side: 1 for an upper bound, -1 for a lower bound.
    """
    size = np.sort(np.abs(slope), axis=1)[:, ::-1]
    k = min(size.shape[1], 3)
    floor = np.maximum(_FLAT * size[:, :1], 1e-12)
    steep = np.maximum(size[:, :k], floor)
    shift = (steep - size[:, :k]).sum(axis=1) + size[:, k:].sum(axis=1)
    room = room + side * shift
    total = steep.sum(axis=1)
    at = 0.5 * (corners(k) + 1.0)
    sign = np.where(at.sum(axis=1) % 2 == 0, 1.0, -1.0)
    volume = np.maximum((room + total)[:, None] - 2.0 * steep @ at.T, 0.0) ** k @ sign
    share = volume / (np.prod(2.0 * steep, axis=1) * float(np.prod(np.arange(1, k + 1))))
    share = np.where(room >= total, 1.0, np.where(room <= -total, 0.0, share + side * _SHARE_SLACK))
    # Where something overflowed nothing is known of the share.
    return np.clip(np.where(np.isnan(share), 0.5 + 0.5 * side, share), 0.0, 1.0)
