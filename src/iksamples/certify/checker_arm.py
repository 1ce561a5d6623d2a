"""The checker's own arm: derivatives from products of transformations, in ball arithmetic."""

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
    """The chain in ball arithmetic."""

    def __init__(self, chain: SerialChain) -> None:
        """Takes the chain apart."""
        self.n = chain.n_joints
        self.turns = [kind == "revolute" for kind in chain.joint_kinds]
        self.axes = [_unit(axis) for axis in chain.axes]
        self.points = [Ball.of(point) for point in chain.points_mm]
        self.tip = Ball.of(chain.tip_mm)
        self.skews = [_skew(axis) for axis in self.axes]
        self._take_apart()

    def _take_apart(self) -> None:
        """The vectors that the joints turn, as short as they can be, and the runs of axes."""
        before: list[tuple[int, Ball, list[Ball]]] = []  # joint, fixed vector, slides by joint
        last, knot = -1, Ball.of(np.zeros(3))
        slides = [Ball.of(np.zeros(3)) for _ in range(self.n)]
        for i in range(self.n):
            if self.turns[i]:
                before.append((last, self.points[i] - knot, slides))
                slides = [Ball.of(np.zeros(3)) for _ in range(self.n)]
                last, knot = i, self.points[i]
            else:
                slides[i] = self.axes[i]
        before.append((last, self.tip - knot, slides))
        for s in reversed(range(1, len(before))):
            joint, vector, slides = before[s]
            upper, base, base_slides = before[s - 1]
            axis = self.axes[joint]
            along = axis * (vector * axis).sum(0)
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

    def position(self, joints: Ball) -> Ball:
        """Tip at joint values (batch, joints), shape (batch, 3)."""
        point = self.tip + Ball.of(np.zeros((joints.shape[0], 3)))
        for i in reversed(range(self.n)):
            point = self._move(i, joints[:, i], point)
        return point

    def _move(self, i: int, value: Ball, point: Ball) -> Ball:
        if not self.turns[i]:
            return point + value[:, None] * self.axes[i]
        return self._rotate(i, value, point - self.points[i]) + self.points[i]

    def _rotate(self, i: int, value: Ball, vector: Ball, order: int = 0) -> Ball:
        """A vector under rotation i, or under the first or second derivative of it."""
        once = vector @ self.skews[i].swap(0, 1)
        twice = once @ self.skews[i].swap(0, 1)
        sine, cosine = value.sin()[:, None], value.cos()[:, None]
        if order == 0:
            return vector + sine * once + (1.0 - cosine) * twice
        if order == 1:
            return cosine * once + sine * twice
        return cosine * twice - sine * once

    def derivatives(self, joints: Floats) -> tuple[Ball, Ball, Ball]:
        """Tip, its first and second derivatives by the joints.

        Shapes (batch, 3), (batch, joints, 3), (batch, joints, joints, 3). The chain's
        transformations are multiplied from the tip, with one or two of them derived.
        """
        q, n = Ball.of(joints), self.n
        behind = [self.tip + Ball.of(np.zeros((len(joints), 3)))]
        for i in reversed(range(n)):
            behind.append(self._move(i, q[:, i], behind[-1]))
        behind.reverse()  # behind[i]: the tip moved by the joints from i on
        zero = Ball.of(np.zeros((len(joints), 3)))

        def carry(vector: Ball, from_joint: int) -> Ball:
            for k in reversed(range(from_joint)):
                if self.turns[k]:
                    vector = self._rotate(k, q[:, k], vector)
            return vector

        def derive(i: int, order: int) -> Ball:
            if not self.turns[i]:
                return self.axes[i] + zero if order == 1 else zero
            return self._rotate(i, q[:, i], behind[i + 1] - self.points[i], order)

        first: list[Ball] = []
        second = [[zero] * n for _ in range(n)]
        for j in range(n):
            first.append(carry(derive(j, 1), j))
            second[j][j] = carry(derive(j, 2), j)
            vector = derive(j, 1)
            for i in reversed(range(j)):
                if self.turns[i]:
                    bent = self._rotate(i, q[:, i], vector, 1)
                    second[i][j] = second[j][i] = carry(bent, i)
                    vector = self._rotate(i, q[:, i], vector)
        return behind[0], stack(first, 1), stack([stack(line, 1) for line in second], 1)

    def beyond(self, joints: Floats, straight: Terms, joints_rest: Floats) -> Floats:
        """All that the second-order expansion in the linear part leaves out, at each corner.

        A change of the joints splits into the linear part v (taken at the corner) and a rest. With
        S the sum over runs of parallel axes of |total angle|, and g the change of a vector's slide,
        the k-th derivative of R u along a change is at most ``|u| S^k + k |g| S^(k-1)``. Left out
        are: half the second derivative where the rest takes part, and a sixth of the third.
        Where axes are only parallel to within f, S^k grows by at most ``((1 + f)^k - 1) T^k``, with
        T = sum |angle|.
        """
        signs = corners(straight.linear.shape[1])
        at = Ball.of(signs) @ straight.linear  # (leaves, corners, joints)
        alone, alone_rest = at.magnitude(), joints_rest[:, None]
        fixed = Ball.of(joints)
        total = np.zeros(at.shape[:2])
        for joint, vector, slides in self.segments:
            turning = [i for i in range(joint + 1) if self.turns[i]]
            s, s_rest = np.zeros(at.shape[:2]), np.zeros(at.shape[:2])
            for run in {self.run[i] for i in turning}:
                weights = np.zeros(self.n)
                members = [i for i in turning if self.run[i] == run]
                weights[members] = self.sign[members]
                s = up(s + (at @ weights[:, None])[:, :, 0].magnitude())
                s_rest = up(s_rest + self._run_rest(straight, weights, joints_rest)[:, None])
            t = sum_above(alone[:, :, turning], 2)
            t_rest = sum_above(np.broadcast_to(alone_rest, alone.shape)[:, :, turning], 2)
            off = float(self.off[turning].max())

            length = vector + sum(
                (fixed[:, k, None] * slides[k] for k in range(self.n) if not self.turns[k]),
                Ball.of(np.zeros((len(joints), 3))),
            )
            u = norm_above(length.magnitude() ** 2)[:, None]
            reach = np.array([float(norm_above(slide.magnitude() ** 2)) for slide in slides])
            g, g_rest = (
                product_above(alone, reach[:, None])[:, :, 0],
                product_above(alone_rest, reach[:, None])[:, :, 0],
            )
            # Second order, the rest taking part: (v, rest) and half of (rest, rest).
            pair = up(s * s_rest + 3.0 * off * t * t_rest)
            square = up(s_rest * s_rest + 3.0 * off * t_rest * t_rest)
            total = up(total + u * up(pair + 0.5 * square))
            whole, wide = up(s + s_rest), up(t + t_rest)
            total = up(total + up(whole + off * wide) * g_rest + up(s_rest + off * t_rest) * g)
            # Third order of the whole change.
            cube = up(whole * whole * whole + 4.0 * off * wide * wide * wide)
            total = up(total + u * cube / 6.0)
            total = up(total + 0.5 * up(g + g_rest) * up(whole * whole + 3.0 * off * wide * wide))
        return total

    def farthest(self, joints: Floats, change: Floats, around: Ball, rows: list[int]) -> Floats:
        """How far the tip can be from some positions, whatever the joints that turn.

        What no joint turns is in one place, and the rest no farther from it than it is long.

        Args:
            joints: The joints that slide are near these [mm], shape (leaves, joints).
            change: By at most this [mm], shape (leaves, joints).
            around: The positions [mm], shape (leaves, coordinates), as wide as the leaves are.
            rows: Which coordinates these are.
        """
        total = np.zeros(len(joints))
        for index, (_, vector, slides) in enumerate([self.base, *self.segments]):
            held = vector + Ball.of(np.zeros((len(joints), 3)))
            for k in (k for k in range(self.n) if not self.turns[k]):
                held = held + Ball.of(joints[:, k, None]) * slides[k]
                total = up(total + up(change[:, k] * norm_above(slides[k].magnitude() ** 2)))
            if index == 0:
                held = held[:, rows] - around
            total = up(total + norm_above(held.magnitude() ** 2))
        return total

    def _run_rest(self, terms: Terms, weights: Floats, joints_rest: Floats) -> Floats:
        """Bound of a run's total angle due to all that is not linear."""
        line = weights[:, None]
        noise = (terms.factor @ line)[:, :, 0].magnitude() * terms.size
        bent = (terms.squares @ line)[:, :, 0].magnitude()
        mixed = (terms.mixed @ line)[:, :, 0].magnitude()
        centre = product_above(terms.centre.rad, np.abs(line))[:, 0]
        together = up(sum_above(noise, 1) + sum_above(bent, 1) + sum_above(mixed, 1) + centre)
        return np.minimum(together, product_above(joints_rest, np.abs(line))[:, 0])


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
