"""How steep the trained map is: certified Lipschitz constants.

With h the map from a position to where the arm goes, its derivative is ``J(f(x)) f'(x)``. At a kink
of a ReLU network a box never becomes smooth however small it is, so the sign patterns of the few
neurons that change sign inside a box are gone through one by one.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iksamples.bounds.certificate.enclosure import corners, expand, third_derivative_bound
from iksamples.bounds.certificate.layers import Layers
from iksamples.bounds.certificate.residual import Comparison, ErrorOverBoxes, check_box
from iksamples.bounds.certificate.search import Supremum, maximise
from iksamples.robot.chain import SerialChain
from iksamples.training.network import StackedMLP


Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_PATTERNS = 4
"""Neurons of a box whose signs are gone through; further ones count as any slope in [0, 1]."""
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
    steepness = _Steepness(network, chain, lower_mm, upper_mm, compare, minus_identity)
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
    return maximise(
        slope, rtol=rtol, atol=_SLACK, max_boxes=max_boxes, time_limit_s=time_limit_s
    )


@dataclass(frozen=True, eq=False)
class Slopes:
    """The derivative of the networks over boxes, one item per box and sign pattern.

    ``f'(s) = centre + linear s`` to within ``radius``.

    Attributes:
        box: The box of each item, ascending, shape (items,).
        possible: Whether a position of the box may have the item's sign pattern, shape (items,).
        centre: By input and output, shape (items, d, joints) [per mm].
        linear: Factors of ``s_a``, shape (items, d, d, joints).
        radius: Shape (items, d, joints).
    """

    box: Ints
    possible: NDArray[np.bool_]
    centre: Floats
    linear: Floats
    radius: Floats

    def largest_by_box(self, values: Floats, boxes: int) -> Floats:
        """Largest value of the possible items of each box, shape (boxes,)."""
        starts = np.searchsorted(self.box, np.arange(boxes))
        largest = np.maximum.reduceat(np.where(self.possible, values, -np.inf), starts)
        # Some pattern holds; should rounding have ruled out all, none counts as ruled out.
        return np.where(np.isfinite(largest), largest, np.maximum.reduceat(values, starts))


def network_slopes(layers: Layers, which: Ints, centre_mm: Floats, radius_mm: Floats) -> Slopes:
    """Encloses the derivative of the networks over boxes.

    Args:
        layers: The networks.
        which: The network that each box is for, shape (boxes,).
        centre_mm: Centres [mm], shape (boxes, d).
        radius_mm: Half edges [mm], shape (boxes, d).
    """
    d = centre_mm.shape[1]
    hidden = [
        _before_activation(layers, depth, which, centre_mm, radius_mm)
        for depth in range(len(layers.weights) - 1)
    ]
    rates_linear = None
    if layers.activation == "relu":
        spreads = [(value, straight + other) for value, _, straight, other in hidden]
        box, rates, signs = _patterns(spreads, layers, which)
        possible = _possible(layers, which[box], centre_mm[box], radius_mm[box], rates, signs)
    else:
        box, rates, rates_linear = np.arange(len(which)), [], []
        possible = np.ones(len(box), bool)
        for value, linear, straight, other in hidden:
            spread = straight + other
            at = np.tanh(value)
            rate, bend = 1.0 - at * at, -2.0 * at * (1.0 - at * at)
            third = third_derivative_bound(value - spread, value + spread)
            rates.append((rate, np.abs(bend) * other + 0.5 * third * spread**2))
            rates_linear.append(bend[:, None] * linear)
    owner = which[box]
    centre = np.broadcast_to(
        layers.weight(0, owner) / layers.scale_mm[:, None], (len(box), d, layers.weights[0].shape[2])
    )
    linear = np.zeros((len(box), d, *centre.shape[1:]))
    radius = np.zeros(centre.shape)
    for depth, (rate, doubt) in enumerate(rates, start=1):
        # (rate + rate_a s_a +/- doubt) (centre + linear s +/- radius), to first order in s.
        largest = np.abs(centre) + np.abs(linear).sum(axis=1)
        fresh = rate[:, None] * radius + doubt[:, None] * (largest + radius)
        steeper = linear * rate[:, None, None]
        if rates_linear is not None:
            tilt = rates_linear[depth - 1]
            wide = np.abs(tilt).sum(axis=1)[:, None]
            fresh = fresh + wide * (np.abs(linear).sum(axis=1) + radius)
            steeper = steeper + tilt[:, :, None] * centre[:, None]
        weight = layers.weight(depth, owner)
        centre = (centre * rate[:, None]) @ weight
        linear = steeper @ weight[:, None]
        radius = fresh @ np.abs(weight)
    return Slopes(box, possible, centre, linear, radius)


def _before_activation(
    layers: Layers, depth: int, which: Ints, centre_mm: Floats, radius_mm: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Centre, linear part, bound of the linear part and of the rest of a hidden layer's sums."""
    cut = Layers(
        layers.weights[: depth + 1],
        layers.biases[: depth + 1],
        layers.activation,
        layers.offset_mm,
        layers.scale_mm,
    )
    sums = expand(cut, which, centre_mm, radius_mm)
    other = np.abs(sums.noise).sum(axis=1) + np.abs(sums.quadratic).sum(axis=1)
    return sums.centre, sums.linear, np.abs(sums.linear).sum(axis=1), other


def _patterns(
    hidden: list[tuple[Floats, Floats]], layers: Layers, which: Ints
) -> tuple[Ints, list[tuple[Floats, Floats]], list[Floats]]:
    """Items of boxes and sign patterns.

    Returns:
        The box of each item; slope and doubt of every neuron, by layer; the sign that the item
        supposes of every neuron, 0 where it supposes none, by layer.
    """
    rates, doubts, weights = [], [], []
    for depth, (value, spread) in enumerate(hidden, start=1):
        below, above = value - spread, value + spread
        unstable = (below < 0) & (above > 0)
        rates.append(np.where(unstable, 0.5, (below >= 0).astype(float)))
        doubts.append(np.where(unstable, 0.5, 0.0))
        outgoing = np.abs(layers.weight(depth, which)).sum(axis=2)
        weights.append(np.where(unstable, outgoing * spread, 0.0))
    if not hidden:
        return np.arange(len(which)), [], []
    widths = np.cumsum([rate.shape[1] for rate in rates])[:-1]
    rate, doubt = np.concatenate(rates, axis=1), np.concatenate(doubts, axis=1)
    weight = np.concatenate(weights, axis=1)
    k = min(_PATTERNS, weight.shape[1])
    neurons = np.argsort(-weight, axis=1)[:, :k]
    open_ones = np.take_along_axis(doubt, neurons, axis=1) > 0
    counts = 2 ** open_ones.sum(axis=1)  # open neurons come first, as they alone weigh anything
    box = np.repeat(np.arange(len(which)), counts)
    number = np.arange(len(box)) - np.repeat(np.cumsum(counts) - counts, counts)
    rate, doubt, sign = rate[box], doubt[box], np.zeros((len(box), rate.shape[1]))
    rows = np.arange(len(box))
    for j in range(k):
        mine = open_ones[box, j]
        neuron = neurons[box, j]
        rate[rows[mine], neuron[mine]] = (number[mine] >> j) & 1
        doubt[rows[mine], neuron[mine]] = 0.0
        sign[rows[mine], neuron[mine]] = 2.0 * ((number[mine] >> j) & 1) - 1.0
    parts = (np.split(values, widths, axis=1) for values in (rate, doubt, sign))
    rates, doubts, signs = parts
    return box, list(zip(rates, doubts, strict=True)), signs


def _possible(
    layers: Layers,
    which: Ints,
    centre_mm: Floats,
    radius_mm: Floats,
    rates: list[tuple[Floats, Floats]],
    signs: list[Floats],
) -> NDArray[np.bool_]:
    """Whether a position of the box may have the signs that an item supposes.

    Under the pattern every sum is affine, up to the neurons that no sign is supposed of. A pattern
    is impossible where one of its half spaces misses the box, or where a positive combination of
    two of them does: nearly parallel kinks would otherwise keep a search busy for ever.
    """
    items, d = centre_mm.shape
    value = ((centre_mm - layers.offset_mm) / layers.scale_mm)[:, None]
    linear = np.broadcast_to(np.eye(d) / layers.scale_mm, (items, d, d)) * radius_mm[:, :, None]
    doubt = np.zeros((items, 1, d))
    heights, slopes = [], []
    for depth, ((rate, rate_doubt), sign) in enumerate(zip(rates, signs, strict=True)):
        value = layers.through(value, depth, which)
        value[:, 0] += layers.bias(depth, which)
        linear = layers.through(linear, depth, which)
        doubt = doubt @ np.abs(layers.weight(depth, which))
        size = np.abs(linear).sum(axis=1, keepdims=True)
        scale = np.maximum(size + doubt, np.finfo(float).tiny)
        # Where a sign is supposed: height + slope s >= 0, scaled so that |slope| is about 1.
        heights.append(np.where(sign == 0, np.inf, ((sign[:, None] * value + doubt) / scale)[:, 0]))
        slopes.append(sign[:, None] * linear / scale)
        largest = np.abs(value) + size + doubt
        doubt = rate[:, None] * doubt + rate_doubt[:, None] * largest
        value, linear = value * rate[:, None], linear * rate[:, None]
    if not heights:
        return np.ones(items, bool)
    height, slope = np.concatenate(heights, axis=1), np.concatenate(slopes, axis=2)
    first = np.argsort(np.isinf(height), axis=1, kind="stable")[:, :_PATTERNS]
    height = np.take_along_axis(height, first, axis=1)
    slope = np.take_along_axis(slope, first[:, None], axis=2)
    possible = (height + np.abs(slope).sum(axis=1) >= -_SLACK).all(axis=1)
    for i in range(height.shape[1]):
        for j in range(i):
            for part in (0.2, 0.35, 0.5, 0.65, 0.8):
                tilt = part * slope[:, :, i] + (1.0 - part) * slope[:, :, j]
                top = part * height[:, i] + (1.0 - part) * height[:, j]
                possible &= top + np.abs(tilt).sum(axis=1) >= -_SLACK
    return possible


class _Steepness(ErrorOverBoxes):
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
        super().__init__(network, chain, lower_mm, upper_mm, compare)
        self.minus_identity = minus_identity
        self.generator = np.random.default_rng(0)

    def values(self, which: Ints, points_mm: Floats) -> Floats:
        """Spectral norms at points; minus infinity at a kink, where there is no derivative."""
        slope, smooth = _slope_at(self.layers, which, points_mm)
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
        slope, smooth = _slope_at(self.layers, which, points_mm)
        return np.where(smooth, self._row_sum(np.abs(slope)) * (1.0 - 1e-12), -np.inf)

    def upper_bounds(
        self, which: Ints, centre_mm: Floats, radius_mm: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Upper bounds of the row sum over boxes; as in ``ErrorOverBoxes``."""
        slopes = network_slopes(self.layers, which, centre_mm, radius_mm)
        at = slopes.centre[:, None] + np.einsum("va,iabj->ivbj", corners(len(centre_mm[0])), slopes.linear)
        sums = self._row_sum(np.abs(at).transpose(1, 0, 2, 3) + slopes.radius).max(axis=0)
        upper = slopes.largest_by_box(sums, len(which)) * (1.0 + 1e-12)
        points = _inside(self.generator, centre_mm, radius_mm)
        return upper, points, radius_mm / (self.upper_mm - self.lower_mm)

    def _row_sum(self, size: Floats) -> Floats:
        return np.einsum("...bj,b->...j", size, np.abs(self.layers.scale_mm)).max(axis=-1)


def _slope_at(
    layers: Layers, which: Ints, points_mm: Floats
) -> tuple[Floats, NDArray[np.bool_]]:
    """The networks' derivatives at points, shape (points, in, joints), and where they exist."""
    hidden = ((points_mm - layers.offset_mm) / layers.scale_mm)[:, None, :]
    slope = np.broadcast_to(
        np.diag(1.0 / layers.scale_mm), (len(points_mm), layers.n_inputs, layers.n_inputs)
    )
    smooth = np.ones(len(points_mm), bool)
    for depth in range(len(layers.weights)):
        hidden = layers.through(hidden, depth, which)
        hidden[:, 0] += layers.bias(depth, which)
        slope = layers.through(slope, depth, which)
        if depth < len(layers.weights) - 1:
            if layers.activation == "relu":
                smooth &= (np.abs(hidden[:, 0]) > 1e-12).all(axis=1)
                rate = (hidden > 0).astype(float)
                hidden = np.maximum(hidden, 0.0)
            else:
                hidden = np.tanh(hidden)
                rate = 1.0 - hidden * hidden
            slope = slope * rate
    return slope, smooth


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
    off = np.sum(np.triu(product, 1) ** 2, axis=(-1, -2))
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
