"""The checker's own enclosures in ball arithmetic: of a network, and of a look-up table."""

from dataclasses import dataclass
from itertools import accumulate, combinations, pairwise

import numpy as np
from numpy.typing import NDArray

from iksamples.certify.balls import (
    UNIT,
    Ball,
    join,
    stack,
    sum_above,
    up,
)
from iksamples.certify.table import Table
from iksamples.errors import IksamplesError
from iksamples.network import StackedMLP


Floats = NDArray[np.float64]

AT_ONCE = 512
"""Leaves that are enclosed at once."""
_NUMBERS = 2**25
"""Fewer where a network is so wide that its noise would be more numbers than these."""


@dataclass(frozen=True, eq=False)
class Network:
    """One network; everything is known exactly."""

    weights: list[Floats]
    biases: list[Floats]
    activation: str
    offset: Floats
    scale: Floats

    @classmethod
    def of(cls, network: StackedMLP, row: int) -> "Network":
        """One network of a stack; float32 numbers are float64 numbers.

        Raises:
            IksamplesError: It is no network that is known here, or not all of it is finite.
        """
        weights = [np.array(weight[row], np.float64) for weight in network.weights]
        biases = [np.array(bias[row], np.float64) for bias in network.biases]
        offset, scale = (np.array(v, np.float64) for v in (network.offset, network.scale))
        widths = [len(offset), *(len(bias) for bias in biases)]
        if not (
            0 <= row < network.n_seeds
            and network.activation in ("relu", "tanh")
            and [weight.shape for weight in weights] == list(pairwise(widths))
            and offset.shape == scale.shape
            and all(np.isfinite(v).all() for v in (*weights, *biases, offset, scale))
            and scale.all()
        ):
            raise IksamplesError("the checker knows only finite networks of relu or tanh layers.")
        return cls(weights, biases, network.activation, offset, scale)

    @property
    def n_inputs(self) -> int:
        """Width of the input."""
        return len(self.offset)

    @property
    def n_outputs(self) -> int:
        """Width of the output."""
        return len(self.biases[-1])

    @property
    def at_once(self) -> int:
        """Leaves to enclose at once: each neuron's noise is carried through all layers after it."""
        widths = [weight.shape[1] for weight in self.weights[:-1]]
        carried = (n * width for n, width in zip(accumulate(widths), widths, strict=True))
        return max(1, min(AT_ONCE, _NUMBERS // max(carried, default=1)))

    def terms(self, centre: Ball, half: Ball) -> "Terms":
        """The network over leaves."""
        return _network_terms(self, centre, half)

    def answer(self, positions: Ball) -> Ball:
        """Joint values at points, shape (points, joints)."""
        hidden = (positions - self.offset) / self.scale
        for depth, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            hidden = hidden @ weight + bias
            if depth + 1 < len(self.weights):
                if self.activation == "tanh":
                    hidden = hidden.tanh()
                else:
                    shut = hidden.upper() <= 0
                    hidden = Ball(np.maximum(hidden.mid, 0.0), np.where(shut, 0.0, hidden.rad))
        return hidden


@dataclass(frozen=True, eq=False)
class Terms:
    """centre + linear s + squares s_a^2 + mixed s_a s_b + noise, by leaf and value.

    Noise k is a factor times a number in [-size_k, size_k], which at corner v of the leaf is known
    to lie in [from_vk, to_vk].
    """

    centre: Ball  # (leaves, values)
    linear: Ball  # (leaves, d, values)
    squares: Ball  # (leaves, d, values)
    mixed: Ball  # (leaves, pairs, values)
    factor: Ball  # (leaves, noises, values)
    size: Floats  # (leaves, noises)
    low: Floats  # (leaves, corners, noises)
    high: Floats  # (leaves, corners, noises)

    def then(self, weight: Floats, bias: Floats) -> "Terms":
        """The terms of an affine map of the values."""
        return Terms(
            self.centre @ weight + bias,
            self.linear @ weight,
            self.squares @ weight,
            self.mixed @ weight,
            self.factor @ weight,
            self.size,
            self.low,
            self.high,
        )

    def straight(self) -> Floats:
        """Bound of the linear part."""
        return sum_above(self.linear.magnitude(), 1)

    def rest(self) -> Floats:
        """Bound of all that is neither constant nor linear, with the centre's radius."""
        noise = sum_above(self.factor.magnitude() * self.size[:, :, None], 1)
        bent = sum_above(self.squares.magnitude(), 1) + sum_above(self.mixed.magnitude(), 1)
        return up(noise + bent + self.centre.rad)


def corners(d: int) -> Floats:
    """All sign vectors, shape (2^d, d)."""
    return np.asarray(1.0 - 2.0 * ((np.arange(2**d)[:, None] >> np.arange(d)) & 1), float)


def mixed_pairs(d: int) -> list[tuple[int, int]]:
    """The products of two different variables."""
    return [(a, b) for a in range(d) for b in range(a + 1, d)]


def _network_terms(net: Network, centre: Ball, half: Ball) -> Terms:
    """The network over leaves."""
    leaves, d = centre.shape
    start = (centre - net.offset) / net.scale
    edges = half / net.scale
    none = np.zeros((leaves, 0))
    signs = len(corners(d))
    wide = Ball.of(np.zeros((leaves, d, d))) + edges[:, :, None] * np.eye(d)
    terms = Terms(
        start,
        wide,
        Ball.of(np.zeros((leaves, d, d))),
        Ball.of(np.zeros((leaves, len(mixed_pairs(d)), d))),
        Ball.of(np.zeros((leaves, 0, d))),
        none,
        np.zeros((leaves, signs, 0)),
        np.zeros((leaves, signs, 0)),
    ).then(net.weights[0], net.biases[0])
    bend = _bend_tanh if net.activation == "tanh" else _bend_relu
    for weight, bias in zip(net.weights[1:], net.biases[1:], strict=True):
        terms = bend(terms).then(weight, bias)
    return terms


def _bend_relu(z: Terms) -> Terms:
    """ReLU: for any slope a in [0, 1], max(0, z) = a z + g, 0 <= g <= max((1 - a) u, -a l)."""
    d = z.linear.shape[1]
    far = up(z.straight() + z.rest())
    lowest = np.minimum((z.centre - far).lower(), 0.0)
    highest = np.maximum((z.centre + far).upper(), 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        slope = np.where(
            lowest >= 0, 1.0, np.where(highest <= 0, 0.0, highest / (highest - lowest))
        )
    slope = np.clip(slope, 0.0, 1.0)
    flat = up(1.0 - slope)
    gap = np.where(
        (lowest < 0) & (highest > 0), up(np.maximum(flat * highest, -slope * lowest)), 0.0
    )
    at = Ball.of(corners(d)) @ z.linear + z.centre[:, None]
    rest = z.rest()[:, None]
    most = up(
        np.maximum(
            flat[:, None] * np.maximum((at + rest).upper(), 0.0),
            slope[:, None] * np.maximum(-(at - rest).lower(), 0.0),
        )
    )
    # The noise is g - gap / 2.
    middle = 0.5 * gap
    low = np.broadcast_to(-middle[:, None], most.shape)
    rounding = 4.0 * UNIT * (most + middle[:, None])
    high = np.minimum(most - middle[:, None] + rounding, middle[:, None])
    return _with_noise(
        z, Ball.of(slope), z.centre * slope + middle, None, middle, low, np.maximum(high, low)
    )


def _bend_tanh(z: Terms) -> Terms:
    """tanh, to second order in the linear part; everything else is noise."""
    d = z.linear.shape[1]
    value = Ball.of(z.centre.mid).tanh()
    slope = 1.0 - value * value
    bend = -(value * slope)  # half the second derivative
    straight, rest = z.straight(), z.rest()
    third = _third_derivative(Ball(z.centre.mid, up(straight + rest)))

    def left_out(size: Floats, rest: Floats, bend: Floats, third: Floats) -> Floats:
        total = up(size + rest)
        return up(bend * rest * (2.0 * size + rest) + third * total * total * total / 6.0)

    gap = left_out(straight, rest, bend.magnitude(), third)
    at = (Ball.of(corners(d)) @ z.linear).magnitude()
    most = left_out(at, rest[:, None], bend.magnitude()[:, None], third[:, None])
    return _with_noise(z, slope, value, bend, gap, -most, most, drift=z.centre.rad)


def _with_noise(
    z: Terms,
    slope: Ball,
    centre: Ball,
    bend: Ball | None,
    size: Floats,
    low: Floats,
    high: Floats,
    drift: Floats | None = None,
) -> Terms:
    """The activation's own terms: everything times the slope, and a noise of each neuron's own."""
    d, width = z.linear.shape[1:]
    squares, mixed = z.squares * slope[:, None], z.mixed * slope[:, None]
    if bend is not None:
        product = [z.linear[:, a] * z.linear[:, b] * 2.0 for a, b in mixed_pairs(d)]
        squares = squares + z.linear * z.linear * bend[:, None]
        if product:
            mixed = mixed + stack(product, 1) * bend[:, None]
    if drift is not None:  # the centre's own radius passes at the slope's rate, at most 1
        centre = Ball(centre.mid, up(centre.rad + drift))
    own = Ball.of(np.broadcast_to(np.eye(width), (len(size), width, width)))
    return Terms(
        centre,
        z.linear * slope[:, None],
        squares,
        mixed,
        join([z.factor * slope[:, None], own], 1),
        np.concatenate([z.size, size], axis=1),
        np.concatenate([z.low, low], axis=2),
        np.concatenate([z.high, high], axis=2),
    )


def _third_derivative(z: Ball) -> Floats:
    """Largest |tanh'''| over balls.

    It is 2 (1 - w) |3 w - 1| with w = tanh^2, largest at an end or at w = 2/3 (where it is 2/3).
    """
    low, high = Ball.of(z.lower()).tanh().lower(), Ball.of(z.upper()).tanh().upper()
    crosses = (low <= 0) & (high >= 0)
    least = np.where(crosses, 0.0, np.minimum(np.abs(low), np.abs(high)))
    most = np.maximum(np.abs(low), np.abs(high))
    least, most = least * least * (1.0 - 8.0 * UNIT), np.minimum(up(most * most), 1.0)

    def curve(w: Floats) -> Floats:
        return up(2.0 * up(1.0 - w) * up(np.abs(3.0 * w - 1.0) + 8.0 * UNIT))

    peak = np.nextafter(2.0 / 3.0, 1.0)
    peak = np.where((least <= peak) & (most >= np.nextafter(2.0 / 3.0, 0.0)), peak, 0.0)
    return np.maximum(np.maximum(curve(least), curve(most)), peak)


class CheckedTable:
    """A look-up table whose nodes and joint values are known exactly."""

    at_once = AT_ONCE

    def __init__(self, table: Table) -> None:
        """Refuses what is no table.

        Raises:
            IksamplesError: Nodes do not increase, or a number is not finite.
        """
        self.axes = [np.array(axis, np.float64) for axis in table.axes]
        self.joints = np.array(table.joints, np.float64)
        if not (
            self.joints.shape[:-1] == tuple(len(axis) for axis in self.axes)
            and np.isfinite(self.joints).all()
            and all(np.isfinite(axis).all() and (np.diff(axis) > 0).all() for axis in self.axes)
            and min(self.joints.shape[:-1]) > 1
        ):
            raise IksamplesError("the checker knows only finite tables on increasing nodes.")

    @property
    def n_inputs(self) -> int:
        """Number of inputs."""
        return len(self.axes)

    @property
    def n_outputs(self) -> int:
        """Number of joints."""
        return self.joints.shape[-1]

    def answer(self, positions: Ball) -> Ball:
        """Joint values at points, shape (points, joints)."""
        return self.terms(positions, Ball.of(np.zeros(positions.shape))).centre

    def terms(self, centre: Ball, half: Ball) -> Terms:
        """The table over leaves: in each a polynomial that is linear in every variable.

        Each leaf lies in one cell, since regions are cut at the nodes; where rounding hides in
        which, it gets NaN, which proves nothing. Products of up to two variables are kept; those of
        more are noise, of a factor that is known exactly at the corners.
        """
        leaves, d = centre.shape
        cells = [
            np.searchsorted(axis[1:-1], centre.mid[:, i], side="right")
            for i, axis in enumerate(self.axes)
        ]
        for i, axis in enumerate(self.axes):
            edges = np.concatenate([[-np.inf], axis[1:-1], [np.inf]])
            exact = centre.rad[:, i] == 0
            low = np.where(exact, centre.mid[:, i], centre[:, i].lower())
            high = np.where(exact, centre.mid[:, i], centre[:, i].upper())
            lost = (low < edges[cells[i]]) | (high > edges[cells[i] + 1])
            half = Ball(np.where(lost[:, None], np.nan, half.mid), half.rad)
        index = tuple(cells[i].reshape(-1, *[1] * d) + np.indices((2,) * d)[i] for i in range(d))
        polynomial: dict[tuple[int, ...], Ball] = {(): Ball.of(self.joints[index])}
        for i, axis in enumerate(self.axes):
            low, high = axis[cells[i]], axis[cells[i] + 1]
            length = Ball.of(high) - low
            mid = 1.0 / length.mid
            inverse = Ball(mid, up(8.0 * UNIT * np.abs(mid)))  # the length is right to UNIT
            start, slope = (centre[:, i] - low) * inverse, half[:, i] * inverse
            grown: dict[tuple[int, ...], Ball] = {}
            for variables, values in polynomial.items():
                apart = values[:, 1] - values[:, 0]
                shape = (-1, *[1] * (len(apart.shape) - 1))
                begin, along = (
                    Ball(b.mid.reshape(shape), b.rad.reshape(shape)) for b in (start, slope)
                )
                grown[variables] = values[:, 0] + begin * apart
                grown[(*variables, i)] = along * apart
            polynomial = grown

        nothing = Ball.of(np.zeros((leaves, 0, self.n_outputs)))
        higher = [v for k in range(3, d + 1) for v in combinations(range(d), k)]
        pairs = mixed_pairs(d)
        signs = corners(d)
        known = np.array([[np.prod(s[list(v)]) for v in higher] for s in signs])
        known = np.broadcast_to(known.reshape(len(signs), -1), (leaves, len(signs), len(higher)))
        return Terms(
            polynomial[()],
            stack([polynomial[(i,)] for i in range(d)], 1),
            Ball.of(np.zeros((leaves, d, self.n_outputs))),
            stack([polynomial[pair] for pair in pairs], 1) if pairs else nothing,
            stack([polynomial[v] for v in higher], 1) if higher else nothing,
            np.ones((leaves, len(higher))),
            known,
            known,
        )
