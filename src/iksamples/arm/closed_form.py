"""Analytic inverse kinematics with an explicit branch.

The one arm-specific piece of the package. A solver takes its lengths from the chain, refuses a
chain it does not fit, and answers on one named branch; another arm registers a solver of its own in
``SOLVERS``.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iksamples.arm.chain import Floats, SerialChain
from iksamples.errors import IksamplesError
from iksamples.study import Robot


@dataclass(frozen=True)
class Solution:
    """What an inverse kinematics answers.

    Attributes:
        joints: Joint values [rad], shape (points, joints); NaN where the arm cannot reach.
        reachable: Whether the arm's links can reach the point at all, whatever its joint limits,
            shape (points,).
    """

    joints: Floats
    reachable: NDArray[np.bool_]


def yaw_pitch_pitch(chain: SerialChain, positions_mm: ArrayLike, elbow: str) -> Solution:
    """Closed form for a vertical yaw joint and two parallel pitch joints in a plane through it.

    The plane of the arm turns with the yaw; in it, the shoulder, the elbow and the tip form a
    triangle whose third side is known, and the law of cosines gives the elbow (Spong, Hutchinson
    and Vidyasagar, *Robot Modeling and Control*, sec. 5.3). The arm reaches forward (positive
    radius), so that the sign of the elbow angle alone picks the branch.

    Args:
        chain: The arm: at zero its links stand upright above the origin.
        positions_mm: Tool centre points wanted [mm], shape (points, 3).
        elbow: ``"negative"`` or ``"positive"``: sign of the elbow angle.

    Raises:
        IksamplesError: The chain is not of this kind.
    """
    shoulder_mm, upper_mm, fore_mm = _upright_lengths(chain)
    x, y, z = np.asarray(positions_mm, float).T
    radius, height = np.hypot(x, y), z - shoulder_mm
    cosine = (radius**2 + height**2 - upper_mm**2 - fore_mm**2) / (2 * upper_mm * fore_mm)
    # A point on the boundary may miss it by a rounding error.
    reachable = np.abs(cosine) <= 1 + 1e-12
    sign = -1.0 if elbow == "negative" else 1.0
    bend = sign * np.arccos(np.where(reachable, np.clip(cosine, -1, 1), np.nan))
    # Both pitch axes point along -y, so that a positive angle leans the arm back.
    lean = -np.arctan2(radius, height)
    shoulder = lean - np.arctan2(fore_mm * np.sin(bend), upper_mm + fore_mm * np.cos(bend))
    yaw = np.where(reachable, np.arctan2(y, x), np.nan)
    return Solution(np.stack([yaw, shoulder, bend], axis=-1), reachable)


def _upright_lengths(chain: SerialChain) -> tuple[float, float, float]:
    """Shoulder height, upper arm and forearm [mm] of an upright yaw-pitch-pitch chain."""
    up, across = np.array([0.0, 0.0, 1.0]), np.array([0.0, -1.0, 0.0])
    points = np.vstack([chain.points_mm, chain.tip_mm])
    fits = (
        chain.joint_kinds == ("revolute",) * 3
        and np.allclose(chain.axes, [up, across, across])
        and np.allclose(points[:, :2], 0.0)
        and np.all(np.diff(points[1:, 2]) > 0)
    )
    if not fits:
        raise IksamplesError(
            "robot.inverse: 'yaw-pitch-pitch' needs three revolute joints, a yaw about +z and two "
            "pitches about -y, whose links stand upright above the origin at zero; this chain "
            f"({', '.join(chain.joint_names)}) is different."
        )
    shoulder, elbow, tip = points[1:, 2]
    return float(shoulder), float(elbow - shoulder), float(tip - elbow)


Solver = Callable[[SerialChain, ArrayLike, str], Solution]

SOLVERS: dict[str, Solver] = {"yaw-pitch-pitch": yaw_pitch_pitch}
"""Name in the study file (``robot.inverse``) -> solver."""


def inverse(robot: Robot, chain: SerialChain, positions_mm: ArrayLike) -> Solution:
    """Inverse kinematics as the study names it."""
    return SOLVERS[robot.inverse](chain, positions_mm, robot.elbow)
