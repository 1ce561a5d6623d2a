"""Closed-form inverse kinematics of the arm of a drawing robot: a yaw and two parallel pitches."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from iksamples.arm.chain import Floats, SerialChain
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
