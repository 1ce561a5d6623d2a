"""A serial chain: pose of the tool and its Jacobians, and how the joints of a file make one.

The chain is kept in product-of-exponentials form (Lynch and Park, *Modern Robotics*, ch. 4): for
each joint the unit axis and a point on it, both in the base frame with all joints at zero, and the
pose of the tool there. Nothing else of a URDF or a DH table matters for where the tool goes.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iksamples.errors import IksamplesError, one_line


Floats = NDArray[np.float64]
JointKind = Literal["revolute", "prismatic"]
Unit = Literal["mm", "rad"]

MM_PER_M = 1000.0


@dataclass(frozen=True, eq=False)
class SerialChain:
    """A serial chain of revolute and prismatic joints.

    A joint's value is an angle in radians, or a length in millimetres where the joint is prismatic.

    Attributes:
        joint_names: One name per joint, from the base to the tip.
        joint_kinds: ``"revolute"`` or ``"prismatic"``, one per joint.
        axes: Unit axes in the base frame at zero, shape (joints, 3).
        points_mm: A point on each axis in the base frame at zero [mm], shape (joints, 3).
        tip_mm: Tool centre point in the base frame at zero [mm], shape (3,).
        lower: Lower joint limits [rad or mm], shape (joints,).
        upper: Upper joint limits [rad or mm], shape (joints,).
        tip_rotation: The tool's axes as columns in the base frame at zero, shape (3, 3).
    """

    joint_names: tuple[str, ...]
    joint_kinds: tuple[JointKind, ...]
    axes: Floats
    points_mm: Floats
    tip_mm: Floats
    lower: Floats
    upper: Floats
    tip_rotation: Floats = field(default_factory=lambda: np.eye(3))

    @property
    def n_joints(self) -> int:
        """Number of moving joints."""
        return len(self.joint_names)

    @property
    def revolute(self) -> NDArray[np.bool_]:
        """Which joints turn, shape (joints,); the others slide."""
        return np.array(self.joint_kinds) == "revolute"

    @property
    def joint_units(self) -> tuple[Unit, ...]:
        """Unit of each joint's value: ``"rad"``, or ``"mm"`` where the joint is prismatic."""
        return tuple("mm" if kind == "prismatic" else "rad" for kind in self.joint_kinds)

    def forward_mm(self, joints: ArrayLike) -> Floats:
        """Position of the tool centre point.

        Args:
            joints: Joint values [rad or mm], shape (..., joints).

        Returns:
            Positions [mm], shape (..., 3).
        """
        # Of the whole pose's work (`_frames`) less than half, and asked for millions of points.
        q = self._checked(joints)
        moved = np.broadcast_to(self.tip_mm, (*q.shape[:-1], 3))
        for i in reversed(range(self.n_joints)):
            value = q[..., i, None]
            if self.joint_kinds[i] == "prismatic":
                moved = moved + value * self.axes[i]
                continue
            arm = moved - self.points_mm[i]
            axis = self.axes[i]
            # Rodrigues' rotation formula.
            moved = (
                self.points_mm[i]
                + np.cos(value) * arm
                + np.sin(value) * np.cross(axis, arm)
                + (1 - np.cos(value)) * (arm @ axis)[..., None] * axis
            )
        return np.array(moved)

    def rotation(self, joints: ArrayLike) -> Floats:
        """Rotation of the tool: its axes as columns in the base frame, shape (..., 3, 3).

        Args:
            joints: Joint values [rad or mm], shape (..., joints).
        """
        return self._frames(joints)[3]

    def pose(self, joints: ArrayLike) -> tuple[Floats, Floats]:
        """Position [mm], shape (..., 3), and rotation, shape (..., 3, 3), of the tool.

        Args:
            joints: Joint values [rad or mm], shape (..., joints).
        """
        return self._frames(joints)[2:]

    def skeleton_mm(self, joints: ArrayLike) -> Floats:
        """Where the joints and the tip are, to draw the arm as a line.

        Args:
            joints: Joint values [rad or mm], shape (..., joints).

        Returns:
            A point on every joint's axis and, last, the tool centre point [mm],
            shape (..., joints + 1, 3).
        """
        _, origins, tip, _ = self._frames(joints)
        return np.concatenate([origins, tip[..., None, :]], axis=-2)

    def jacobian_mm(self, joints: ArrayLike) -> Floats:
        """Geometric Jacobian of the tool centre point's position.

        Args:
            joints: Joint values [rad or mm], shape (..., joints).

        Returns:
            ``J[..., k, i] = d position_k / d joint_i`` [mm/rad, or 1 where the joint is prismatic],
            shape (..., 3, joints).
        """
        return self.jacobians(joints)[0]

    def jacobians(self, joints: ArrayLike) -> tuple[Floats, Floats]:
        """Geometric Jacobians of the tool's position and of its rotation.

        Args:
            joints: Joint values [rad or mm], shape (..., joints).

        Returns:
            The linear one as `jacobian_mm`, and the angular one: the tool's angular velocity in the
            base frame per joint's speed [1, or 0 where the joint is prismatic], each of shape
            (..., 3, joints).
        """
        return self.pose_and_jacobians(joints)[2:]

    def pose_and_jacobians(self, joints: ArrayLike) -> tuple[Floats, Floats, Floats, Floats]:
        """`pose` and `jacobians` together, for little more than either takes."""
        axes, origins, tip, rotation = self._frames(joints)
        turns = self.revolute[:, None]
        linear = np.where(turns, np.cross(axes, tip[..., None, :] - origins), axes)
        angular = np.where(turns, axes, 0.0)
        return tip, rotation, np.swapaxes(linear, -1, -2), np.swapaxes(angular, -1, -2)

    def within_limits(self, joints: ArrayLike, tolerance: float = 1e-9) -> NDArray[np.bool_]:
        """Whether each joint vector lies inside the joint limits.

        Args:
            joints: Joint values [rad or mm], shape (..., joints).
            tolerance: Slack at either limit [rad or mm], for values that sit on it.

        Returns:
            Shape (...).
        """
        q = np.asarray(joints, float)
        return np.all((q >= self.lower - tolerance) & (q <= self.upper + tolerance), axis=-1)

    def with_limits(self, limits: dict[str, tuple[float, float]]) -> "SerialChain":
        """The same chain with some joint limits replaced, so that every joint has limits.

        Args:
            limits: Name of a joint of the chain -> (lower, upper) [rad or mm].

        Raises:
            IksamplesError: A joint has no limits, or the lower one is not below the upper one.
        """
        lower, upper = self.lower.copy(), self.upper.copy()
        for name, (low, high) in limits.items():
            i = self.joint_names.index(name)
            lower[i], upper[i] = low, high
        for name, unit, low, high in zip(
            self.joint_names, self.joint_units, lower, upper, strict=True
        ):
            if not np.isfinite(high - low):
                raise IksamplesError(
                    f"joint '{name}' has no limits in its file; give them as "
                    f"robot.limits_{unit}.{name}: [lower, upper]."
                )
            if low >= high:
                raise IksamplesError(
                    f"robot.limits_{unit}.{name}: the lower limit {low:g} is not below the upper "
                    f"one {high:g}."
                )
        return replace(self, lower=lower, upper=upper)

    def with_tool(self, offset_mm: ArrayLike) -> "SerialChain":
        """The same chain with the tool centre point moved.

        Args:
            offset_mm: From the present tool centre point, along the tool's axes [mm], shape (3,).
        """
        return replace(self, tip_mm=self.tip_mm + self.tip_rotation @ np.asarray(offset_mm, float))

    def _checked(self, joints: ArrayLike) -> Floats:
        q = np.asarray(joints, float)
        if q.shape[-1:] != (self.n_joints,):
            raise ValueError(f"expected {self.n_joints} joint values last, got shape {q.shape}")
        return q

    def _frames(self, joints: ArrayLike) -> tuple[Floats, Floats, Floats, Floats]:
        """Every joint's axis and point, (..., joints, 3), and the tool's position and rotation."""
        q = self._checked(joints)
        rotation = np.broadcast_to(np.eye(3), (*q.shape[:-1], 3, 3))
        shift = np.zeros((*q.shape[:-1], 3))
        axes, origins = [], []
        for i in range(self.n_joints):
            axes.append(rotation @ self.axes[i])
            origins.append(rotation @ self.points_mm[i] + shift)
            if self.joint_kinds[i] == "prismatic":
                shift = shift + q[..., i, None] * axes[i]
                continue
            x, y, z = self.axes[i]
            cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            value = q[..., i, None, None]
            rotation = (
                rotation
                + np.sin(value) * (rotation @ cross)
                + (1 - np.cos(value)) * (rotation @ (cross @ cross))
            )
            shift = origins[i] - rotation @ self.points_mm[i]
        return (
            np.stack(axes, axis=-2),
            np.stack(origins, axis=-2),
            rotation @ self.tip_mm + shift,
            rotation @ self.tip_rotation,
        )


def roll_pitch_yaw(angles: ArrayLike) -> Floats:
    """Rotation ``Rz(yaw) Ry(pitch) Rx(roll)``.

    Args:
        angles: Roll, pitch and yaw [rad], shape (..., 3).

    Returns:
        Rotation matrices, shape (..., 3, 3).
    """
    angles = np.asarray(angles, float)
    (cr, cp, cy), (sr, sp, sy) = (
        np.moveaxis(np.cos(angles), -1, 0),
        np.moveaxis(np.sin(angles), -1, 0),
    )
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def angles_of(rotation: Floats) -> Floats:
    """Roll, pitch and yaw [rad] of a rotation, shape (3,): `roll_pitch_yaw` undone.

    Args:
        rotation: Rotation matrix, shape (3, 3).

    Returns:
        Pitch within a quarter turn; where it is one, only the difference of roll and yaw means
        anything, and yaw is zero.
    """
    level = float(np.hypot(rotation[0, 0], rotation[1, 0]))
    pitch = np.arctan2(-rotation[2, 0], level)
    if level < 1e-9:
        return np.array([np.arctan2(-rotation[1, 2], rotation[1, 1]), pitch, 0.0])
    roll = np.arctan2(rotation[2, 1], rotation[2, 2])
    return np.array([roll, pitch, np.arctan2(rotation[1, 0], rotation[0, 0])])


Kind = Literal["revolute", "continuous", "prismatic", "fixed"]
MOST_METRES = 1e4
MOST_READ, MOST_MOVING = 500, 32
"""Of a file, fixed ones too, and between base and tool; no arm has so many, and each takes time."""
KINDS: tuple[Kind, ...] = get_args(Kind)


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint of a file, and how it sits between its neighbours.

    Attributes:
        name: Its name.
        kind: How it moves.
        before: From the previous frame to the one in which the axis is given, shape (4, 4) [m].
        axis: The axis there, not zero, shape (3,).
        after: From there, with the joint at zero, to the next frame, shape (4, 4) [m].
        limits: Lower and upper [rad or m]; None: the file gives none.
    """

    name: str
    kind: Kind
    before: Floats
    axis: Floats = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    after: Floats = field(default_factory=lambda: np.eye(4))
    limits: tuple[float, float] | None = None


def assemble(joints: Iterable[Joint]) -> SerialChain:
    """The chain of some joints, in their order from the base to the tool.

    Fixed joints are folded in. A continuous joint gets the limits -pi and pi; one without limits
    gets infinite ones.

    Raises:
        IksamplesError: No joint moves the tool, or a joint's limits leave it no room or its name
            cannot be printed.
    """
    frame = np.eye(4)  # in the base frame, all joints at zero
    names: list[str] = []
    kinds: list[JointKind] = []
    axes, points, limits = [], [], []
    for joint in joints:
        if one_line(joint.name) != joint.name:
            raise IksamplesError(
                f"joint '{joint.name}': its name has characters that cannot be printed; rename it."
            )
        far = max(np.abs(joint.before[:3, 3]).max(), np.abs(joint.after[:3, 3]).max())
        if far > MOST_METRES:
            raise IksamplesError(
                f"joint '{joint.name}' lies {far:g} m from the one before; lengths are in metres."
            )
        frame = frame @ joint.before
        if joint.kind != "fixed":
            names.append(joint.name)
            kinds.append("prismatic" if joint.kind == "prismatic" else "revolute")
            axis = frame[:3, :3] @ joint.axis
            axes.append(axis / np.linalg.norm(axis))
            points.append(frame[:3, 3] * MM_PER_M)
            limits.append(_limits(joint))
        frame = frame @ joint.after
    if not names:
        raise IksamplesError("no moving joint between the base and the tool.")
    if len(names) > MOST_MOVING:
        raise IksamplesError(
            f"{len(names)} moving joints between the base and the tool; no more than {MOST_MOVING} "
            "are read. Choose another base or tip link, or make some joints fixed."
        )
    lower, upper = np.array(limits).T
    chain = SerialChain(
        tuple(names),
        tuple(kinds),
        np.array(axes),
        np.array(points),
        frame[:3, 3] * MM_PER_M,
        lower,
        upper,
        frame[:3, :3],
    )
    if np.abs(chain.jacobian_mm(np.zeros(len(names)))).max() < 1e-9:
        raise IksamplesError(
            "the arm has no length: the tool lies on the axis of every joint, so none moves it."
        )
    return chain


def _limits(joint: Joint) -> tuple[float, float]:
    if joint.kind == "continuous":
        return -np.pi, np.pi
    if joint.limits is None:
        return -np.inf, np.inf
    lower, upper = joint.limits
    if lower >= upper:
        fault = "swapped" if lower > upper else "equal, so that it cannot move"
        raise IksamplesError(
            f"joint '{joint.name}': its limits are {fault} (lower {lower:g}, upper {upper:g})."
        )
    unit = MM_PER_M if joint.kind == "prismatic" else 1.0
    return lower * unit, upper * unit


def number(text: str, what: str) -> float:
    """A finite decimal number.

    Args:
        text: The text.
        what: What it is, for the message.

    Raises:
        IksamplesError: It is no number, or not finite.
    """
    if "$" in text:
        raise IksamplesError(f"{what} is '{text}': expand the xacro first (xacro in > out.urdf).")
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value) or "_" in text:
        raise IksamplesError(f"{what} is '{text}', not a finite number.")
    return value
