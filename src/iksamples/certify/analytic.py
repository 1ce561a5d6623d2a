"""The paper's bound put right: from the errors at the samples to every position between them.

With h the map from a position to where the arm goes, the error is ``e(x) = |h(x) - x|``. The paper
bounds it between samples by how far the nearest sample is (Lemmas 1 and 2, Eq. 25), with the errors
at the samples taken to be zero. Two ways to do that soundly:

*Triangle form.* For any sample x_i whose segment to x lies in a convex cell,

    e(x) <= e(x_i) + |(h - id)(x) - (h - id)(x_i)| <= e(x_i) + Lip(h - id) |x - x_i|,

with the Lipschitz constant over the cell. It is of first order in the spacing. The farthest
position of a cubic grid cell of edge d is sqrt(3) / 2 d from a sample, not d / 2.

*Interpolation form.* On a grid let I g be the multilinear interpolation of g from the corners of
each cell. It keeps affine maps, so ``h - id = I (h - id) + (h - I h)``, and at any x the first term
is a weighted mean of the errors at the cell's corners. Hence

    e(x) <= max over the cell's corners of e + |h(x) - (I h)(x)|.

For a network with two derivatives the last term is at most ``d^2 / 8`` times the sum over the axes
of the largest ``|d^2 h / dx_a^2|`` of the cell (interpolate one axis after another), so it is of
second order; for a ReLU network it is of first order across kinks. It is not sampled here, nor is
the second derivative: its supremum is enclosed by branch and bound.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iksamples.arm.chain import SerialChain
from iksamples.certify.dispersion import cone_envelope, covering_radius
from iksamples.certify.enclosure import corners
from iksamples.certify.lipschitz import Steepness, certify_lipschitz
from iksamples.certify.residual import ErrorOverBoxes
from iksamples.certify.search import maximise
from iksamples.errors import IksamplesError
from iksamples.network import StackedMLP


Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_PIECES = 12
"""Boxes along each axis of the region, at least, over which Lipschitz constants are bounded."""


@dataclass(frozen=True)
class TriangleBound:
    """The triangle form and its terms.

    Attributes:
        bound_mm: No position has a larger error [mm].
        training_mm: Largest error at a sample [mm].
        lipschitz: Largest Lipschitz constant of h - id used [mm/mm].
        covering_mm: Largest distance from a position to its nearest sample [mm].
    """

    bound_mm: float
    training_mm: float
    lipschitz: float
    covering_mm: float


@dataclass(frozen=True)
class InterpolationBound:
    """The interpolation form and its terms.

    Attributes:
        bound_mm: No position has a larger error [mm].
        training_mm: Largest error at a corner of a cell [mm].
        remainder_mm: No position has a larger ``|h - I h|`` [mm].
        complete: Whether both were enclosed to the tolerance; they hold in any case.
    """

    bound_mm: float
    training_mm: float
    remainder_mm: float
    complete: bool


def triangle_on_grid(
    network: StackedMLP, row: int, chain: SerialChain, axes_mm: list[ArrayLike]
) -> TriangleBound:
    """The triangle form on a full grid, with the Lipschitz constant of each cell.

    Every position is in the eighth of its cell that belongs to a corner, so it is at most half the
    cell's diagonal from that corner.

    Args:
        network: Stacked networks.
        row: Which of them.
        chain: The arm.
        axes_mm: Coordinates of the grid along each axis, ascending [mm].
    """
    axes = _checked(axes_mm)
    grid = _Grid(network.select([row]), chain, axes)
    steepness = Steepness(network.select([row]), chain, grid.lower_mm, grid.upper_mm, None, True)
    # Each cell is cut into pieces, since a bound over a whole cell would be loose.
    cuts = [int(np.ceil(_PIECES / (len(axis) - 1))) for axis in axes]
    edges = [
        np.unique(np.concatenate([np.linspace(a, b, n + 1) for a, b in pairwise(x)]))
        for x, n in zip(axes, cuts, strict=True)
    ]
    low = _product([x[:-1] for x in edges])
    high = _product([x[1:] for x in edges])
    constants = np.concatenate(
        [
            steepness.upper_bounds(
                np.zeros(len(low[k : k + 512]), int),
                0.5 * (low[k : k + 512] + high[k : k + 512]),
                0.5 * (high[k : k + 512] - low[k : k + 512]),
            )[0]
            for k in range(0, len(low), 512)
        ]
    )
    cell = grid.cell_of(0.5 * (low + high))
    steepest = np.zeros(grid.n_cells)
    np.maximum.at(steepest, cell, constants)
    half = 0.5 * np.linalg.norm(_product([np.diff(axis) for axis in axes]), axis=1)
    bounds = grid.corner_error_mm[0].max(axis=1) + steepest * half
    return TriangleBound(
        float(bounds.max() + 2.0 * grid.slack_mm[0]),
        float(grid.corner_error_mm.max()),
        float(steepest.max()),
        float(half.max()),
    )


def triangle_on_samples(
    network: StackedMLP,
    row: int,
    chain: SerialChain,
    samples_mm: ArrayLike,
    lower_mm: ArrayLike,
    upper_mm: ArrayLike,
    *,
    rtol: float = 0.02,
) -> TriangleBound:
    """The triangle form for any design, with one Lipschitz constant for the whole box.

    The bound is the supremum of ``min_i (e_i + Lip |x - x_i|)``, which is never above the largest
    training error plus Lip times the covering radius.

    Args:
        network: Stacked networks.
        row: Which of them.
        chain: The arm.
        samples_mm: The samples, inside the box [mm], shape (n, in).
        lower_mm: Lower corner of the box [mm], shape (in,).
        upper_mm: Upper corner of the box [mm], shape (in,).
        rtol: Tolerance of the Lipschitz constant, the covering radius and the supremum.
    """
    one = network.select([row])
    samples = np.array(samples_mm, float)
    errors = ErrorOverBoxes(one, chain, lower_mm, upper_mm)
    if ((samples < errors.lower_mm) | (samples > errors.upper_mm)).any():
        raise IksamplesError("a sample lies outside the box; the bound needs them inside.")
    heights = errors.values(np.zeros(len(samples), int), samples) + errors.slack_mm[0]
    [steepest] = certify_lipschitz(one, chain, lower_mm, upper_mm, rtol=rtol)
    envelope = cone_envelope(samples, heights, steepest.upper, lower_mm, upper_mm, rtol=rtol)
    covering = covering_radius(samples, lower_mm, upper_mm, rtol=rtol)
    return TriangleBound(envelope.upper, float(heights.max()), steepest.upper, covering.upper)


def interpolation_on_grid(
    network: StackedMLP,
    row: int,
    chain: SerialChain,
    axes_mm: list[ArrayLike],
    *,
    rtol: float = 0.01,
    max_boxes: int = 200_000,
    time_limit_s: float = 60.0,
) -> InterpolationBound:
    """The interpolation form on a full grid.

    Args:
        network: Stacked networks.
        row: Which of them.
        chain: The arm.
        axes_mm: Coordinates of the grid along each axis, ascending [mm].
        rtol: Tolerance of the two suprema.
        max_boxes: Boxes to bound for each, at most.
        time_limit_s: Time to spend on each, at most [s].
    """
    axes = _checked(axes_mm)
    found = []
    for with_errors in (True, False):
        grid = _Grid(network.select([row]), chain, axes, with_errors)
        found += maximise(
            grid,
            rtol=rtol,
            atol=float(8.0 * grid.slack_mm[0]),
            max_boxes=max_boxes,
            time_limit_s=time_limit_s,
            first=grid.cells(),
        )
    bound, remainder = found
    training = float(grid.corner_error_mm.max() + grid.slack_mm[0])
    return InterpolationBound(
        min(bound.upper, training + remainder.upper),
        training,
        remainder.upper,
        bound.complete and remainder.complete,
    )


class _Grid(ErrorOverBoxes):
    """``|h - I h|``, with or without the largest corner error of the cell, as an objective."""

    def __init__(
        self, network: StackedMLP, chain: SerialChain, axes: list[Floats], with_errors: bool = True
    ) -> None:
        lower, upper = np.array([x[0] for x in axes]), np.array([x[-1] for x in axes])
        super().__init__(network, chain, lower, upper)
        self.axes, self.with_errors = axes, with_errors
        self.n_cells = int(np.prod([len(x) - 1 for x in axes]))
        nodes = _product(axes)
        which = np.repeat(np.arange(self.n_networks), len(nodes))
        points = np.tile(nodes, (self.n_networks, 1))
        tip = self.linkage.position_mm(self.layers.predict(points, which))
        reached = tip[:, list(self.compare.coordinates)]
        errors = np.linalg.norm(reached - points[:, list(self.compare.inputs)], axis=1)
        # Node numbers of the corners of each cell, in the order of corners(d).
        steps = np.cumprod([1, *[len(x) for x in axes[:0:-1]]])[::-1]
        first = _product([np.arange(len(x) - 1.0) for x in axes]) @ steps
        offsets = ((corners(len(axes)) + 1.0) / 2.0) @ steps
        numbers = (first[:, None] + offsets).astype(int)
        self.corner_mm = reached.reshape(self.n_networks, len(nodes), -1)[:, numbers]
        self.corner_error_mm = errors.reshape(self.n_networks, len(nodes))[:, numbers]

    def cells(self) -> tuple[Floats, Floats]:
        """Lower corners and edges of the cells as shares of the region's edges."""
        shares = [(x - x[0]) / (x[-1] - x[0]) for x in self.axes]
        return _product([s[:-1] for s in shares]), _product([np.diff(s) for s in shares])

    def cell_of(self, points_mm: Floats) -> Ints:
        """The cell that each position is in."""
        number = np.zeros(len(points_mm), int)
        for a, axis in enumerate(self.axes):
            place = np.searchsorted(axis, points_mm[:, a], side="right") - 1
            number = number * (len(axis) - 1) + np.clip(place, 0, len(axis) - 2)
        return number

    def values(self, which: Ints, points_mm: Floats) -> Floats:
        """The objective at points."""
        cell = self.cell_of(points_mm)
        tip = self.linkage.position_mm(self.layers.predict(points_mm, which))
        reached = tip[:, list(self.compare.coordinates)]
        inter = self._interpolate(which, cell, points_mm[:, None])[:, 0]
        return np.linalg.norm(reached - inter, axis=1) + self._errors(which, cell)

    def upper_bounds(
        self, which: Ints, centre_mm: Floats, radius_mm: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Bounds over boxes, each inside one cell; as in ``ErrorOverBoxes``.

        The interpolation is multilinear inside a cell, so it is known from the box's corners.
        """
        cell = self.cell_of(centre_mm)
        signs = corners(centre_mm.shape[1])
        at = centre_mm[:, None] + signs * radius_mm[:, None]
        residual = self.residual(which, centre_mm, radius_mm, minus_identity=False)
        upper, worst = residual.largest(self._interpolate(which, cell, at))
        # Slack for the nodes' values, and for a cell's corners being rounded.
        upper += self._errors(which, cell) + 4.0 * self.slack_mm[which]
        corner = at[np.arange(len(at)), worst]
        return upper, corner[:, None], residual.weight_mm

    def _errors(self, which: Ints, cell: Ints) -> Floats:
        if not self.with_errors:
            return np.zeros(len(cell))
        return self.corner_error_mm[which, cell].max(axis=1)

    def _interpolate(self, which: Ints, cell: Ints, points_mm: Floats) -> Floats:
        """Multilinear interpolation at points (batch, points, d), shape (batch, points, k)."""
        place = np.unravel_index(cell, [len(x) - 1 for x in self.axes])
        low = np.stack([x[i] for x, i in zip(self.axes, place, strict=True)], axis=1)
        high = np.stack([x[i + 1] for x, i in zip(self.axes, place, strict=True)], axis=1)
        share = (points_mm - low[:, None]) / (high - low)[:, None]
        up = corners(points_mm.shape[2]) > 0
        factors = np.where(up, share[:, :, None], 1.0 - share[:, :, None])
        weights: Floats = np.prod(factors, axis=3)
        return weights @ self.corner_mm[which, cell]


def _product(axes: list[Floats]) -> Floats:
    """All combinations of coordinates, last axis fastest, shape (n, d)."""
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


def _checked(axes_mm: list[ArrayLike]) -> list[Floats]:
    axes = [np.array(axis, float) for axis in axes_mm]
    if not axes or any(x.ndim != 1 or len(x) < 2 or not (np.diff(x) > 0).all() for x in axes):
        raise IksamplesError("the grid needs at least two ascending coordinates along every axis.")
    return axes
