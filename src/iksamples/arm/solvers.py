"""Inverse kinematics: in closed form for a yaw and two parallel pitches, or followed from home.

For any chain, the tool is led in small steps along a straight line (its rotation along a geodesic)
from where it is at home to where it is wanted, and the joints follow by Newton's method; a step is
taken only when the tool has kept up with those before. So the answer is a function of what is
wanted: the branch is that of the home posture, as long as no singularity lies on the way. An arm
with joints to spare takes, of all joint values that do it, those nearest to home:
``q <- q + d + J^+ (e - J d)`` with ``d = home - q`` is Newton's method with a Gauss-Newton Hessian
for that problem (Nocedal and Wright, *Numerical Optimization*, ch. 18).

Everything is batched over the points. Joints in mm and errors in rad are weighed against the others
by the arm's length.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iksamples.arm.chain import Floats, SerialChain, angles_of
from iksamples.arm.real import rotation_of
from iksamples.arm.target import COORDINATES, Target
from iksamples.errors import IksamplesError


Elbow = Literal["negative", "positive"]


@dataclass(frozen=True)
class _Plane:
    """The arm in the plane that turns with the yaw, all joints at zero.

    A vector in the plane is (along ``forward``, along the yaw axis); angles grow from the first to
    the second, which is the positive sense of the shoulder.
    """

    basis: Floats  # forward, left and up in the base frame, as rows
    shoulder: Floats  # from the yaw axis [mm], shape (2,)
    upper: Floats  # from shoulder to elbow [mm], shape (2,)
    fore: Floats  # from elbow to tool [mm], shape (2,)
    left_mm: float  # how far the tool is beside the plane through the yaw axis
    elbow_sense: float  # 1 where the elbow turns as the shoulder does, -1 where against it


def fits_yaw_pitch_pitch(chain: SerialChain) -> bool:
    """Whether `yaw_pitch_pitch` solves the chain."""
    return _plane(chain) is not None


def yaw_pitch_pitch(
    chain: SerialChain,
    positions_mm: ArrayLike,
    elbow: Elbow | None = None,
    home: ArrayLike | None = None,
) -> Floats:
    """Closed form for a yaw joint and two pitch joints parallel to each other and across it.

    The plane of the arm turns with the yaw; in it, the shoulder, the elbow and the tip form a
    triangle whose third side is known, and the law of cosines gives the elbow (Spong, Hutchinson
    and Vidyasagar, *Robot Modeling and Control*, sec. 5.3). Any pose of the base, sense of an axis,
    offset between the axes and length of link will do. A point is reached in up to four ways: the
    elbow bends to either side, and the arm faces the point or reaches over its back. The arm faces
    and bends as at home; where that does not tell, it looks along the base's x axis with its elbow
    up.

    Args:
        chain: The arm.
        positions_mm: Tool centre points wanted [mm], shape (points, 3).
        elbow: ``"negative"`` or ``"positive"``: how the elbow bends, away from stretched, about its
            axis; None: as at home.
        home: Joint values [rad] that say how the arm faces and bends, shape (3,); None: the middle
            of the joint limits.

    Returns:
        Joint values [rad], shape (points, 3), whole turns away where that is inside the limits; NaN
        where the links are too short or too long for the point.

    Raises:
        IksamplesError: The chain is not of this kind.
    """
    plane = _plane(chain)
    if plane is None:
        raise IksamplesError(
            "robot.inverse: 'yaw-pitch-pitch' needs three revolute joints, a yaw and across it two "
            f"parallel pitches; this chain ({', '.join(chain.joint_names)}) is different, so say "
            "newton."
        )
    middle = np.where(np.isfinite(chain.lower + chain.upper), (chain.lower + chain.upper) / 2, 0.0)
    posture = middle if home is None else np.asarray(home, float)
    ahead, bend_at_home = _posture(plane, posture)
    if abs(bend_at_home) < 1e-6:  # stretched: elbow up
        bend_at_home = -ahead * plane.elbow_sense
    bends = {"negative": -1.0, "positive": 1.0, None: np.sign(bend_at_home)}[elbow]

    relative = np.asarray(positions_mm, float) - chain.points_mm[0]
    x, y, z = plane.basis @ relative.T
    reach_squared = np.hypot(x, y) ** 2 - plane.left_mm**2
    forward = ahead * np.sqrt(np.where(reach_squared >= 0, reach_squared, np.nan))
    radius, height = forward - plane.shoulder[0], z - plane.shoulder[1]
    upper_mm, fore_mm = np.hypot(*plane.upper), np.hypot(*plane.fore)
    cosine = (radius**2 + height**2 - upper_mm**2 - fore_mm**2) / (2 * upper_mm * fore_mm)
    # A point on the boundary may miss it by a rounding error.
    cosine = np.where(np.abs(cosine) <= 1 + 1e-12, np.clip(cosine, -1, 1), np.nan)
    bend = bends * np.arccos(cosine)

    turn = plane.elbow_sense * bend
    right, up = plane.upper / upper_mm
    lean = np.arctan2(right * height - up * radius, right * radius + up * height)
    joints = np.stack(
        [
            np.arctan2(y, x) - np.arctan2(plane.left_mm, forward),
            lean - np.arctan2(fore_mm * np.sin(turn), upper_mm + fore_mm * np.cos(turn)),
            bend - _bend_at_zero(plane),
        ],
        axis=-1,
    )
    joints[np.isnan(cosine)] = np.nan
    turned = joints - 2 * np.pi * np.round((joints - middle) / (2 * np.pi))
    return np.where((turned >= chain.lower) & (turned <= chain.upper), turned, joints)


def _plane(chain: SerialChain) -> _Plane | None:
    """The plane of the arm; None where the chain is of another kind."""
    if chain.joint_kinds != ("revolute",) * 3:
        return None
    yaw, shoulder, elbow = chain.axes
    if abs(yaw @ shoulder) > 1e-9 or np.linalg.norm(np.cross(shoulder, elbow)) > 1e-9:
        return None
    basis = np.stack([np.cross(yaw, shoulder), -shoulder, yaw])
    knots = (np.vstack([chain.points_mm[1:], chain.tip_mm]) - chain.points_mm[0]) @ basis.T
    in_plane = knots[:, [0, 2]]
    links = np.diff(in_plane, axis=0)
    if np.min(np.hypot(*links.T)) < 1e-9:
        return None
    return _Plane(basis, in_plane[0], links[0], links[1], knots[2, 1], np.sign(shoulder @ elbow))


def _bend_at_zero(plane: _Plane) -> float:
    """Angle about the elbow's axis between the links where the elbow is at zero [rad]."""
    (a, b), (c, d) = plane.upper, plane.fore
    return plane.elbow_sense * float(np.arctan2(a * d - b * c, a * c + b * d))


def _posture(plane: _Plane, joints: Floats) -> tuple[float, float]:
    """Which way the arm faces at some joints (1 ahead, -1 back), and how its elbow bends [rad]."""
    _, lean, angle = joints
    bend = (_bend_at_zero(plane) + angle + np.pi) % (2 * np.pi) - np.pi
    (a, b), (c, d) = plane.upper, plane.fore
    total = lean + plane.elbow_sense * angle
    forward = (
        plane.shoulder[0]
        + a * np.cos(lean) - b * np.sin(lean)
        + c * np.cos(total) - d * np.sin(total)
    )  # fmt: skip
    length = np.hypot(a, b) + np.hypot(c, d)
    if abs(forward) < 1e-6 * length:  # upright: along the base's x axis, or else its y or z axis
        ahead = plane.basis[0]
        forward = ahead[np.argmax(np.abs(ahead))]
    return float(np.sign(forward)), float(bend)


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
        self._weight = np.where(chain.revolute, 1.0, self.length_mm)
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
        joints = self.follow(
            np.array([at_home[name] for name in self._target.coordinates]) + around
        )
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
