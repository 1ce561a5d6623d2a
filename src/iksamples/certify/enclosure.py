"""What a network answers over a box: a polynomial of the position plus bounded noise."""

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray


if TYPE_CHECKING:
    from iksamples.certify.layers import Layers

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
_Symbols = tuple[Floats, Floats, Floats]

_TINY = float(np.finfo(float).tiny)


@dataclass(frozen=True, eq=False)
class Expansion:
    """Values over a box as a polynomial of ``s`` in [-1, 1]^d plus noise.

    Noise symbol k lies in [-1, 1] everywhere. At a position s it is known better: within
    ``reach_k(s)`` of ``reach_k(s) - 1`` where ``one_sided``, else within ``reach_k(s)`` of zero.
    The reach is convex in s and given at the corners; its uses are convex too, so corners suffice.
    Its mean over the box is bounded apart, since that at the corners is several times as large.

    Attributes:
        centre: Constant part, shape (batch, values).
        linear: Factors of ``s_a``, shape (batch, d, values).
        quadratic: Factors of ``s_a s_b`` for the pairs of ``pairs(d)``, shape (batch, pairs,
            values); no pairs at all for a ReLU network.
        noise: One row per symbol, shape (batch, symbols, values).
        reach: In [0, 1], in the order of ``corners(d)``, shape (batch, corners, symbols).
        mean_reach: At least the mean of the reach over the box, shape (batch, 1, symbols); no row
            where it was not asked for.
        one_sided: Whether the symbols lean to one side.
        shares: Which share of a symbol is due to the extent of the box along each axis, roughly,
            shape (batch, d, symbols).
    """

    centre: Floats
    linear: Floats
    quadratic: Floats
    noise: Floats
    reach: Floats
    mean_reach: Floats
    one_sided: bool
    shares: Floats


@lru_cache(maxsize=16)
def corners(d: int) -> Floats:
    """The corners of [-1, 1]^d, shape (2^d, d)."""
    return np.stack(np.meshgrid(*[[-1.0, 1.0]] * d, indexing="ij"), axis=-1).reshape(-1, d)


def half_of_corners(d: int) -> Floats:
    """The corners before the middle, shape (2^(d - 1), d); the others are their opposites.

    What is the same at opposite corners need only be worked out here (``mirrored``).
    """
    return corners(d)[: 2 ** (d - 1)]


def mirrored(values: Floats) -> Floats:
    """Values of half of the corners (batch, corners, ...) for all, in the order of ``corners``."""
    return np.concatenate([values, values[:, ::-1]], axis=1)


def sizes(linear: Floats, average: bool) -> Floats:
    """Size of ``v = linear s`` at half of the corners and, if asked, last its cubic mean at most.

    The cubic mean is ``(mean of |v|^3)^(1/3)``, and the mean of ``|v|^3`` is at most the root of
    those of ``v^2`` and ``v^4``. Cubic means of sums are at most the sums of cubic means, and means
    of lower powers are smaller: a polynomial of degree three in such sizes, without negative
    factors, is on average at most what it is of cubic means.

    Args:
        linear: Factors of ``s_a``, shape (batch, d, values).
        average: Whether the mean is asked for, which takes longer than the rest.

    Returns:
        Shape (batch, 2^(d - 1) + average, values).
    """
    ends = np.abs(half_of_corners(linear.shape[1]) @ linear)
    if not average:
        return np.asarray(ends)
    square = linear * linear
    total = square.sum(axis=1)
    fourth = total * total / 3.0 - (2.0 / 15.0) * np.einsum("bav,bav->bv", square, square)
    mean = np.cbrt(np.sqrt(total / 3.0 * fourth))
    return np.concatenate([ends, mean[:, None]], axis=1)


@lru_cache(maxsize=16)
def _with_constant(d: int) -> Floats:
    """The corners with a one in front, shape (2^d, 1 + d)."""
    return np.concatenate([np.ones((2**d, 1)), corners(d)], axis=1)


@lru_cache(maxsize=16)
def pairs(d: int) -> tuple[Ints, Ints]:
    """The squares, then the mixed products, of d variables."""
    mixed = np.triu_indices(d, 1)
    return np.concatenate([np.arange(d), mixed[0]]), np.concatenate([np.arange(d), mixed[1]])


def expand(
    layers: "Layers", which: Ints, centre_mm: Floats, radius_mm: Floats, average: bool
) -> Expansion:
    """Encloses the networks' answers over boxes.

    Args:
        layers: The networks.
        which: The network that each box is for, shape (boxes,).
        centre_mm: Centres [mm], shape (boxes, d).
        radius_mm: Half edges [mm], shape (boxes, d).
        average: Whether means over the boxes are asked for.

    Returns:
        Expansions of the joint values.
    """
    batch, d = centre_mm.shape
    relu = layers.activation == "relu"
    split = (1 + d, 1 + d if relu else 1 + d + len(pairs(d)[0]))

    centre = (centre_mm - layers.offset) / layers.scale
    linear = (radius_mm / layers.scale)[:, :, None] * layers.weight(0, which)
    rows = np.zeros((batch, split[1], linear.shape[2]))
    rows[:, :1] = layers.through(centre[:, None, :], 0, which)
    rows[:, 1 : split[0]] = linear
    rows[:, 0] += layers.bias(0, which)
    reaches, shares = [], []
    for depth in range(1, len(layers.weights)):
        # A new symbol touches one neuron, so its row of the next layer is a scaled row of weights.
        apply = _relu if relu else _tanh
        added, reach, share = apply(rows, split, layers.weight(depth, which), average)
        reaches.append(reach)
        shares.append(share)
        rows = np.concatenate([layers.through(rows, depth, which), added], axis=1)
        rows[:, 0] += layers.bias(depth, which)
    at_corners = 2**d if relu else 2 ** (d - 1)
    reach = np.zeros((batch, at_corners + average, 0))
    reach = np.concatenate([reach, *reaches], axis=2)
    reach, mean_reach = reach[:, :at_corners], reach[:, at_corners:]
    return Expansion(
        rows[:, 0],
        rows[:, 1 : split[0]],
        rows[:, split[0] : split[1]],
        rows[:, split[1] :],
        reach if relu else mirrored(reach),
        mean_reach,
        relu,
        np.concatenate(shares, axis=2) if shares else np.zeros((batch, d, 0)),
    )


def _relu(rows: Floats, split: tuple[int, int], weight: Floats, average: bool) -> _Symbols:
    """Applies ReLU in place; returns the new symbols' next rows, reach (last its mean), shares.

    For z in [l, u], l < 0 < u, and slope a = u / (u - l): max(0, z) = a z + g(z) with
    0 <= g(z) = max((1 - a) z, -a z) <= w = -l u / (u - l). The new symbol is 2 g / w - 1. As g is
    convex, its largest value over the noise in z is at an end, and that is convex in s.

    Args:
        rows: The sums before the activation.
        split: Where the quadratic rows and the noise begin.
        weight: Weights of the next layer, shape (batch or 1, in, out).
    """
    size = np.abs(rows[:, 1:])
    straight = size[:, : split[0] - 1].sum(axis=1)
    other = size[:, split[1] - 1 :].sum(axis=1)
    below = np.minimum(rows[:, 0] - straight - other, 0.0)
    above = np.maximum(rows[:, 0] + straight + other, 0.0)
    slope = above / np.maximum(above - below, _TINY)
    # Both are -l u / (2 (u - l)) but for rounding, and for a slope that underflows.
    half = 0.5 * np.maximum(-slope * below, (1.0 - slope) * above)

    # Only neurons that change sign somewhere in a box make noise: gather them. None is too small to
    # count, since the next weights may be of any size.
    open_ones = (below < 0) & (above > 0)
    half = np.where(open_ones, np.maximum(half, _TINY), 0.0)
    most = int(open_ones.sum(axis=1).max(initial=0))
    part = np.argsort(~open_ones, axis=1, kind="stable")[:, :most]
    known = np.take_along_axis(rows[:, : split[0]], part[:, None], axis=2)
    own_slope, own_half, own_other, own_straight = (
        np.take_along_axis(values, part, axis=1) for values in (slope, half, other, straight)
    )
    # At a corner: (1 - a) (z + other) and -a (z - other), over w.
    own_open = np.take_along_axis(open_ones, part, axis=1)
    scale = np.where(own_open, 0.5 / np.maximum(own_half, _TINY), 0.0)
    known[:, 0] += own_other
    reach = _with_constant(split[0] - 1) @ (known * (scale * (1.0 - own_slope))[:, None])
    known[:, 0] -= 2.0 * own_other
    np.maximum(
        reach, _with_constant(split[0] - 1) @ (known * (-scale * own_slope)[:, None]), out=reach
    )
    np.minimum(reach, 1.0, out=reach)
    share = np.abs(known[:, 1:]) / np.maximum(own_straight, _TINY)[:, None]

    rows *= slope[:, None, :]
    rows[:, 0] += half
    outgoing = weight[0][part] if len(weight) == 1 else weight[np.arange(len(rows))[:, None], part]
    if average:
        reach = np.concatenate([reach, reach.mean(axis=1, keepdims=True)], axis=1)
    return own_half[:, :, None] * outgoing, reach, share


def _tanh(rows: Floats, split: tuple[int, int], weight: Floats, average: bool) -> _Symbols:
    """Applies tanh in place; returns the new symbols' next rows, reach (last its mean), shares.

    With z = z0 + v + e, v the linear part and |e| <= o the rest: tanh z = t0 + t1 (v + e)
    + t2 v^2 / 2 + r, |r| <= |t2| (2 |v| + o) o / 2 + max |tanh'''| (|v| + o)^3 / 6.
    """
    linear = rows[:, 1 : split[0]]
    share = np.abs(linear)
    straight = share.sum(axis=1)
    share /= np.maximum(straight, _TINY)[:, None]
    other = np.abs(rows[:, split[0] :]).sum(axis=1)
    value = np.tanh(rows[:, 0])
    slope = 1.0 - value * value
    half_bend = -value * slope
    ends = straight + other
    third = third_derivative_bound(rows[:, 0] - ends, rows[:, 0] + ends) / 6.0

    bend = np.abs(half_bend) * other
    half = bend * (2.0 * straight + other) + third * ends**3
    # At a corner, over half, with x = |v| + o: (2 bend + third x^2) x - bend o. So too on average.
    scale = 1.0 / np.maximum(half, _TINY)
    size = sizes(linear, average) + other[:, None]
    reach = size * size
    reach *= (third * scale)[:, None]
    reach += (2.0 * bend * scale)[:, None]
    reach *= size
    reach -= (bend * other * scale)[:, None]
    np.clip(reach, 0.0, 1.0, out=reach)

    first, second = pairs(split[0] - 1)
    product = linear[:, first] * linear[:, second]
    product[:, split[0] - 1 :] *= 2.0
    rows[:, 0] = value
    rows[:, 1:] *= slope[:, None, :]
    rows[:, split[0] : split[1]] += half_bend[:, None, :] * product
    return half[:, :, None] * weight, reach, share


def third_derivative_bound(lower: Floats, upper: Floats) -> Floats:
    """Largest |tanh'''| = 2 (1 - t^2) |3 t^2 - 1| on [lower, upper], with t = tanh.

    It is taken at an end, at 0 (where it is 2), or where t^2 = 2/3 (where it is 2/3).
    """
    ends = np.maximum(_third(np.tanh(lower)), _third(np.tanh(upper)))
    turn = np.arctanh(np.sqrt(2.0 / 3.0))
    inner = ((lower < turn) & (upper > turn)) | ((lower < -turn) & (upper > -turn))
    ends = np.where(inner, np.maximum(ends, 2.0 / 3.0), ends)
    return np.where((lower <= 0) & (upper >= 0), 2.0, ends)


def _third(t: Floats) -> Floats:
    square = t * t
    return 2.0 * (1.0 - square) * np.abs(3.0 * square - 1.0)
