"""What a network's derivative can be over a box.

At a kink of a ReLU network a box never becomes smooth however small it is, so the sign patterns of
the few neurons that change sign inside a box are gone through one by one.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from iksamples.certify.enclosure import expand, third_derivative_bound
from iksamples.certify.layers import Layers


Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_PATTERNS = 4
"""Neurons of a box whose signs are gone through; further ones count as any slope in [0, 1]."""
_SLACK = 1e-9


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
    first = layers.weight(0, owner) / layers.scale_mm[:, None]
    centre = np.broadcast_to(first, (len(box), *first.shape[1:]))
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


def slope_at(layers: Layers, which: Ints, points_mm: Floats) -> tuple[Floats, NDArray[np.bool_]]:
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
