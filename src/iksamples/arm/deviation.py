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
