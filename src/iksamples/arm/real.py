"""An arm as it really is: its links deviate from the drawing, and its joints from what they read.

Between an encoder and the tool lie the play of the gears and their bending under a load. With the
encoder's reading ``q``, the torque of gravity ``tau(a) = J_z(a)^T (-m g)`` and a joint's stiffness
``k``, the joint really stands at ``a = round(q) +- backlash / 2 + tau(a) / k`` (elastic joints:
Siciliano et al., *Robotics*, sec. 5.2 and 7.2). Gravity pulls along the base's -z.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from iksamples.arm.chain import MM_PER_M, Floats, SerialChain


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

    @property
    def _turns(self) -> Floats:
        return np.array([kind == "revolute" for kind in self.chain.joint_kinds], float)

    def _stepped(self, joints: Floats) -> Floats:
        step = self.encoder_step_rad
        if not step:
            return joints
        return np.where(self._turns > 0, step * np.round(joints / step), joints)

    def _play(self, shape: tuple[int, ...]) -> Floats:
        """Half the play to either side, drawn for each point by its place in the array."""
        if not self.backlash_rad:
            return np.zeros(shape[-1])
        generator = np.random.default_rng(self.seed)
        sides = 2.0 * generator.integers(0, 2, shape[-2:]) - 1.0
        return 0.5 * self.backlash_rad * self._turns * sides

    def _sag(self, actual: Floats) -> Floats:
        """How far the load bends each joint [rad], shape (..., joints)."""
        if not self.payload_kg:
            return np.zeros(actual.shape)
        force_n = -self.payload_kg * STANDARD_GRAVITY
        torque_nm = self.chain.jacobian_mm(actual)[..., 2, :] / MM_PER_M * force_n
        return self._turns * torque_nm / self.stiffness_nm_per_rad
