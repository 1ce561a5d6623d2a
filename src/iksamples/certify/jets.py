"""Forward kinematics to second order, with a closed form for everything beyond.

A serial chain moves a sum of vectors, each turned by the revolute joints before it:

    p(q) = u_0 + R_1 u_1 + R_1 R_2 u_2 + ...,

with ``u_s`` fixed, or affine in the prismatic joints that follow revolute joint ``s``. The part of
``u_s`` along axis ``s`` is not turned by joint ``s``, so it is handed to ``u_(s-1)``; that keeps
every vector, and with it every remainder below, as short as it can be.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from iksamples.arm.chain import SerialChain
from iksamples.certify.compared import PARALLEL
from iksamples.certify.enclosure import Expansion, mirrored, pairs, sizes


Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Linkage:
    """A serial chain as a sum of turned vectors.

    Attributes:
        revolute: Which joints turn (the others slide), shape (joints,).
        axes: Unit axes in the base frame at zero, shape (joints, 3).
        vectors_mm: ``u_s`` with the sliding joints at zero [mm], shape (joints + 1, 3). Row
            ``i + 1`` is turned by the joints up to ``i``; it is zero where joint ``i`` slides.
        slides: Derivative of ``u_s`` by each joint, shape (joints + 1, joints, 3).
        angle_sums: The total angle of a run of consecutive parallel axes up to joint ``i`` is
            ``angle_sums[i] @ q``, shape (joints, joints).
        turning: Which of those totals turn a vector: of each run of parallel axes before it the
            last one, shape (moved, joints).
        moved: The rows of ``vectors_mm`` that are turned at all.
    """

    revolute: NDArray[np.bool_]
    axes: Floats
    vectors_mm: Floats
    slides: Floats
    angle_sums: Floats
    turning: Floats
    moved: NDArray[np.int64]

    @classmethod
    @lru_cache(maxsize=64)  # many networks are certified on one arm
    def of(cls, chain: SerialChain) -> "Linkage":
        """Takes a chain apart."""
        n = chain.n_joints
        revolute = chain.revolute
        axes = chain.axes / np.linalg.norm(chain.axes, axis=1, keepdims=True)

        vectors = np.zeros((n + 1, 3))
        slides = np.zeros((n + 1, n, 3))
        row, knot = 0, np.zeros(3)
        for i in range(n):
            if revolute[i]:
                vectors[row] = chain.points_mm[i] - knot
                row, knot = i + 1, chain.points_mm[i]
            else:
                slides[row, i] = axes[i]
        vectors[row] = chain.tip_mm - knot

        rows = [0, *(np.flatnonzero(revolute) + 1)]
        for before, row in reversed(list(pairwise(rows))):
            axis = axes[row - 1]
            along, slid_along = (vectors[row] @ axis) * axis, np.outer(slides[row] @ axis, axis)
            vectors[row] -= along
            vectors[before] += along
            slides[row] -= slid_along
            slides[before] += slid_along
        slides[np.abs(slides) < PARALLEL] = 0.0

        angle_sums, turning = np.zeros((n, n)), np.zeros((n + 1, n))
        last: int | None = None
        for i in range(n):
            turning[i + 1] = turning[i]
            if not revolute[i]:
                continue
            angle_sums[i, i] = 1.0
            if last is not None and np.linalg.norm(np.cross(axes[last], axes[i])) <= PARALLEL:
                angle_sums[i] += np.sign(axes[last] @ axes[i]) * angle_sums[last]
                turning[i + 1, last] = 0.0
            turning[i + 1, i] = 1.0
            last = i
        moved = np.flatnonzero(
            turning.any(axis=1) & (vectors.any(axis=1) | slides.any(axis=(1, 2)))
        )
        return cls(revolute, axes, vectors, slides, angle_sums, turning[moved], moved)

    @property
    def n_joints(self) -> int:
        """Number of moving joints."""
        return len(self.revolute)

    @cached_property
    def slides_at_all(self) -> bool:
        """Whether any joint is prismatic."""
        return not bool(self.revolute.all())

    def lengths_mm(self, joints: Floats) -> Floats:
        """Length of each turned vector [mm], shape (batch or 1, moved)."""
        if not self.slides_at_all:
            return np.linalg.norm(self.vectors_mm[self.moved], axis=-1)[None]
        return np.linalg.norm(self.vectors_at(joints)[:, self.moved], axis=-1)

    def turns(self, change: Floats) -> Floats:
        """Angle by which each turned vector is turned at most [rad], shape (..., moved).

        Args:
            change: Bounds of ``|angle_sums @ change of the joints|`` [rad], shape (..., joints).
        """
        return change @ self.turning.T

    def shifts_mm(self, change: Floats) -> Floats:
        """Length by which each turned vector is changed at most [mm], shape (..., moved).

        Args:
            change: Bounds of the changes of the joints [rad or mm], shape (..., joints).
        """
        return change @ np.linalg.norm(self.slides[self.moved], axis=-1).T

    def levers_mm(self, joint_ranges: Floats) -> Floats:
        """How far the tip can move per unit of each joint [mm/rad, or 1], shape (..., joints).

        Args:
            joint_ranges: Largest absolute value of each joint [rad or mm], shape (..., joints).
        """
        lengths = self._longest_mm(joint_ranges)
        behind = np.cumsum(lengths[..., ::-1], axis=-1)[..., ::-1][..., 1:]
        return np.where(self.revolute, behind, 1.0)

    def reach_mm(self, joint_ranges: Floats) -> Floats:
        """How far the tip can be from the base's origin [mm], shape (...).

        Args:
            joint_ranges: Largest absolute value of each joint [rad or mm], shape (..., joints).
        """
        return self._longest_mm(joint_ranges).sum(axis=-1)

    def _longest_mm(self, joint_ranges: Floats) -> Floats:
        """Length of each vector at most [mm], shape (..., joints + 1)."""
        slid = np.linalg.norm(self.slides, axis=-1)
        # A joint that does not slide shifts nothing, whatever its value.
        shifts = np.where(slid > 0, np.asarray(joint_ranges)[..., None, :] * slid, 0.0)
        return np.linalg.norm(self.vectors_mm, axis=-1) + shifts.sum(axis=-1)

    def position_mm(self, joints: Floats) -> Floats:
        """Position of the tip [mm], shape (batch, 3), for joints of shape (batch, joints)."""
        vectors = np.broadcast_to(self.vectors_at(joints), (len(joints), self.n_joints + 1, 3))
        sines, cosines = np.sin(joints), np.cos(joints)
        arm = np.array(vectors[:, -1])
        for i in reversed(range(self.n_joints)):
            if self.revolute[i]:
                axis, cross = self.axes[i], _cross_matrix(self.axes[i])
                along = (arm @ axis)[:, None] * axis
                arm = (
                    along
                    + cosines[:, i, None] * (arm - along)
                    + sines[:, i, None] * (arm @ cross.T)
                )
            arm += vectors[:, i]
        return arm

    def jets(self, joints: Floats) -> tuple[Floats, Floats, Floats]:
        """Position, Jacobian and Hessian of the tip.

        With ``w_i`` the direction of axis ``i`` in the pose, ``J_i = w_i x (p - o_i)`` for a
        revolute joint and ``J_i = w_i`` for a prismatic one. Turning joint ``i`` turns everything
        behind it, so for ``i <= j`` the second derivative is ``w_i x J_j``; sliding it changes no
        direction, so there it is zero.

        Args:
            joints: Joint values [rad or mm], shape (batch, joints).

        Returns:
            Position [mm], shape (3, batch); Jacobian, shape (3, batch, joints); the upper triangle
            ``U`` of the Hessian with its diagonal halved, so that the second-order term is
            ``d @ U @ d``, shape (3, batch, joints, joints).
        """
        batch, n = joints.shape
        rotation = np.tile(np.eye(3), (batch, 1))
        vectors = self.vectors_at(joints)
        directions, turned = np.empty((3, batch, n)), np.empty((3, batch, n + 1))
        turned[:, :, 0] = vectors[:, 0].T
        sines = np.repeat(np.sin(joints), 3, axis=0)
        versines = np.repeat(1.0 - np.cos(joints), 3, axis=0)
        for i in range(n):
            directions[:, :, i] = (rotation @ self.axes[i]).reshape(batch, 3).T
            if not self.revolute[i]:
                turned[:, :, i + 1] = 0.0
                continue
            cross = _cross_matrix(self.axes[i])
            # Rodrigues' formula, for all rows of all rotations at once.
            rotation = (
                rotation
                + sines[:, i, None] * (rotation @ cross)
                + versines[:, i, None] * (rotation @ (cross @ cross))
            )
            if len(vectors) == 1:
                turned[:, :, i + 1] = (rotation @ vectors[0, i + 1]).reshape(batch, 3).T
            else:
                frames = rotation.reshape(batch, 3, 3)
                turned[:, :, i + 1] = (frames @ vectors[:, i + 1, :, None])[:, :, 0].T
        # Everything behind a joint, summed from the tip backwards.
        arms = np.cumsum(turned[:, :, ::-1], axis=2)[:, :, ::-1]
        jacobian = _cross(directions, arms[:, :, 1:])
        if self.slides_at_all:
            jacobian[:, :, ~self.revolute] = directions[:, :, ~self.revolute]
            directions[:, :, ~self.revolute] = 0.0
        hessian = _cross(directions[:, :, :, None], jacobian[:, :, None, :])
        hessian *= np.triu(np.ones((n, n))) - 0.5 * np.eye(n)
        return arms[:, :, 0], jacobian, hessian

    def second_order(
        self, joints: Floats, linear: Floats, rows: list[int]
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """The tip over boxes whose joints are ``joints + linear s``, to second order.

        Args:
            joints: Joint values at the centres, shape (boxes, joints).
            linear: What they change by along each edge, shape (boxes, d, joints).
            rows: Which of the tip's coordinates.

        Returns:
            Constant, linear and quadratic part as in ``residual.Residual``; the derivative by the
            joints, shape (boxes, joints, rows).
        """
        d = linear.shape[1]
        first, second = pairs(d)
        position, jacobian, hessian = self.jets(joints)
        if rows != [0, 1, 2]:
            position, jacobian, hessian = position[rows], jacobian[rows], hessian[rows]
        # The jets leave the axis of the coordinates in front, the polynomials have it last.
        gradient = jacobian.transpose(1, 2, 0)
        bent = (linear @ (hessian @ linear.transpose(0, 2, 1))).transpose(1, 2, 3, 0)
        quadratic = bent[:, first, second]
        quadratic[:, d:] += bent[:, second[d:], first[d:]]
        return position.T, linear @ gradient, quadratic, gradient

    def left_out(self, joints: Expansion, edges: Floats) -> tuple[Floats, Floats, Floats]:
        """What the second order leaves out, and which edges it is due to, roughly.

        Args:
            joints: The joints over the boxes.
            edges: The boxes' edges, as shares of the region's, shape (boxes, d).

        Returns:
            Bounds at the corners [mm], shape (boxes, corners); of the mean over the box [mm], shape
            (boxes, 1), no column where the joints have no means; shares of the largest at the
            corners, shape (boxes, d).
        """
        # Changes of the angles: the linear part corner by corner (opposite corners have opposite
        # changes, so half of them do), everything else at its largest.
        sums = self.angle_sums.T
        added = joints.linear @ sums
        average = bool(joints.mean_reach.shape[1])
        turns = self.turns(sizes(added, average))
        small_turns = self.turns(largest_bend(joints.quadratic, joints.noise, sums))[:, None]
        lengths = self.lengths_mm(joints.centre)[:, None]
        shifts: Floats | float = 0.0
        small_shifts: Floats | float = 0.0
        if self.slides_at_all:
            shifts = self.shifts_mm(sizes(joints.linear, average))
            small_shifts = self.shifts_mm(largest_bend(joints.quadratic, joints.noise))[:, None]
        bent = bending_mm(lengths, turns, small_turns, shifts, small_shifts)
        cubic = cubic_remainder_mm(lengths, turns + small_turns, shifts + small_shifts)
        both = bent + cubic
        half = both.shape[1] - average
        remainder, mean = both[:, :half], both[:, half:]

        # By how far each edge alone turns the vectors, weighted as in the cubic remainder.
        alone = self.turns(np.abs(added))
        due = (alone * (lengths * alone.sum(axis=1, keepdims=True) ** 2)).sum(axis=2)
        # Any edge may be to blame for what is not linear, so every edge is halved in the end.
        due /= np.maximum(due.sum(axis=1, keepdims=True), np.finfo(float).tiny)
        due += 0.2 * edges / edges.sum(axis=1, keepdims=True)
        return mirrored(remainder), mean, remainder.max(axis=1)[:, None] * due

    def vectors_at(self, joints: Floats) -> Floats:
        """Every ``u_s`` in the given pose, shape (batch or 1, joints + 1, 3)."""
        if not self.slides_at_all:
            return self.vectors_mm[None]
        return self.vectors_mm + np.einsum("bk,skc->bsc", joints, self.slides)


def cubic_remainder_mm(
    lengths_mm: Floats, turns: Floats, shifts_mm: Floats | float = 0.0
) -> Floats:
    """What the second-order expansion of the forward kinematics leaves out, at most.

    Along ``q + t d`` the vector ``R(t) (u + t g)`` has a rotation whose k-th derivative is a sum of
    k-fold cross products with unit axes, of norm at most ``S^k``, where ``S`` is the sum of
    ``|angle|`` over the runs of parallel axes before it (inside such a run rotations add up). So
    ``R(t) u`` leaves at most ``|u| S^3 / 6``, and ``t R(t) g``, whose rotation is only expanded to
    first order, leaves at most ``|g| S^2 / 2``. Either is attained in the limit of small steps: by
    a single revolute joint, and by a slide from zero on a turning axis.

    Args:
        lengths_mm: ``|u_s|`` at the centre [mm], shape (..., vectors).
        turns: ``S_s`` [rad], shape (..., vectors).
        shifts_mm: ``|g_s|`` [mm], shape (..., vectors).

    Returns:
        Bound of the norm of the remainder [mm], shape (...).
    """
    return np.sum((lengths_mm * turns / 6.0 + 0.5 * shifts_mm) * turns**2, axis=-1)


def bending_mm(
    lengths_mm: Floats,
    turns: Floats,
    small_turns: Floats,
    shifts_mm: Floats | float = 0.0,
    small_shifts_mm: Floats | float = 0.0,
) -> Floats:
    """Second-order terms in which a small second change of the joints takes part, at most.

    The second derivative of ``R u`` along changes a and b has norm at most
    ``|u| S_a S_b + S_a |g_b| + S_b |g_a|``. For the change a + b the second-order term exceeds that
    of a alone by the derivative along (a, b) and half of that along (b, b).

    Args:
        lengths_mm: ``|u_s|`` at the centre [mm], shape (..., vectors).
        turns: ``S_s`` of the main change [rad], shape (..., vectors).
        small_turns: ``S_s`` of the small change [rad], shape (..., vectors).
        shifts_mm: ``|g_s|`` of the main change [mm], shape (..., vectors).
        small_shifts_mm: ``|g_s|`` of the small change [mm], shape (..., vectors).

    Returns:
        Bound of the norm [mm], shape (...).
    """
    turning = lengths_mm * (turns + 0.5 * small_turns) * small_turns
    sliding = (turns + small_turns) * small_shifts_mm + small_turns * shifts_mm
    return np.sum(turning + sliding, axis=-1)


def largest_bend(quadratic: Floats, noise: Floats, matrix: Floats | None = None) -> Floats:
    """Largest absolute value of everything that is not linear, shape (boxes, values)."""
    total = np.zeros((len(noise), noise.shape[2]))
    for rows in (quadratic, noise):
        if rows.shape[1]:
            total += np.abs(rows if matrix is None else rows @ matrix).sum(axis=1)
    return total


def _cross_matrix(axis: Floats) -> Floats:
    x, y, z = axis
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _cross(a: Floats, b: Floats) -> Floats:
    """Cross product along the first axis."""
    return np.stack(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )
