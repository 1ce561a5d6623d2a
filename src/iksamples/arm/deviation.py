"""An arm that differs a little from its drawing: every link a little displaced and turned."""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from iksamples.arm.chain import Floats, SerialChain


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
