"""How steep the trained map is: certified Lipschitz constants.

With h the map from a position to where the arm goes, its derivative is ``J(f(x)) f'(x)``.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iksamples.arm.chain import SerialChain
from iksamples.certify.enclosure import corners, expand
from iksamples.certify.layers import Layers
from iksamples.certify.residual import Comparison, ErrorOverBoxes, check_box
from iksamples.certify.search import Supremum, maximise
from iksamples.certify.slopes import network_slopes, slope_at
from iksamples.network import StackedMLP


Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_TRIES = 8
"""Random points tried in a promising box: a sign pattern may hold in a thin sliver only."""
_SLACK = 1e-9


def certify_lipschitz(
    network: StackedMLP,
    chain: SerialChain,
    lower_mm: ArrayLike,
    upper_mm: ArrayLike,
    *,
    minus_identity: bool = True,
    rtol: float = 0.01,
    seeds_mm: ArrayLike | None = None,
    max_boxes: int = 1_000_000,
    time_limit_s: float = 60.0,
    compare: Comparison | None = None,
) -> list[Supremum]:
    """Lipschitz constants of h - identity, or of h, over a box.

    Args:
        network: Stacked networks.
        chain: The arm.
        lower_mm: Lower corner of the box [mm], shape (in,).
        upper_mm: Upper corner of the box [mm], shape (in,).
        minus_identity: Whether the identity is subtracted: how fast the residual changes.
        rtol: The search ends once upper <= (1 + rtol) lower.
        seeds_mm: Points of the box worth trying, shape (n, in).
        max_boxes: Boxes to bound per network, at most.
        time_limit_s: Time to spend per network, at most [s].
        compare: What is compared; the first coordinates with the first inputs if None.

    Returns:
        One constant per network [mm/mm], in the Euclidean norm.
    """
    steepness = Steepness(network, chain, lower_mm, upper_mm, compare, minus_identity)
    return maximise(
        steepness,
        rtol=rtol,
        atol=_SLACK,
        seeds_mm=seeds_mm,
        max_boxes=max_boxes,
        time_limit_s=time_limit_s,
    )


def certify_slope(
    network: StackedMLP,
    lower_mm: ArrayLike,
    upper_mm: ArrayLike,
    *,
    rtol: float = 1e-6,
    max_boxes: int = 1_000_000,
    time_limit_s: float = 60.0,
) -> list[Supremum]:
    """``sup || df/dX ||_inf`` over a box: largest absolute row sum of the network's Jacobian.

    X is the normalised input (paper, Eq. 15 and 16). For a ReLU network the Jacobian takes finitely
    many values, and the result is the largest of them to within rounding.

    Args:
        network: Stacked networks.
        lower_mm: Lower corner of the box [mm], shape (in,).
        upper_mm: Upper corner of the box [mm], shape (in,).
        rtol: The search ends once upper <= (1 + rtol) lower.
        max_boxes: Boxes to bound per network, at most.
        time_limit_s: Time to spend per network, at most [s].

    Returns:
        One supremum per network [rad or mm, per unit of the normalised input].
    """
    slope = _NetworkSlope(network, lower_mm, upper_mm)
    return maximise(slope, rtol=rtol, atol=_SLACK, max_boxes=max_boxes, time_limit_s=time_limit_s)


class Steepness(ErrorOverBoxes):
    """The norm of the derivative of h, or of h - identity, as an objective."""

    def __init__(
        self,
        network: StackedMLP,
        chain: SerialChain,
        lower_mm: ArrayLike,
        upper_mm: ArrayLike,
        compare: Comparison | None,
        minus_identity: bool,
    ) -> None:
        """As ``ErrorOverBoxes``.

        Args:
            network: Stacked networks.
            chain: The arm.
            lower_mm: Lower corner of the region, shape (in,).
            upper_mm: Upper corner of the region, shape (in,).
            compare: What is compared.
            minus_identity: Whether the identity is subtracted.
        """
        super().__init__(network, chain, lower_mm, upper_mm, compare)
        self.minus_identity = minus_identity
        self.generator = np.random.default_rng(0)

    def values(self, which: Ints, points_mm: Floats) -> Floats:
        """Spectral norms at points; minus infinity at a kink, where there is no derivative."""
        slope, smooth = slope_at(self.layers, which, points_mm)
        _, jacobian, _ = self.linkage.jets(self.layers.predict(points_mm, which))
        derivative = slope @ jacobian[list(self.compare.coordinates)].transpose(1, 2, 0)
        self._subtract_identity(derivative)
        norms = np.sqrt(np.maximum(_largest_square(derivative) - 1e-14, 0.0))
        return np.where(smooth, norms, -np.inf)

    def upper_bounds(
        self, which: Ints, centre_mm: Floats, radius_mm: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Upper bounds of the norm over boxes; as in ``ErrorOverBoxes``."""
        boxes, d = centre_mm.shape
        slopes = network_slopes(self.layers, which, centre_mm, radius_mm)
        joints = expand(self.layers, which, centre_mm, radius_mm)
        _, jacobian, hessian = self.linkage.jets(joints.centre)
        rows = list(self.compare.coordinates)
        item = slopes.box
        gradient = jacobian[rows].transpose(1, 2, 0)  # (boxes, joints, coordinates)
        derivative = slopes.centre @ gradient[item]
        self._subtract_identity(derivative)
        hessian = hessian[rows].transpose(1, 0, 2, 3)
        hessian = hessian + hessian.transpose(0, 1, 3, 2)
        # How the Jacobian changes along each axis of the box: (boxes, axes, joints, coordinates).
        change = np.einsum("bkij,baj->baik", hessian, joints.linear)
        tilt = slopes.linear @ gradient[item][:, None]
        tilt += slopes.centre[:, None] @ change[item]

        # Everything else, by column of the derivative (input direction).
        sums = np.abs(self.linkage.angle_sums).T
        size = np.abs(slopes.centre) + np.abs(slopes.linear).sum(axis=1) + slopes.radius
        small = np.abs(slopes.linear).sum(axis=1) + slopes.radius
        straight = np.abs(joints.linear).sum(axis=1)
        rest = np.abs(joints.noise).sum(axis=1) + np.abs(joints.quadratic).sum(axis=1)
        turn, turn_rest = (self.linkage.turns(part @ sums)[item, None] for part in (straight, rest))
        turn_size, turn_small = (self.linkage.turns(part @ sums) for part in (size, small))
        lengths = self.linkage.lengths_mm(joints.centre)
        lengths = lengths[item][:, None] if len(lengths) > 1 else lengths[:, None]
        whole = turn + turn_rest
        loss = lengths * (
            turn_rest * turn_size + turn * turn_small + 0.5 * whole * whole * turn_size
        )
        if self.linkage.slides_at_all:
            shift, shift_rest = (
                self.linkage.shifts_mm(part)[item, None] for part in (straight, rest)
            )
            shift_size, shift_small = (self.linkage.shifts_mm(part) for part in (size, small))
            loss += turn_rest * shift_size + shift_rest * turn_size
            loss += turn * shift_small + shift * turn_small
            loss += (shift + shift_rest) * whole * turn_size + 0.5 * whole * whole * shift_size
        column = loss.sum(axis=2)
        column += np.linalg.norm(slopes.radius @ np.abs(gradient[item]), axis=2)

        at = (corners(d) @ tilt.reshape(len(item), d, -1)).reshape(len(item), -1, d, len(rows))
        at += derivative[:, None]
        norms = np.sqrt(_largest_square(at).max(axis=1)) + np.linalg.norm(column, axis=1) + _SLACK
        upper = slopes.largest_by_box(norms, boxes)
        points = _inside(self.generator, centre_mm, radius_mm)
        return upper, points, radius_mm / (self.upper_mm - self.lower_mm)

    def _subtract_identity(self, derivative: Floats) -> None:
        if self.minus_identity:
            inputs = list(self.compare.inputs)
            derivative[:, inputs, range(len(inputs))] -= 1.0


class _NetworkSlope:
    """The largest absolute row sum of the network's Jacobian as an objective."""

    def __init__(self, network: StackedMLP, lower_mm: ArrayLike, upper_mm: ArrayLike) -> None:
        self.layers = Layers.of(network)
        self.lower_mm, self.upper_mm = check_box(lower_mm, upper_mm, self.layers.n_inputs)
        self.n_networks = self.layers.n_networks
        self.generator = np.random.default_rng(0)

    def values(self, which: Ints, points_mm: Floats) -> Floats:
        """Row sums at points; minus infinity at a kink."""
        slope, smooth = slope_at(self.layers, which, points_mm)
        return np.where(smooth, self._row_sum(np.abs(slope)) * (1.0 - 1e-12), -np.inf)

    def upper_bounds(
        self, which: Ints, centre_mm: Floats, radius_mm: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Upper bounds of the row sum over boxes; as in ``ErrorOverBoxes``."""
        slopes = network_slopes(self.layers, which, centre_mm, radius_mm)
        signs = corners(centre_mm.shape[1])
        at = slopes.centre[:, None] + np.einsum("va,iabj->ivbj", signs, slopes.linear)
        sums = self._row_sum(np.abs(at).transpose(1, 0, 2, 3) + slopes.radius).max(axis=0)
        upper = slopes.largest_by_box(sums, len(which)) * (1.0 + 1e-12)
        points = _inside(self.generator, centre_mm, radius_mm)
        return upper, points, radius_mm / (self.upper_mm - self.lower_mm)

    def _row_sum(self, size: Floats) -> Floats:
        return np.einsum("...bj,b->...j", size, np.abs(self.layers.scale_mm)).max(axis=-1)


def _inside(generator: np.random.Generator, centre_mm: Floats, radius_mm: Floats) -> Floats:
    """Random points of boxes, shape (boxes, points, d)."""
    at = generator.uniform(-1.0, 1.0, (len(centre_mm), _TRIES, centre_mm.shape[1]))
    return centre_mm[:, None] + at * radius_mm[:, None]


def _largest_square(matrices: Floats) -> Floats:
    """Square of the spectral norm of matrices of up to three columns, shape (..., in, columns).

    The largest eigenvalue of the symmetric product in closed form (Smith 1961), which is much
    faster than a singular value decomposition for this many small matrices.
    """
    product = np.swapaxes(matrices, -1, -2) @ matrices
    n = product.shape[-1]
    if n == 1:
        return product[..., 0, 0]
    diagonal = np.einsum("...ii->...i", product)
    middle = diagonal.mean(axis=-1)
    upper = np.triu_indices(n, 1)
    off = np.sum(product[..., upper[0], upper[1]] ** 2, axis=-1)
    spread = np.sum((diagonal - middle[..., None]) ** 2, axis=-1) + 2.0 * off
    if n == 2:
        return middle + np.sqrt(spread / 2.0)
    scale = np.sqrt(spread / 6.0)
    shifted = product - middle[..., None, None] * np.eye(3)
    half_det = 0.5 * (
        shifted[..., 0, 0] * (shifted[..., 1, 1] * shifted[..., 2, 2] - shifted[..., 1, 2] ** 2)
        - shifted[..., 0, 1]
        * (shifted[..., 0, 1] * shifted[..., 2, 2] - shifted[..., 1, 2] * shifted[..., 0, 2])
        + shifted[..., 0, 2]
        * (shifted[..., 0, 1] * shifted[..., 1, 2] - shifted[..., 1, 1] * shifted[..., 0, 2])
    )
    cosine = np.clip(half_det / np.maximum(scale**3, np.finfo(float).tiny), -1.0, 1.0)
    return middle + 2.0 * scale * np.cos(np.arccos(cosine) / 3.0)
