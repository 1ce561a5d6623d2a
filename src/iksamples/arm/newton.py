"""Numeric inverse kinematics of any chain, followed from a home posture.

The tool is led in small steps along a straight line (its rotation along a geodesic) from where it
is at home to where it is wanted, and the joints follow by Newton's method; a step is taken only
when the tool has kept up with those before. So the answer is a function of what is wanted: the
branch is that of the home posture, as long as no singularity lies on the way. An arm with joints to
spare takes, of all joint values that do it, those nearest to home: ``q <- q + d + J^+ (e - J d)``
with ``d = home - q`` is Newton's method with a Gauss-Newton Hessian for that problem (Nocedal and
Wright, *Numerical Optimization*, ch. 18).

Everything is batched over the points. Joints in mm and errors in rad are weighed against the others
by the arm's length.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iksamples.arm.chain import Floats, SerialChain, angles_of
from iksamples.arm.deviation import rotation_of
from iksamples.arm.target import COORDINATES, Target


STEP = 0.1
"""How far the tool is led at once: rad, and that fraction of the arm's length."""
CAP = 0.3
"""Largest change of a joint in one iteration [rad, or fractions of the arm's length]."""
ITERATIONS = 100
"""Newton steps, beyond one for each step of the way, before a point is given up."""
RANK = 1e-5
"""A motion of the tool that needs this many times more of the joints than another is impossible."""


class Follower:
    """Solves for a target, from a home posture.

    Attributes:
        length_mm: The arm's length [mm]: root mean square distance of the tool from the revolute
            axes at home; 100 for an arm that only slides. It makes an angle comparable with a
            distance (a characteristic length: Angeles, *Fundamentals of Robotic Mechanical
            Systems*, sec. 5.8).
        rank: How many independent motions of the tool the target asks for: fewer than it names
            where the arm cannot leave what is asked, as a planar arm its plane.
    """

    def __init__(
        self, chain: SerialChain, target: Target, home: ArrayLike, locked: tuple[int, ...] = ()
    ) -> None:
        """Prepares the solver.

        Args:
            chain: The arm.
            target: What an input asks of the tool.
            home: The posture to start from and to stay near to [rad or mm], shape (joints,).
            locked: Joints that stay at home, by index.
        """
        self._chain, self._target, self._home = chain, target, np.asarray(home, float)
        self._free = [i for i in range(chain.n_joints) if i not in locked]
        linear, angular = chain.jacobians(self._home)
        levers = _norm(linear.T)[_norm(angular.T) > 0]
        self.length_mm = float(np.sqrt(np.mean(levers**2))) if np.any(levers) else 100.0
        self._weight = np.where(np.array(chain.joint_units) == "mm", self.length_mm, 1.0)
        self.rank = 0
        self.rank = self._generic_rank()

    def follow(self, x: ArrayLike, start: ArrayLike | None = None) -> Floats:
        """Joint values that do what the inputs ask.

        Args:
            x: Inputs [mm or rad], shape (points, inputs).
            start: The joints to start from [rad or mm], shape (points, joints); None: home.

        Returns:
            Joint values [rad or mm], shape (points, joints); NaN where the tool cannot be led.
        """
        return self.follow_pose(*self._target.wanted(x), start)

    def follow_pose(
        self, position: Floats, rotation: Floats, start: ArrayLike | None = None
    ) -> Floats:
        """Joint values that have the tool in poses, as far as the target asks for them.

        Args:
            position: Where the tool is wanted [mm], shape (points, 3).
            rotation: How it is wanted to be turned, shape (points, 3, 3).
            start: As `follow`.
        """
        shape = (len(position), self._chain.n_joints)
        joints = np.array(np.broadcast_to(self._home if start is None else start, shape))
        start_position, start_rotation = self._chain.pose(joints)
        travel, turn = position - start_position, self._turn(start_rotation, rotation)
        far = np.maximum(_norm(travel[:, self._target.positions]) / self.length_mm, _norm(turn))
        n_steps = np.ceil(far / STEP).clip(1, 1000)

        def aim(points: NDArray[np.intp]) -> tuple[Floats, Floats]:
            done = (taken[points] / n_steps[points])[:, None]
            on_the_way = rotation_of(done * turn[points]) @ start_rotation[points]
            last = done >= 1
            return (
                np.where(last, position[points], start_position[points] + done * travel[points]),
                np.where(last[..., None], rotation[points], on_the_way),
            )

        taken, iteration = np.ones(len(joints)), 0
        active = np.arange(len(joints))
        while active.size:
            iteration += 1
            now, rotated, jacobian = self._linearised(joints[active])
            behind = _norm(self._error(now, rotated, *aim(active)))
            taken[active] = np.minimum(taken[active] + (behind < STEP / 2), n_steps[active])
            error = self._error(now, rotated, *aim(active))
            to_home = ((self._home - joints[active]) / self._weight)[:, self._free]
            step = np.zeros_like(joints[active])
            step[:, self._free] = self._step(jacobian, error, to_home)
            largest = np.max(np.abs(step), axis=-1)
            step *= np.minimum(1.0, CAP / np.maximum(largest, CAP))[:, None]
            joints[active] += step * self._weight
            arrived = (taken[active] == n_steps[active]) & (largest < 1e-12)
            given_up = (iteration > n_steps[active] + ITERATIONS) | ~np.isfinite(largest)
            joints[active[given_up & ~arrived]] = np.nan
            active = active[~(arrived | given_up)]
        return joints

    def jacobian_mm(self, joints: ArrayLike) -> Floats:
        """Jacobian of what is asked for.

        Args:
            joints: Joint values [rad or mm], shape (points, joints).

        Returns:
            Shape (points, rows, free joints) [mm/rad]: angles, and the columns of prismatic joints,
            times the arm's length.
        """
        return self._linearised(np.asarray(joints, float))[2] * self.length_mm

    def smallest_singular_mm(self, joints: ArrayLike) -> Floats:
        """Smallest singular value of that Jacobian, of those that the arm can have [mm/rad].

        Args:
            joints: Joint values [rad or mm], shape (points, joints).

        Returns:
            Shape (points,).
        """
        values = np.linalg.svd(self.jacobian_mm(joints), compute_uv=False)
        return np.asarray(values[..., self.rank - 1], float)

    def same_side(self, joints: ArrayLike) -> NDArray[np.bool_]:
        """Whether no singularity was crossed an odd number of times, where that can be told.

        Args:
            joints: Joint values [rad or mm], shape (points, joints).

        Returns:
            Shape (points,): the Jacobian's determinant, where it has one, has its sign at home.
        """
        jacobians = self.jacobian_mm(np.concatenate([self._home[None], joints]))
        n_rows, n_columns = jacobians.shape[-2:]
        if not self.rank == n_rows == n_columns:
            return np.ones(len(jacobians) - 1, bool)
        signs = np.sign(np.linalg.det(jacobians))
        return np.asarray(signs[1:] == signs[0])

    def _generic_rank(self) -> int:
        """Rank of the Jacobian at labels around home; a singularity there is no reason for less."""
        position, rotation = self._chain.pose(self._home)
        turned = angles_of(rotation @ self._target.reference_rotation.T)
        at_home = dict(zip(COORDINATES, [*position, *turned], strict=True))
        scale = np.where(np.array(self._target.units) == "mm", self.length_mm, 1.0)
        around = np.random.default_rng(0).uniform(-0.02, 0.02, (8, len(scale))) * scale
        joints = self.follow(np.array([at_home[name] for name in self._target.names]) + around)
        joints = joints[~np.isnan(joints).any(axis=-1)]
        values = np.linalg.svd(self.jacobian_mm(joints), compute_uv=False)
        if not len(values):
            return int(values.shape[-1])
        return int(np.max(np.sum(values > RANK * values[:, :1], axis=-1)))

    def _linearised(self, joints: Floats) -> tuple[Floats, Floats, Floats]:
        """The tool's position and rotation, and the Jacobian of what is asked, in arm lengths."""
        position, rotation, linear, angular = self._chain.pose_and_jacobians(joints)
        rows = [linear[:, self._target.positions] / self.length_mm]
        if self._target.orientation == "fixed":
            rows.append(angular)
        elif self._target.orientation == "axis":
            rows.append(np.swapaxes(rotation, -1, -2)[:, :2] @ angular)
        jacobian = np.concatenate(rows, axis=-2) * self._weight
        return position, rotation, jacobian[..., self._free]

    def _error(self, now: Floats, rotated: Floats, position: Floats, rotation: Floats) -> Floats:
        """What is missing, in arm lengths and rad, in the order of the Jacobian's rows."""
        error = (position - now)[:, self._target.positions] / self.length_mm
        if self._target.orientation == "free":
            return error
        turn = self._turn(rotated, rotation)
        if self._target.orientation == "axis":
            turn = _times(np.swapaxes(rotated, -1, -2)[:, :2], turn)
        return np.concatenate([error, turn], axis=-1)

    def _step(self, jacobian: Floats, error: Floats, to_home: Floats) -> Floats:
        """Newton's step, towards home where the arm has joints to spare."""
        n_rows, n_joints = jacobian.shape[-2:]
        transposed = np.swapaxes(jacobian, -1, -2)
        if self.rank == n_rows == n_joints:
            return _solve(jacobian, error)
        if self.rank == n_rows:
            wanted = error - _times(jacobian, to_home)
            return to_home + _times(transposed, _solve(jacobian @ transposed, wanted))
        if self.rank == n_joints:
            return _solve(transposed @ jacobian, _times(transposed, error))
        # Rows that depend on each other, or (rank 0) not known yet.
        left, values, right = np.linalg.svd(jacobian, full_matrices=False)
        kept = (
            np.arange(values.shape[-1]) < self.rank if self.rank else values > RANK * values[:, :1]
        )
        inverse = np.where(kept, 1 / np.where(kept & (values > 0), values, 1.0), 0.0)
        wanted = _times(np.swapaxes(left, -1, -2), error - _times(jacobian, to_home))
        return to_home + _times(np.swapaxes(right, -1, -2), inverse * wanted)

    def _turn(self, now: Floats, wanted: Floats) -> Floats:
        """The turn still to be made, as rotation vectors in the base frame [rad], (..., 3)."""
        if self._target.orientation == "free":
            return np.zeros(now.shape[:-1])
        if self._target.orientation == "axis":
            a, b = now[..., 2], wanted[..., 2]
            cross, cosine = np.cross(a, b), np.sum(a * b, axis=-1, keepdims=True)
        else:
            m = wanted @ np.swapaxes(now, -1, -2)
            skew = m - np.swapaxes(m, -1, -2)
            cross = np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1) / 2
            cosine = (np.trace(m, axis1=-2, axis2=-1)[..., None] - 1) / 2
        sine = np.linalg.norm(cross, axis=-1, keepdims=True)
        return cross * np.where(sine > 0, np.arctan2(sine, cosine) / np.where(sine > 0, sine, 1), 1)


def _solve(matrix: Floats, right: Floats) -> Floats:
    """Solves a batch of systems, damped by a rounding error, so that a singular one stops none."""
    size = np.linalg.norm(matrix, axis=(-1, -2), keepdims=True) + np.finfo(float).tiny
    damped = matrix + 1e-15 * size * np.eye(matrix.shape[-1])
    return np.linalg.solve(damped, right[..., None])[..., 0].astype(float)


def _times(matrix: Floats, vector: Floats) -> Floats:
    return (matrix @ vector[..., None])[..., 0]


def _norm(vectors: Floats) -> Floats:
    return np.asarray(np.linalg.norm(vectors, axis=-1), float)
