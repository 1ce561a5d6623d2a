"""An independent check of a certificate: exact tiling, and every bound again with all roundings.

Nothing here is shared with the search but the definition of what is certified:

    the supremum over a region, a union of closed boxes, of || P FK(N(x)) - x_I || (a position),

with N the network, its stored weights, offset and scale read as exact reals,
``N(x) = W_L act(... act(W_1 (x - offset) / scale + b_1) ...) + b_L``, or a look-up table,
multilinear between its nodes; FK the chain's product of exponentials, its stored points and
directions read as exact reals and each direction divided by its exact length; P the compared
coordinates and x_I the compared inputs; in real arithmetic. For an angle it is that between the
tool's rotation and ``R(x)``, or between their z axes (``compared``), the stored rotations of the
tool and the reference standing for the nearest rotations. The claim is about nothing outside the
region. What evaluating the network in float32 adds to it is ``rounding.inference_slack``.

The proof covers the region with leaves and encloses the residual over each: the network by the
affine (ReLU) or second-order (tanh) expansion plus bounded noise, the arm by its second-order
expansion plus a bound of the third derivative. Here that is done in ball arithmetic (``balls``),
with the arm's derivatives from products of its transformations and their derivatives.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from iksamples.arm.chain import SerialChain
from iksamples.arm.target import Target
from iksamples.certify.balls import (
    UNIT,
    Ball,
    join,
    norm_above,
    product_above,
    stack,
    sum_above,
    up,
)
from iksamples.certify.checker_arm import Arm
from iksamples.certify.checker_network import Network, Terms, corners, mixed_pairs
from iksamples.certify.checker_table import CheckedTable
from iksamples.certify.compared import (
    LARGEST_ANGLE,
    Compared,
    Measure,
    angle_rad,
    compared,
    target_of,
)
from iksamples.certify.search import Leaves
from iksamples.certify.table import Table
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
        network: Stacked networks, or a look-up table.
        row: Which of the networks it is about.
        chain: The arm.
        region: The inputs that it is about.
        upper: No input of the region has a larger error [mm or rad].
        lower: The error at ``argmax`` is at least this [mm or rad].
        argmax: An input of the region, shape (d,); None where nothing is claimed of one.
        target: What is asked of the tool; ``compared.target_of`` the inputs if None.
        measure: ``"position"`` [mm] or ``"angle"`` [rad].
    """

    network: StackedMLP | Table
    row: int
    chain: SerialChain
    region: Region
    upper: float
    lower: float = 0.0
    argmax: Floats | None = None
    target: Target | None = None
    measure: Measure = "position"


@dataclass(frozen=True)
class Verification:
    """What the checker could prove.

    Attributes:
        upper: No input of the region has a larger error [mm or rad]; infinite where the leaves do
            not tile the region. This holds whether the claim does or not.
        lower: The error at the claim's point is at least this [mm or rad].
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
        leaves: Boxes over each of which the error is to be bounded (``certify_stack(...,
            keep_leaves=True).leaves``). Only where they lie is looked at, and nothing of it is
            trusted.

    Raises:
        IksamplesError: There are no leaves; network, arm, region and target do not fit together; or
            a number of the network is not finite.
    """
    if leaves is None:
        raise IksamplesError("there are no leaves to prove it from; certify with keep_leaves=True.")
    region, net = claim.region, claim.network
    answers = CheckedTable(net) if isinstance(net, Table) else Network.of(net, claim.row)
    if answers.n_inputs != region.n_inputs:
        raise IksamplesError(
            f"a network of {answers.n_inputs} inputs does not fit a region of {region.n_inputs}."
        )
    if isinstance(answers, CheckedTable):
        region = region.cut([axis[1:-1] for axis in answers.axes])
    checks = _Checks(answers, claim)
    with np.errstate(all="ignore"):  # what overflows is no bound
        lower = checks.attained(claim.argmax) if _inside(claim.region, claim.argmax) else 0.0
        upper = checks.largest(region, leaves)
    return Verification(
        upper,
        lower,
        bool(lower >= claim.lower and upper <= claim.upper < np.inf),
        len(leaves.part) if upper < np.inf else 0,
    )


def _inside(region: Region, point: Floats | None) -> bool:
    at = np.atleast_2d(np.asarray(point, float))
    return at.shape == (1, region.n_inputs) and bool(region.contains(at).all())


class _Checks:
    """Answers on an arm, held against what is asked, in ball arithmetic."""

    def __init__(self, answers: Network | CheckedTable, claim: Claim) -> None:
        self.answers, self.measure = answers, claim.measure
        target = claim.target or target_of(answers.n_inputs)
        self.items = compared(
            claim.chain, target, claim.measure, answers.n_inputs, answers.n_outputs
        )
        self.arms = [Arm(item.chain) for item in self.items]
        # How far the stored rotations can be from rotations: |s - 1| <= |s^2 - 1| for each singular
        # value s, so |A - nearest|_F <= |A^T A - 1|_F.
        self.off = 0.0
        if claim.measure == "angle":
            axes = [2] if len(self.items) == 1 else [0, 1, 2]
            for matrix in (claim.chain.tip_rotation, target.reference_rotation):
                stored = Ball.of(np.array(matrix, np.float64)[:, axes])
                square = stored.swap(0, 1) @ stored - np.eye(len(axes))
                apart = norm_above((square.magnitude() ** 2).reshape(1, -1))
                self.off = float(up(np.float64(self.off) + apart[0]))

    def attained(self, point: Floats | None) -> float:
        """At least this is the error at a point."""
        at = np.atleast_2d(np.asarray(point, float))
        answer, least = self.answers.answer(Ball.of(at)), []
        for item, arm in zip(self.items, self.arms, strict=True):
            ahead = Ball.of(-at[:, item.angles])
            reached = arm.position(join([ahead, answer[:, item.outputs]], 1))[:, item.rows]
            miss = reached - (at[:, item.inputs] if item.inputs else item.wanted)
            least.append(np.maximum(np.abs(miss.mid) - miss.rad, 0.0))
        length = float(np.sqrt(np.sum(np.square(least))) * (1.0 - 64.0 * UNIT))
        if not np.isfinite(length):
            return 0.0
        if self.measure == "position":
            return length
        angle = angle_rad(max(length - self.off, 0.0), len(self.items))
        return float(angle * (1.0 - 32.0 * UNIT))

    def largest(self, region: Region, leaves: Leaves) -> float:
        """At most this is the error anywhere; infinite if the leaves do not prove it."""
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
            bounds = self._bounds(low + (high - low) * middle, (high - low) * half)
            upper = max(upper, float(np.where(np.isnan(bounds), np.inf, bounds).max()))
        return upper

    def _bounds(self, centre: Ball, half: Ball) -> Floats:
        """An upper bound of the error over each leaf."""
        terms = self.answers.terms(centre, half)
        sizes, reaches = [], []
        for item, arm in zip(self.items, self.arms, strict=True):
            size, reach = _bounds(item, arm, _driven(item, terms, centre, half), centre, half)
            sizes.append(size)
            reaches.append(reach)
        largest = sizes[0].max(axis=1)
        if len(sizes) > 1:
            largest = norm_above(up(np.stack(sizes, axis=-1) ** 2)).max(axis=1)
        if self.measure == "position":
            # What overflowed says nothing; the arm's reach may still.
            return np.fmin(np.where(np.isnan(largest), np.inf, largest), reaches[0])
        apart = up(np.where(np.isnan(largest), np.inf, largest) + self.off)
        # The quotient, the root in it, the arc sine and the product are right to 32 UNIT.
        angle = angle_rad(up(apart * (1.0 + 32.0 * UNIT)), len(sizes)) * (1.0 + 32.0 * UNIT)
        return np.minimum(up(angle), LARGEST_ANGLE)


def _driven(item: Compared, terms: Terms, centre: Ball, half: Ball) -> Terms:
    """The terms of a chain's joints: the opposites of some inputs, then some outputs."""
    ahead, outputs = list(item.angles), list(item.outputs)
    if not ahead and outputs == list(range(terms.centre.shape[1])):
        return terms
    own = np.zeros((half.shape[1], len(ahead)))
    own[ahead, range(len(ahead))] = -1.0

    def behind_nothing(rows: Ball) -> Ball:
        nothing = Ball.of(np.zeros((*rows.shape[:2], len(ahead))))
        return join([nothing, rows[:, :, outputs]], 2)

    return replace(
        terms,
        centre=join([-centre[:, ahead], terms.centre[:, outputs]], 1),
        linear=join([half[:, :, None] * own, terms.linear[:, :, outputs]], 2),
        squares=behind_nothing(terms.squares),
        mixed=behind_nothing(terms.mixed),
        factor=behind_nothing(terms.factor),
    )


def _bounds(
    item: Compared, arm: Arm, joints: Terms, centre: Ball, half: Ball
) -> tuple[Floats, Floats]:
    """Bounds of a residual's norm at the corners of each leaf, and by the arm's reach alone.

    Shapes (leaves, corners), (leaves,).
    """
    d = centre.shape[1]
    rows, inputs = list(item.rows), list(item.inputs)
    tip, first, second = arm.derivatives(joints.centre.mid)
    tip, first, second = tip[:, rows], first[:, :, rows], second[..., rows]

    linear = joints.linear @ first
    if inputs:
        own = np.zeros((d, len(rows)))
        own[inputs, range(len(inputs))] = 1.0
        linear = linear - half[:, :, None] * own
        around = Ball(centre.mid, up(centre.rad + half.magnitude()))[:, inputs]
        tip = tip - centre[:, inputs]
    else:
        around = Ball.of(np.zeros((len(centre.mid), len(rows)))) + item.wanted
        tip = tip - item.wanted
    squares, mixed = joints.squares @ first, joints.mixed @ first
    noise = joints.factor @ first

    bent = [(second * joints.linear[:, b, None, :, None]).sum(2) for b in range(d)]

    def curve(a: int, b: int) -> Ball:
        return (bent[b] * joints.linear[:, a, :, None]).sum(1)

    squares = squares + stack([curve(a, a) * 0.5 for a in range(d)], 1)
    pairs = mixed_pairs(d)
    if pairs:
        mixed = mixed + stack([curve(a, b) for a, b in pairs], 1)

    signs = corners(d)
    at = tip[:, None] + Ball.of(signs) @ linear
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

    change = up(joints.straight() + joints.rest())
    reach = arm.farthest(joints.centre.mid, change, around, rows)
    return up(norm_above(size * size) + beyond), reach
