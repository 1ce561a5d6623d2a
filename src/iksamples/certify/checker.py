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
from iksamples.certify.residual import Comparison
from iksamples.certify.search import Leaves
from iksamples.certify.tiling import tiles
from iksamples.errors import IksamplesError
from iksamples.network import StackedMLP
from iksamples.region import Region


Floats = NDArray[np.float64]

_BATCH = 512


@dataclass(frozen=True, eq=False)
class Claim:
    """What is claimed of a network; said by whoever asks, never by a certificate.

    Attributes:
        network: Stacked networks.
        row: Which of them it is about.
        chain: The arm.
        region: The inputs that it is about.
        upper: No input of the region has a larger error [mm].
        lower: The error at ``argmax`` is at least this [mm].
        argmax: An input of the region, shape (d,); None where nothing is claimed of one.
        compare: What is compared; the first coordinates with the first inputs if None.
    """

    network: StackedMLP
    row: int
    chain: SerialChain
    region: Region
    upper: float
    lower: float = 0.0
    argmax: Floats | None = None
    compare: Comparison | None = None


@dataclass(frozen=True)
class Verification:
    """What the checker could prove.

    Attributes:
        upper: No input of the region has a larger error [mm]; infinite where the leaves do not tile
            the region. This holds whether the claim does or not.
        lower: The error at the claim's point is at least this [mm].
        verified: Whether the claim is proved as it stands.
        leaves: Leaves checked; none where they do not tile the region.
    """

    upper: float
    lower: float
    verified: bool
    leaves: int


def verify(claim: Claim, leaves: Leaves | None) -> Verification:
    """Proves a claim from leaves, or does not.

    Args:
        claim: What is to be proved.
        leaves: Boxes over each of which the error is to be bounded (``certify_sup(...,
            keep_leaves=True).leaves``). Only where they lie is looked at, and nothing of it is
            trusted.

    Raises:
        IksamplesError: There are no leaves; network, arm, region and what is compared do not fit
            together; or a number of the network is not finite.
    """
    if leaves is None:
        raise IksamplesError("there are no leaves to prove it from; certify with keep_leaves=True.")
    net, arm, region = Network.of(claim.network, claim.row), Arm(claim.chain), claim.region
    compare = claim.compare or Comparison.default(region.n_inputs)
    compare.check(net.n_inputs)
    if (net.n_inputs, net.n_outputs) != (region.n_inputs, arm.n):
        raise IksamplesError(
            f"a network of {net.n_inputs} inputs and {net.n_outputs} outputs does not fit a region "
            f"of {region.n_inputs} inputs and an arm of {arm.n} joints."
        )
    with np.errstate(all="ignore"):  # what overflows is no bound
        lower = _attained(net, arm, claim, compare)
        upper = _largest(net, arm, region, leaves, compare)
    return Verification(
        upper,
        lower,
        bool(lower >= claim.lower and upper <= claim.upper < np.inf),
        len(leaves.part) if upper < np.inf else 0,
    )


def _attained(net: Network, arm: Arm, claim: Claim, compare: Comparison) -> float:
    """At least this is the error at the claim's point; zero where it is not of the region."""
    point = np.atleast_2d(np.asarray(claim.argmax, float))
    if point.shape != (1, claim.region.n_inputs) or not claim.region.contains(point).all():
        return 0.0
    miss = arm.position(net.answer(Ball.of(point)))[:, compare.coordinates]
    miss = miss - point[:, compare.inputs]
    least = np.maximum(np.abs(miss.mid) - miss.rad, 0.0)
    length = float(np.sqrt(np.sum(least**2)) * (1.0 - 32.0 * UNIT))
    return length if np.isfinite(length) else 0.0


def _largest(net: Network, arm: Arm, region: Region, leaves: Leaves, compare: Comparison) -> float:
    """At most this is the error anywhere in the region; infinite if the leaves do not prove it."""
    if not tiles(leaves.part, leaves.lower, leaves.upper, region.lower.shape):
        return np.inf
    upper = 0.0
    for first in range(0, len(leaves.part), _BATCH):
        some = slice(first, first + _BATCH)
        part = leaves.part[some]
        low, high = Ball.of(region.lower[part]), Ball.of(region.upper[part])
        # Shares of the edges are binary fractions: their half sums and differences are exact.
        middle = 0.5 * (leaves.lower[some] + leaves.upper[some])
        half = 0.5 * (leaves.upper[some] - leaves.lower[some])
        bounds = _bounds(
            net,
            arm,
            low + (high - low) * middle,
            (high - low) * half,
            list(compare.coordinates),
            list(compare.inputs),
        )
        upper = max(upper, float(np.where(np.isnan(bounds), np.inf, bounds).max()))
    return upper


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
    largest = up(norm_above(size * size) + beyond).max(axis=1)
    change = up(joints.straight() + joints.rest())
    around = Ball(centre.mid, up(centre.rad + half.magnitude()))[:, inputs]
    reach = arm.farthest(joints.centre.mid, change, around, coordinates)
    # What overflowed says nothing; the arm's reach may still.
    return np.fmin(np.where(np.isnan(largest), np.inf, largest), reach)
