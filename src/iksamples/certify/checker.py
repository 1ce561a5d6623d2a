"""An independent check of a certificate: exact tiling, and every bound again with all roundings.

Nothing here is shared with the search but the definition of what is certified:

    the supremum over a region, a union of closed boxes, of || P FK(N(x)) - x_I ||,

with N the network, its stored float32 weights and float64 offset and scale read as exact reals,
``N(x) = W_L act(... act(W_1 (x - offset) / scale + b_1) ...) + b_L``; FK the chain's product of
exponentials, its stored points and directions read as exact reals and each direction divided by its
exact length; P the compared coordinates and x_I the compared inputs; in real arithmetic. The claim
is about nothing outside the region. What evaluating the network in float32 adds to it is
``rounding.inference_slack_mm``.

The proof covers the region with leaves and encloses the residual over each: the network by the
affine (ReLU) or second-order (tanh) expansion plus bounded noise, the arm by its second-order
expansion plus a bound of the third derivative. Here that is done in ball arithmetic (``balls``),
with the arm's derivatives from products of its transformations and their derivatives.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from iksamples.arm.chain import SerialChain
from iksamples.certify.balls import (
    UNIT,
    Ball,
    norm_above,
    product_above,
    stack,
    sum_above,
    up,
)
from iksamples.certify.checker_arm import Arm
from iksamples.certify.checker_network import (
    Network,
    corners,
    mixed_pairs,
    network_terms,
)
from iksamples.certify.search import Certificate
from iksamples.certify.tiling import tiles
from iksamples.errors import IksamplesError
from iksamples.network import StackedMLP


Floats = NDArray[np.float64]

_BATCH = 512


@dataclass(frozen=True)
class Verification:
    """What the checker could prove.

    Attributes:
        upper_mm: No position of the region has a larger error [mm]; infinite where the leaves do
            not tile the region.
        lower_mm: The error at the certificate's worst position is at least this [mm].
        tiles: Whether the leaves tile the region exactly.
        verified: Whether the certificate's bounds are proved as they stand.
        leaves: Leaves checked.
    """

    upper_mm: float
    lower_mm: float
    tiles: bool
    verified: bool
    leaves: int


def verify(
    certificate: Certificate, network: StackedMLP, row: int, chain: SerialChain
) -> Verification:
    """Checks a certificate from its leaves.

    Args:
        certificate: What ``certify_sup(..., keep_leaves=True)`` gave.
        network: The stacked networks.
        row: Which of them it is for.
        chain: The arm.

    Raises:
        IksamplesError: The certificate was made without its leaves.
    """
    leaves = certificate.leaves
    if leaves is None:
        raise IksamplesError(
            "the certificate came without its leaves; certify with keep_leaves=True."
        )
    net = Network.of(network, row)
    arm = Arm(chain)
    region = certificate.region
    tiled = tiles(leaves.part, leaves.lower, leaves.upper, region.lower.shape)
    coordinates, inputs = list(certificate.compare.coordinates), list(certificate.compare.inputs)

    point = certificate.argmax_mm
    inside = bool(region.contains(point))
    miss = arm.position(net.answer(Ball.of(point[None])))[:, coordinates] - point[None, inputs]
    least = np.maximum(np.abs(miss.mid) - miss.rad, 0.0)
    lower = float(np.sqrt(np.sum(least**2)) * (1.0 - 32.0 * UNIT)) if inside else 0.0

    upper = lower
    for first in range(0, len(leaves.lower) if tiled else 0, _BATCH):
        some = slice(first, first + _BATCH)
        low, high = (Ball.of(walls[leaves.part[some]]) for walls in (region.lower, region.upper))
        # Shares of the edges are binary fractions: their half sums and differences are exact.
        middle = 0.5 * (leaves.lower[some] + leaves.upper[some])
        half = 0.5 * (leaves.upper[some] - leaves.lower[some])
        bounds = _bounds(
            net, arm, low + (high - low) * middle, (high - low) * half, coordinates, inputs
        )
        upper = max(upper, float(bounds.max()) if not np.isnan(bounds).any() else np.inf)
    if not tiled:
        upper = np.inf
    return Verification(
        upper,
        lower,
        tiled,
        bool(upper <= certificate.upper_mm and lower >= certificate.lower_mm),
        len(leaves.lower),
    )


def _bounds(
    net: Network, arm: Arm, centre: Ball, half: Ball, coordinates: list[int], inputs: list[int]
) -> Floats:
    """An upper bound of the residual's norm over each leaf."""
    d = centre.shape[1]
    joints = network_terms(net, centre, half)
    tip, first, second = arm.derivatives(joints.centre.mid)
    tip, first, second = tip[:, coordinates], first[:, :, coordinates], second[..., coordinates]

    linear = joints.linear @ first
    own = np.zeros((d, len(coordinates)))
    own[inputs, range(len(inputs))] = 1.0
    linear = linear - half[:, :, None] * own
    squares, mixed = joints.squares @ first, joints.mixed @ first
    noise = joints.factor @ first

    def curve(a: int, b: int) -> Ball:
        along = (second * joints.linear[:, b, None, :, None]).sum(2)
        return (along * joints.linear[:, a, :, None]).sum(1)

    squares = squares + stack([curve(a, a) * 0.5 for a in range(d)], 1)
    pairs = mixed_pairs(d)
    if pairs:
        mixed = mixed + stack([curve(a, b) for a, b in pairs], 1)

    signs = corners(d)
    at = (tip - centre[:, inputs])[:, None] + Ball.of(signs) @ linear
    if pairs:
        at = at + Ball.of(np.stack([signs[:, a] * signs[:, b] for a, b in pairs], 1)) @ mixed
    # Squares lie in [0, 1], a noise at a corner in [low, high].
    at = at + (squares * 0.5).sum(1)[:, None]
    spread = sum_above((squares * 0.5).magnitude(), 1)[:, None]
    middle, width = 0.5 * (joints.low + joints.high), 0.5 * (joints.high - joints.low)
    width = up(width + 2.0 * UNIT * (np.abs(joints.low) + np.abs(joints.high)))
    at = at + Ball.of(middle) @ noise
    spread = up(spread + product_above(width, noise.magnitude()))
    # The centre of the network's answer is known to within its radius.
    spread = up(spread + sum_above(joints.centre.rad[:, :, None] * first.magnitude(), 1)[:, None])
    beyond = arm.beyond(joints.centre.mid, joints, joints.rest())
    size = up(at.magnitude() + spread)
    return up(norm_above(size * size) + beyond).max(axis=1)
