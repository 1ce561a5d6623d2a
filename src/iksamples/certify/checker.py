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
    tiles,
    up,
)
from iksamples.certify.checker_arm import Arm
from iksamples.certify.checker_network import CheckedTable, Network, Terms, corners, mixed_pairs
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
from iksamples.errors import IksamplesError
from iksamples.network import StackedMLP
from iksamples.region import Region


Floats = NDArray[np.float64]


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
        self.item = self.items[0]  # all differ in nothing but the vectors
        self.arm = Arm([item.chain for item in self.items])
        goals = [item.goal for item in self.items if item.goal]
        self.goal = Arm(goals) if goals else None
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
        at = Ball.of(np.atleast_2d(np.asarray(point, float)))
        item, answer = self.item, self.answers.answer(at)
        joints = join([-at[:, item.angles], answer[:, item.outputs]], 1)
        miss = self.arm.position(joints)[:, :, item.rows]
        wanted = at[:, item.inputs]
        miss = miss - (self.goal.position(wanted) if self.goal else wanted)
        least = np.maximum(np.abs(miss.mid) - miss.rad, 0.0)
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
        for first in range(0, len(leaves.part), self.answers.at_once):
            some = slice(first, first + self.answers.at_once)
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
        joints = _driven(self.item, self.answers.terms(centre, half), centre, half)
        apart = self._residual(joints, centre, half)
        largest = norm_above(up(apart * apart)).max(axis=1)
        if self.measure == "position":
            change = up(joints.straight() + joints.rest())
            inputs, rows = list(self.item.inputs), list(self.item.rows)
            around = Ball(centre.mid, up(centre.rad + half.magnitude()))[:, inputs]
            reach = self.arm.farthest(joints.centre.mid, change, around, rows)
            # What overflowed says nothing; the arm's reach may still.
            return np.fmin(np.where(np.isnan(largest), np.inf, largest), reach)
        largest = up(np.where(np.isnan(largest), np.inf, largest) + self.off)
        # The quotient, the root in it, the arc sine and the product are right to 32 UNIT.
        angle = angle_rad(up(largest * (1.0 + 32.0 * UNIT)), len(self.items)) * (1.0 + 32.0 * UNIT)
        return np.minimum(up(angle), LARGEST_ANGLE)

    def _residual(self, joints: Terms, centre: Ball, half: Ball) -> Floats:
        """Bounds of the norms of the residuals at the corners, shape (leaves, corners, vectors)."""
        leaves, d = half.shape
        inputs = list(self.item.inputs)
        middle, linear, curves, first = _second_order(self.arm, joints, self.item.rows)
        beyond = self.arm.beyond(joints)

        along = np.zeros((d, len(inputs)))
        along[inputs, range(len(inputs))] = 1.0
        own = half[:, :, None] * along
        if self.goal:
            asked = _exactly(centre[:, inputs], own)
            wanted = _second_order(self.goal, asked, (0, 1, 2))
            beyond = up(beyond + self.goal.beyond(asked))
            drift = asked.centre.rad[:, :, None] * wanted[3].magnitude()
            middle, linear, curves = middle - wanted[0], linear - wanted[1], curves - wanted[2]
        else:
            middle, linear = middle - centre[:, inputs], linear - own
            drift = np.zeros((leaves, 1, 1))

        squares = curves[:, :d] + joints.squares @ first
        mixed = curves[:, d:] + joints.mixed @ first
        signs, pairs = corners(d), mixed_pairs(d)
        products = [signs[:, a] * signs[:, b] for a, b in pairs]
        at = Ball.of(np.column_stack([signs, *products])) @ join([linear, mixed], 1)
        # Squares lie in [0, 1], a noise at a corner in [low, high].
        at = at + (middle + (squares * 0.5).sum(1))[:, None]
        noise = joints.factor @ first
        between, width = 0.5 * (joints.low + joints.high), 0.5 * (joints.high - joints.low)
        width = up(width + 2.0 * UNIT * (np.abs(joints.low) + np.abs(joints.high)))
        if between.any():
            at = at + Ball.of(between) @ noise
        spread = product_above(width, noise.magnitude())
        # Centres are known to within their radius.
        still = sum_above(joints.centre.rad[:, :, None] * first.magnitude(), 1)
        still = up(still + sum_above(drift, 1) + sum_above((squares * 0.5).magnitude(), 1))
        size = up(at.magnitude() + up(spread + still[:, None]))
        size = size.reshape(leaves, len(signs), len(self.items), -1)
        return up(norm_above(size * size) + beyond)


def _second_order(arm: Arm, joints: Terms, rows: tuple[int, ...]) -> tuple[Ball, Ball, Ball, Ball]:
    """Chains' tips, as if their joints were linear: constant, linear, squares and products.

    Last the derivative by the joints. The coordinates of all tips stand behind each other, shapes
    (leaves, values), (leaves, d, values), (leaves, d + pairs, values), (leaves, joints, values).
    """
    leaves, d, n = joints.linear.shape
    derived = arm.derivatives(Ball.of(joints.centre.mid))
    tip, first, second = (part[..., list(rows)] for part in derived)
    values = tip.shape[1] * tip.shape[2]
    tip, first = tip.reshape(leaves, values), first.reshape(leaves, n, values)
    # Once along every edge: (leaves, edge, joint, values); and once more.
    bent = (joints.linear @ second.reshape(leaves, n, n * values)).reshape(leaves, d, n, values)
    bent = joints.linear @ bent.swap(1, 2).reshape(leaves, n, d * values)
    bent = bent.reshape(leaves, d, d, values)
    curves = [bent[:, a, a] * 0.5 for a in range(d)] + [bent[:, a, b] for a, b in mixed_pairs(d)]
    return tip, joints.linear @ first, stack(curves, 1), first


def _exactly(centre: Ball, linear: Ball) -> Terms:
    """Terms that have no other parts."""
    leaves, d, n = linear.shape
    zero, none = Ball.of(np.zeros((leaves, d, n))), np.zeros((leaves, 0))
    nothing, reach = Ball.of(np.zeros((leaves, 0, n))), np.zeros((leaves, 2**d, 0))
    mixed = Ball.of(np.zeros((leaves, len(mixed_pairs(d)), n)))
    return Terms(centre, linear, zero, mixed, nothing, none, reach, reach)


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
