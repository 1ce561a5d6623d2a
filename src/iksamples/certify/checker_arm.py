"""The checker's own arm: derivatives from products of transformations, in ball arithmetic."""

from collections.abc import Sequence

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
from iksamples.certify.checker_network import Terms, corners


Floats = NDArray[np.float64]

_NEARLY_PARALLEL = 1e-9


class Arm:
    """Chains that differ in nothing but their tips, in ball arithmetic."""

    def __init__(self, chains: Sequence[SerialChain]) -> None:
        """Takes the chains apart."""
        chain = chains[0]
        self.n = chain.n_joints
        self.turns = [kind == "revolute" for kind in chain.joint_kinds]
        self.axes = [_unit(axis) for axis in chain.axes]
        self.points = [Ball.of(point) for point in chain.points_mm]
        self.tips = Ball.of(np.array([each.tip_mm for each in chains]))
        self.skews = [_skew(axis) for axis in self.axes]
        self._take_apart()

    def _take_apart(self) -> None:
        """The vectors that the joints turn, as short as they can be, and the runs of axes."""
        before: list[tuple[int, Ball, list[Ball]]] = []  # joint, fixed vector, slides by joint
        last, knot = -1, Ball.of(np.zeros((1, 3)))
        slides = [Ball.of(np.zeros(3)) for _ in range(self.n)]
        for i in range(self.n):
            if self.turns[i]:
                before.append((last, self.points[i] - knot, slides))
                slides = [Ball.of(np.zeros(3)) for _ in range(self.n)]
                last, knot = i, self.points[i][None]
            else:
                slides[i] = self.axes[i]
        before.append((last, self.tips - knot, slides))
        for s in reversed(range(1, len(before))):
            joint, vector, slides = before[s]
            upper, base, base_slides = before[s - 1]
            axis = self.axes[joint]
            along = axis * (vector * axis).sum(1)[:, None]
            slid = [axis * (slide * axis).sum(0) for slide in slides]
            before[s] = (joint, vector - along, [a - b for a, b in zip(slides, slid, strict=True)])
            moved = [a + b for a, b in zip(base_slides, slid, strict=True)]
            before[s - 1] = (upper, base + along, moved)
        self.base, self.segments = before[0], before[1:]

        # Runs of (nearly) parallel axes: sign of each joint in its run, and how far off it is.
        self.run, self.sign, self.off = [-1] * self.n, np.zeros(self.n), np.zeros(self.n)
        first = -1
        for i in (i for i in range(self.n) if self.turns[i]):
            across = np.inf
            if first >= 0:
                crossed = (self.skews[first] @ self.axes[i][:, None])[:, 0]
                across = float(norm_above(crossed.magnitude() ** 2))
            if across <= _NEARLY_PARALLEL:
                self.sign[i] = np.sign(self.axes[first].mid @ self.axes[i].mid)
            else:
                first, self.sign[i], across = i, 1.0, 0.0
            self.run[i], self.off[i] = first, across
        # Unit vectors with |a x b| = c differ by at most sqrt(2) c (or from the opposite), and each
        # of a run's rotations moves its first axis by at most twice that.
        for run in {run for run in self.run if run >= 0}:
            members = [i for i in range(self.n) if self.run[i] == run]
            self.off[members] = 3.0 * len(members) * self.off[members].max()
        # Column i adds up the angles of joint i's run as far as that joint.
        same = np.equal.outer(self.run, self.run) & np.tri(self.n, dtype=bool).T
        self.totals = np.where(same, self.sign[:, None], 0.0)

    def position(self, joints: Ball) -> Ball:
        """Tips at joint values (batch, joints), shape (batch, tips, 3)."""
        return self.derivatives(joints)[0]

    def derivatives(self, joints: Ball) -> tuple[Ball, Ball, Ball]:
        """Tips, their first and second derivatives by the joints.

        Shapes (batch, tips, 3), (batch, joints, tips, 3), (batch, joints, joints, tips, 3). The
        chain's transformations are applied from the tip to the base, to everything that the joints
        behind have made of it; the derivative of each is applied to what it may be derived with.
        """
        n, (tips, _) = self.n, self.tips.shape
        zero = Ball.of(np.zeros((joints.shape[0], tips, 3)))
        tip, first = self.tips + zero, [zero] * n
        second = [[zero] * n for _ in range(n)]
        for i in reversed(range(n)):
            if not self.turns[i]:
                tip = tip + joints[:, i, None, None] * self.axes[i]
                first[i] = zero + self.axes[i]
                continue
            later = range(i + 1, n)
            pairs = [(j, k) for j in later for k in range(j, n)]
            behind = [tip - self.points[i], *first[i + 1 :], *(second[j][k] for j, k in pairs)]
            turned, bent, curved = self._rotate(i, joints[:, i], stack(behind, 1), 1 + len(later))
            tip = turned[:, 0] + self.points[i]
            for index, j in enumerate(later, 1):
                first[j], second[i][j] = turned[:, index], bent[:, index]
            for index, (j, k) in enumerate(pairs, n - i):
                second[j][k] = turned[:, index]
            first[i], second[i][i] = bent[:, 0], curved[:, 0]
        for i in range(n):
            for j in range(i):
                second[i][j] = second[j][i]
        return (
            tip,
            _grid(first, (n,), zero),
            _grid([each for line in second for each in line], (n, n), zero),
        )

    def _rotate(self, i: int, value: Ball, vectors: Ball, derived: int) -> tuple[Ball, Ball, Ball]:
        """Vectors (batch, vectors, tips, 3) under rotation i.

        Of the first ones also under its first derivative, and of the very first under its second.
        """
        once = vectors @ self.skews[i].swap(0, 1)
        twice = once @ self.skews[i].swap(0, 1)
        sine, cosine = (f[:, None, None, None] for f in (value.sin(), value.cos()))
        turned = vectors + sine * once + (1.0 - cosine) * twice
        some = slice(derived)
        bent = cosine * once[:, some] + sine * twice[:, some]
        return turned, bent, cosine * twice[:, :1] - sine * once[:, :1]

    def beyond(self, joints: Terms) -> Floats:
        """All that the second-order expansion in the linear part leaves out.

        Shape (leaves, corners, tips). A change of the joints splits into the linear part v (taken
        at the corner) and a rest. With S the sum over runs of parallel axes of |total angle|, and g
        the change of a vector's slide, the k-th derivative of R u along a change is at most
        ``|u| S^k + k |g| S^(k-1)``. Left out are: half the second derivative where the rest takes
        part, and a sixth of the third. Where axes are only parallel to within f, S^k grows by at
        most ``((1 + f)^k - 1) T^k``, with T = sum |angle|.
        """
        rest = joints.rest()
        d = joints.linear.shape[1]
        # Opposite corners have opposite changes, and half of them stand before the middle.
        at = Ball.of(corners(d)[: 2**d // 2]) @ joints.linear  # (leaves, half, joints)
        alone, alone_rest = at.magnitude(), rest[:, None]
        totals, totals_rest = (at @ self.totals).magnitude(), self._totals_rest(joints, rest)
        fixed = Ball.of(joints.centre.mid)
        total = np.zeros((*at.shape[:2], self.tips.shape[0]))
        for joint, vector, slides in self.segments:
            turning = [i for i in range(joint + 1) if self.turns[i]]
            last = list({self.run[i]: i for i in turning}.values())
            s, s_rest = sum_above(totals[:, :, last], 2), sum_above(totals_rest[:, None, last], 2)
            t, t_rest = sum_above(alone[:, :, turning], 2), sum_above(alone_rest[:, :, turning], 2)
            off = float(self.off[turning].max())

            length = vector + Ball.of(np.zeros((len(fixed.mid), 1, 3)))
            for k in (k for k in range(self.n) if not self.turns[k]):
                length = length + (fixed[:, k, None] * slides[k])[:, None]
            u = norm_above(length.magnitude() ** 2)[:, None]
            reach = np.array([float(norm_above(slide.magnitude() ** 2)) for slide in slides])
            g, g_rest = (
                product_above(alone, reach[:, None])[:, :, 0],
                product_above(alone_rest, reach[:, None])[:, :, 0],
            )
            # Second order, the rest taking part: (v, rest) and half of (rest, rest).
            pair = up(s * s_rest + 3.0 * off * t * t_rest)
            square = up(s_rest * s_rest + 3.0 * off * t_rest * t_rest)
            whole, wide = up(s + s_rest), up(t + t_rest)
            slid = up(up(whole + off * wide) * g_rest + up(s_rest + off * t_rest) * g)
            # Third order of the whole change.
            cube = up(whole * whole * whole + 4.0 * off * wide * wide * wide)
            turned = up(pair + 0.5 * square + cube / 6.0)
            slid = up(slid + 0.5 * up(g + g_rest) * up(whole * whole + 3.0 * off * wide * wide))
            total = up(total + u * turned[:, :, None] + slid[:, :, None])
        return np.concatenate([total, total[:, ::-1]], axis=1)

    def farthest(self, joints: Floats, change: Floats, around: Ball, rows: list[int]) -> Floats:
        """How far the first tip can be from some positions, whatever the joints that turn.

        What no joint turns is in one place, and the rest no farther from it than it is long.

        Args:
            joints: The joints that slide are near these [mm], shape (leaves, joints).
            change: By at most this [mm], shape (leaves, joints).
            around: The positions [mm], shape (leaves, coordinates), as wide as the leaves are.
            rows: Which coordinates these are.
        """
        total = np.zeros(len(joints))
        for index, (_, vectors, slides) in enumerate([self.base, *self.segments]):
            held = vectors[0] + Ball.of(np.zeros((len(joints), 3)))
            for k in (k for k in range(self.n) if not self.turns[k]):
                held = held + Ball.of(joints[:, k, None]) * slides[k]
                total = up(total + up(change[:, k] * norm_above(slides[k].magnitude() ** 2)))
            if index == 0:
                held = held[:, rows] - around
            total = up(total + norm_above(held.magnitude() ** 2))
        return total

    def _totals_rest(self, terms: Terms, rest: Floats) -> Floats:
        """Bounds of the runs' total angles due to all that is not linear, (leaves, joints)."""
        noise = (terms.factor @ self.totals).magnitude() * terms.size[:, :, None]
        bent, mixed = (
            sum_above((part @ self.totals).magnitude(), 1) for part in (terms.squares, terms.mixed)
        )
        centre = product_above(terms.centre.rad, np.abs(self.totals))
        together = up(sum_above(noise, 1) + bent + mixed + centre)
        return np.minimum(together, product_above(rest, np.abs(self.totals)))


def _grid(parts: list[Ball], shape: tuple[int, ...], zero: Ball) -> Ball:
    """Balls of one shape (batch, ...) in an array (batch, *shape, ...), which may be empty."""
    batch, *others = zero.shape
    if not parts:
        return Ball.of(np.zeros((batch, *shape, *others)))
    return stack(parts, 1).reshape(batch, *shape, *others)


def _unit(axis: Floats) -> Ball:
    """A direction divided by its exact length."""
    direction = Ball.of(axis)
    length = np.linalg.norm(axis)
    # The computed length is right to 8 roundings, so the quotient is to 10.
    quotient = direction / length
    return Ball(quotient.mid, up(quotient.rad + 16.0 * UNIT * np.abs(quotient.mid)))


def _skew(axis: Ball) -> Ball:
    """The matrix of the cross product with an axis."""
    mid, rad = np.zeros((3, 3)), np.zeros((3, 3))
    for (i, j), k, sign in (
        ((0, 1), 2, -1.0),
        ((0, 2), 1, 1.0),
        ((1, 0), 2, 1.0),
        ((1, 2), 0, -1.0),
        ((2, 0), 1, -1.0),
        ((2, 1), 0, 1.0),
    ):
        mid[i, j], rad[i, j] = sign * axis.mid[k], axis.rad[k]
    return Ball(mid, rad)
