"""An arm as it really is: its links deviate from the drawing, and its joints from what they read.

Between an encoder and the tool lie the play of the gears and their bending under a load. With the
encoder's reading ``q``, the torque of gravity ``tau(a) = J_z(a)^T (-m g)`` and a joint's stiffness
``k``, the joint really stands at ``a = round(q) +- backlash / 2 + tau(a) / k`` (elastic joints:
Siciliano et al., *Robotics*, sec. 5.2 and 7.2). Gravity pulls along the base's -z.
"""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from iksamples.arm.chain import MM_PER_M, Floats, SerialChain


def deviated(chain: SerialChain, deviations: ArrayLike) -> SerialChain:
    """The chain with every joint, and the tool, displaced and turned with all that it carries.

    With joints i = 1..n, each with its screw axis S_i, and the tool's pose M at zero, the forward
    kinematics (Lynch and Park, *Modern Robotics*, eq. 4.14) become
    ``E_1 exp(S_1 q_1) E_2 exp(S_2 q_2) .. exp(S_n q_n) E_(n+1) M``. That is a chain again, so what
    can be wrong with a drawing (axes, lengths, zeros, base and tool) is all in the ``E_i``; more
    numbers than can be told apart, which is for a prior to settle.

    Args:
        chain: The drawing.
        deviations: A row per joint and one for the tool, shape (joints + 1, 6): a displacement
            [mm] and a rotation vector [rad] about the joint's point, or about the tool centre
            point, both along the base's axes with all joints at zero.
    """
    rows = np.asarray(deviations, float).reshape(chain.n_joints + 1, 6)
    rotation, shift = np.eye(3), np.zeros(3)
    axes, points = [], []
    for i, (move, turn) in enumerate(zip(rows[:, :3], rows[:, 3:], strict=True)):
        centre = chain.points_mm[i] if i < chain.n_joints else chain.tip_mm
        own = rotation_of(turn)
        # E_i maps p to centre + move + own (p - centre); it is put behind those before it.
        shift = shift + rotation @ (centre + move - own @ centre)
        rotation = rotation @ own
        if i < chain.n_joints:
            axes.append(rotation @ chain.axes[i])
            points.append(rotation @ centre + shift)
    return replace(
        chain,
        axes=np.array(axes),
        points_mm=np.array(points),
        tip_mm=rotation @ chain.tip_mm + shift,
        tip_rotation=rotation @ chain.tip_rotation,
    )


def deviated_pose(
    chain: SerialChain, deviations: ArrayLike, joints: ArrayLike
) -> tuple[Floats, Floats, Floats, Floats]:
    """Pose of the deviated chain's tool, and how it changes with the deviations.

    Args:
        chain: The drawing.
        deviations: As `deviated` takes them, shape (joints + 1, 6).
        joints: Joint values [rad or mm], shape (..., joints).

    Returns:
        Position [mm], shape (..., 3); rotation, shape (..., 3, 3); and the derivatives of the
        position [mm] and of the rotation (as angular velocity [rad], in the base frame) by the
        deviations, row after row, each of shape (..., 3, 6 (joints + 1)).
    """
    rows = np.asarray(deviations, float).reshape(chain.n_joints + 1, 6)
    q = np.asarray(joints, float)
    rotation = np.broadcast_to(np.eye(3), (*q.shape[:-1], 3, 3))
    shift = np.zeros((*q.shape[:-1], 3))
    before, turned, centres = [], [], []
    for i, (move, turn) in enumerate(zip(rows[:, :3], rows[:, 3:], strict=True)):
        point = chain.points_mm[i] if i < chain.n_joints else chain.tip_mm
        before.append(rotation)
        turned.append(rotation @ _left_jacobian(turn))
        centres.append(rotation @ (point + move) + shift)
        rotation = rotation @ rotation_of(turn)
        shift = centres[-1] - rotation @ point
        if i == chain.n_joints:
            break
        value, axis = q[..., i, None], chain.axes[i]
        if chain.joint_kinds[i] == "prismatic":
            shift = shift + value * (rotation @ axis)
            continue
        rotation = rotation @ rotation_of(value * axis)
        shift = centres[-1] - rotation @ point
    position = rotation @ chain.tip_mm + shift
    linear, angular = [], []
    for moved, turn, centre in zip(before, turned, centres, strict=True):
        lever = (position - centre)[..., None, :]
        swept = np.cross(np.swapaxes(turn, -1, -2), lever)
        linear += [moved, np.swapaxes(swept, -1, -2)]
        angular += [np.zeros_like(moved), turn]
    return (
        position,
        rotation @ chain.tip_rotation,
        np.concatenate(linear, axis=-1),
        np.concatenate(angular, axis=-1),
    )


def _left_jacobian(vector: Floats) -> Floats:
    """How a turn about a rotation vector [rad], shape (3,), answers its change: SO(3)'s, left.

    Chirikjian, *Stochastic Models, Information Theory, and Lie Groups* 2, sec. 10.6.
    """
    angle = np.linalg.norm(vector)
    cross = np.cross(np.eye(3), vector)
    third = 1 / 6 - angle**2 / 120 if angle < 1e-3 else (angle - np.sin(angle)) / angle**3
    half = np.sinc(angle / (2 * np.pi))
    return np.eye(3) + half**2 / 2 * cross + third * cross @ cross


def rotation_of(vectors: ArrayLike) -> Floats:
    """Rotation matrices of rotation vectors [rad], shape (..., 3) to (..., 3, 3): Rodrigues."""
    x, y, z = np.moveaxis(np.asarray(vectors, float), -1, 0)
    zero = np.zeros_like(x)
    cross = np.stack(
        [np.stack(row, axis=-1) for row in ([zero, -z, y], [z, zero, -x], [-y, x, zero])], axis=-2
    )
    angle = np.linalg.norm(np.stack([x, y, z]), axis=0)[..., None, None]
    half = np.sinc(angle / (2 * np.pi))
    return np.eye(3) + np.sinc(angle / np.pi) * cross + half**2 / 2 * (cross @ cross)


STANDARD_GRAVITY = 9.80665
"""[m/s^2], as the General Conference on Weights and Measures set it in 1901."""

_ITERATIONS = 100
_CONVERGED_RAD = 1e-13


class Arm(Protocol):
    """What errors are measured on: a chain, or an arm whose joints give way."""

    def forward_mm(self, joints: ArrayLike, /) -> Floats:
        """Position of the tool centre point [mm], shape (..., 3)."""

    def rotation(self, joints: ArrayLike, /) -> Floats:
        """Rotation of the tool, shape (..., 3, 3)."""


@dataclass(frozen=True, eq=False)
class RealArm:
    """An arm whose joints are not quite where their encoders say.

    Prismatic joints are.

    Attributes:
        chain: Its links as they are.
        payload_kg: Mass at the tool centre point.
        stiffness_nm_per_rad: Of each revolute joint; infinite for a rigid one.
        backlash_rad: Play of each revolute joint.
        encoder_step_rad: Smallest change that encoders tell apart.
        seed: Says on which side of its play each joint rests, point by point.
    """

    chain: SerialChain
    payload_kg: float = 0.0
    stiffness_nm_per_rad: float = np.inf
    backlash_rad: float = 0.0
    encoder_step_rad: float = 0.0
    seed: tuple[int, ...] = (0,)

    def forward_mm(self, joints: ArrayLike) -> Floats:
        """Where the tool goes when the joints are told so.

        Args:
            joints: What the encoders are to read [rad or mm], shape (..., points, joints).

        Returns:
            Positions [mm], shape (..., points, 3).
        """
        return self.chain.forward_mm(self.actual(joints))

    def rotation(self, joints: ArrayLike) -> Floats:
        """How the tool is turned then, shape (..., points, 3, 3); see ``forward_mm``."""
        return self.chain.rotation(self.actual(joints))

    def actual(self, joints: ArrayLike) -> Floats:
        """Where the joints really are.

        Args:
            joints: What the encoders are to read [rad or mm], shape (..., points, joints).

        Returns:
            The same shape; NaN where the load is too much for the joints.
        """
        unloaded = self._stepped(np.asarray(joints, float))
        unloaded = unloaded + self._play(unloaded.shape)
        actual = unloaded
        for _ in range(_ITERATIONS if self.payload_kg else 0):
            before, actual = actual, unloaded + self._sag(actual)
            moved = np.abs(actual - before)
            if np.nanmax(moved, initial=0.0) < _CONVERGED_RAD:
                return actual
        return np.where(self._settled(actual, unloaded), actual, np.nan)

    def read(self, actual: ArrayLike) -> Floats:
        """What the encoders read where the joints really are, ``actual`` undone but for its steps.

        Args:
            actual: Joint values [rad or mm], shape (..., points, joints).
        """
        unloaded = self.unloaded(actual)
        return self._stepped(unloaded - self._play(unloaded.shape))

    def unloaded(self, actual: ArrayLike) -> Floats:
        """Where the joints would be without their load.

        Args:
            actual: Joint values [rad or mm], shape (..., points, joints).
        """
        actual = np.asarray(actual, float)
        return actual - self._sag(actual)

    def _settled(self, actual: Floats, unloaded: Floats) -> Floats:
        if not self.payload_kg:
            return np.ones((*actual.shape[:-1], 1), bool)
        off = np.abs(unloaded + self._sag(actual) - actual)
        return np.all(off < 1e-9, axis=-1, keepdims=True)

    def _stepped(self, joints: Floats) -> Floats:
        step = self.encoder_step_rad
        if not step:
            return joints
        return np.where(self.chain.revolute, step * np.round(joints / step), joints)

    def _play(self, shape: tuple[int, ...]) -> Floats:
        """Half the play to either side, drawn for each point by its place in the array."""
        if not self.backlash_rad:
            return np.zeros(shape[-1])
        generator = np.random.default_rng(self.seed)
        sides = 2.0 * generator.integers(0, 2, shape[-2:]) - 1.0
        return 0.5 * self.backlash_rad * self.chain.revolute * sides

    def _sag(self, actual: Floats) -> Floats:
        """How far the load bends each joint [rad], shape (..., joints)."""
        if not self.payload_kg:
            return np.zeros(actual.shape)
        force_n = -self.payload_kg * STANDARD_GRAVITY
        torque_nm = self.chain.jacobian_mm(actual)[..., 2, :] / MM_PER_M * force_n
        return self.chain.revolute * torque_nm / self.stiffness_nm_per_rad
