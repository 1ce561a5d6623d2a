"""What a network's input asks of the tool: which part of its pose, and against what it is measured.

An input names two to six coordinates of the tool's pose in the base frame: its position and, for a
task that turns the tool, roll, pitch and yaw about the fixed axes, as in a URDF:
``R(x) = Rz(yaw) Ry(pitch) Rx(roll) R_reference``. Coordinates that are no input stay at the
reference.
"""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from iksamples.arm.chain import Floats, Unit, roll_pitch_yaw
from iksamples.arm.real import Arm
from iksamples.errors import IksamplesError


COORDINATES = ("x", "y", "z", "roll", "pitch", "yaw")
Orientation = Literal["free", "axis", "fixed"]


@dataclass(frozen=True, eq=False)
class Target:
    """What is asked of the tool.

    Attributes:
        coordinates: The inputs, out of x, y, z, roll, pitch and yaw, in this order. Only the
            positions among them are asked for: (x, y) leaves the height to the arm.
        orientation: ``"free"``: any; ``"axis"``: the tool's z axis points as that of ``R(x)``, and
            the turn about it is free; ``"fixed"``: the rotation is ``R(x)``.
        reference_rotation: Rotation of the tool where roll, pitch and yaw are zero, shape (3, 3).
        reference_position_mm: Coordinates of the positions that are no input [mm], shape (3,).

    Raises:
        IksamplesError: The coordinates are none that can be asked for.
    """

    coordinates: tuple[str, ...] = ("x", "y", "z")
    orientation: Orientation = "free"
    reference_rotation: Floats = field(default_factory=lambda: np.eye(3))
    reference_position_mm: Floats = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        """Refuses coordinates that make no sense together."""
        names = self.coordinates
        if names != tuple(name for name in COORDINATES if name in names) or names[:2] != ("x", "y"):
            raise IksamplesError(
                f"task.inputs: ({', '.join(names)}) is no input; name x, y and what else is wanted "
                f"out of {', '.join(COORDINATES[2:])}, each once and in this order."
            )
        turned = [name for name in names if name in COORDINATES[3:]]
        if turned and self.orientation == "free":
            raise IksamplesError(
                f"task.orientation: with {' and '.join(turned)} among the inputs the tool's "
                "orientation cannot be free; say axis or fixed."
            )

    @property
    def units(self) -> tuple[Unit, ...]:
        """The inputs' units: mm for positions, rad for angles."""
        return tuple("mm" if name in COORDINATES[:3] else "rad" for name in self.coordinates)

    @property
    def positions(self) -> tuple[int, ...]:
        """Which of x, y and z (as 0, 1, 2) are asked for; they are the first inputs."""
        return tuple(COORDINATES.index(name) for name in self.coordinates[: self._n_positions])

    @property
    def _n_positions(self) -> int:
        return self.units.count("mm")

    def wanted(self, x: ArrayLike) -> tuple[Floats, Floats]:
        """The pose that an input asks for.

        Args:
            x: Inputs [mm or rad], shape (..., inputs).

        Returns:
            Position [mm], shape (..., 3), and rotation, shape (..., 3, 3).
        """
        x = np.asarray(x, float)
        position = np.array(np.broadcast_to(self.reference_position_mm, (*x.shape[:-1], 3)))
        position[..., list(self.positions)] = x[..., : self._n_positions]
        angles = np.zeros((*x.shape[:-1], 3))
        turned = [COORDINATES.index(name) - 3 for name in self.coordinates[self._n_positions :]]
        angles[..., turned] = x[..., self._n_positions :]
        return position, roll_pitch_yaw(angles) @ self.reference_rotation

    def position_error_mm(self, arm: Arm, joints: ArrayLike, x: ArrayLike) -> Floats:
        """Distance of the tool centre point from where it is asked to be.

        Args:
            arm: The arm.
            joints: Joint values [rad or mm], shape (..., joints).
            x: Inputs [mm or rad], shape (..., inputs).

        Returns:
            Distances over the positions among the inputs [mm], shape (...).
        """
        x = np.asarray(x, float)
        off = arm.forward_mm(joints)[..., list(self.positions)] - x[..., : self._n_positions]
        return np.linalg.norm(off, axis=-1)

    def angle_error_rad(self, arm: Arm, joints: ArrayLike, x: ArrayLike) -> Floats:
        """Angle by which the tool is turned away from what is asked.

        Between axes where the orientation is ``"axis"``; the geodesic angle on SO(3) where it is
        ``"fixed"``. From sine and cosine both, so right at tiny angles and near pi (metrics: Huynh,
        *J. Math. Imaging Vis.* 35, 2009).

        Args:
            arm: The arm.
            joints: Joint values [rad or mm], shape (..., joints).
            x: Inputs [mm or rad], shape (..., inputs).

        Returns:
            Angles [rad] in [0, pi], shape (...).

        Raises:
            ValueError: The orientation is free.
        """
        if self.orientation == "free":
            raise ValueError("a target with free orientation has no angle error")
        rotation, wanted = arm.rotation(joints), self.wanted(x)[1]
        if self.orientation == "axis":
            a, b = rotation[..., 2], wanted[..., 2]
            return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))
        return turn_between(rotation, wanted)


def turn_between(first: Floats, second: Floats) -> Floats:
    """Angles between rotations of shape (..., 3, 3) [rad], in [0, pi]."""
    between = np.swapaxes(first, -1, -2) @ second
    sine = np.linalg.norm(between - np.swapaxes(between, -1, -2), axis=(-1, -2)) / np.sqrt(8)
    return np.arctan2(sine, (np.trace(between, axis1=-2, axis2=-1) - 1) / 2)
