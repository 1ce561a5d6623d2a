"""How far a fitted drawing may still send the tool off, and what more poses would make of that.

All is linear in the deviations that are left: where the joints are right for the fitted arm, the
arm itself is off by ``J(q) (d - d_fitted)``, and the posterior says which ``d`` it may be. Nothing
is proved by that: it is a number that few of the arms exceed which the samples leave possible.
"""

from dataclasses import dataclass

import numpy as np

from iksamples.arm.chain import Floats
from iksamples.arm.real import deviated_pose
from iksamples.arm.target import Orientation, Target
from iksamples.calibration.fit import expectation
from iksamples.calibration.known import FEWEST_FREEDOM, Fitted
from iksamples.study import Tolerance
from iksamples.task import Task


DRAWS = 4000
"""Arms drawn; the 95 % quantile of their worst errors is then right to about two per cent."""
POINTS = 120
"""Points over a workspace that are enough, with its corners, where most worst errors are: 4096 find
errors that are larger by less than a hundredth."""
FINEST_MM, FINEST_RAD = 1e-3, 1e-6
"""Poses are chosen as if nothing was measured better than this; without noise any few would do."""
_BLOCK = 500


def worst_mm(fitted: Fitted, judged: Floats, confidence: float = 0.95, draws: int = DRAWS) -> float:
    """The largest error over some postures that is not exceeded, with some confidence.

    Args:
        fitted: What is known of the arm.
        judged: How the tool moves with the deviations in each posture that counts
            (``judged_effects``), shape (points, 3, parameters).
        confidence: Share of the arms that this may be whose worst error is no larger.
        draws: Arms drawn.

    Returns:
        In [mm]; infinite where too little is measured to tell the noise.
    """
    if fitted.noise_estimated and fitted.freedom < FEWEST_FREEDOM:
        return float("inf")
    generator = np.random.default_rng(0)
    rows = judged.reshape(-1, judged.shape[-1])
    largest = []
    for start in range(0, draws, _BLOCK):
        some = fitted.draws(min(_BLOCK, draws - start), generator) - fitted.deviations
        moved = (rows @ some.reshape(len(some), -1).T).reshape(-1, 3, len(some))
        largest.append(np.sqrt(np.max(np.sum(moved**2, axis=1), axis=0)))
    return float(np.quantile(np.concatenate(largest), confidence))


def judged_effects(target: Target, tolerance: Tolerance, fitted: Fitted, joints: Floats) -> Floats:
    """How the tool moves with the deviations in some postures.

    Args:
        target: What is asked of the tool.
        tolerance: Says whether angles are judged as well, and as how many millimetres.
        fitted: The deviations about which it is.
        joints: Postures that stand for the region [rad or mm], shape (points, joints); those that
            are NaN are left out.

    Returns:
        Shape (points, 3, parameters) [mm, and mm/rad]; the turns follow as further points.
    """
    joints = joints[np.isfinite(joints).all(axis=1)]
    _, turned, linear, angular = deviated_pose(fitted.drawing, fitted.deviations, joints)
    asked = np.isin(np.arange(3), target.positions)
    effects = [np.where(asked[:, None], linear, 0.0)]
    if tolerance.angle_deg:
        if target.orientation == "axis":  # a turn about the tool's axis is free
            axis = turned[..., 2]
            angular = angular - axis[..., None] * (axis[:, None] @ angular)
        effects.append(angular * tolerance.error_mm / np.radians(tolerance.angle_deg))
    return np.concatenate(effects)


@dataclass(frozen=True)
class Measured:
    """What of the tool's pose is measured, and how well.

    Attributes:
        noise_mm: Standard deviation of a coordinate [mm].
        noise_rad: Standard deviation of a component of its turn [rad].
        positions: Which of x, y and z, as 0, 1, 2.
        orientation: How much of its turn: nothing (free), its z axis, all (fixed).
    """

    noise_mm: float
    noise_rad: float = 0.0
    positions: tuple[int, ...] = (0, 1, 2)
    orientation: Orientation = "free"

    @classmethod
    def of(cls, task: Task) -> "Measured":
        """What a task's samples hold, as well as is expected."""
        _, noise_mm, noise_rad = expectation(task.expected)
        return cls(noise_mm, noise_rad, task.target.positions, task.target.orientation)

    def informs(self, fitted: Fitted, joints: Floats) -> Floats:
        """How what is measured in some poses depends on the deviations, in units of its noise.

        Args:
            fitted: The deviations about which it is.
            joints: The poses [rad or mm], shape (poses, joints).

        Returns:
            Shape (poses, rows, parameters).
        """
        _, turned, linear, angular = deviated_pose(fitted.drawing, fitted.deviations, joints)
        rows = [linear[:, list(self.positions)] / max(self.noise_mm, FINEST_MM)]
        if self.orientation == "axis":
            angular = np.swapaxes(turned, -1, -2)[:, :2] @ angular
        if self.orientation != "free":
            rows.append(angular / max(self.noise_rad, FINEST_RAD))
        return np.concatenate(rows, axis=1)


def unmeasured(task: Task) -> Fitted:
    """What is known of a task's arm before a sample: the drawing, and the prior."""
    prior, noise_mm, _ = expectation(task.expected)
    return Fitted.unmeasured(task.drawing, prior, noise_mm)
