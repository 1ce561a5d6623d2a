"""The next poses with which to calibrate an arm: what is known of it, and what to record."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from iksamples.arm.chain import Floats, SerialChain
from iksamples.arm.inverse import followed
from iksamples.arm.real import deviated_pose
from iksamples.arm.target import Target
from iksamples.calibration.design import CANDIDATES, optimal, postures, tour
from iksamples.calibration.fit import expectation, fit_arm
from iksamples.calibration.known import NOISE_MM, Fitted, Prior
from iksamples.calibration.rounds import Round, next_round
from iksamples.calibration.worst import POINTS, Measured, judged_effects, worst_mm
from iksamples.errors import IksamplesError
from iksamples.recorded.read import Recording
from iksamples.region import Region
from iksamples.samples.record import region_points
from iksamples.study import Study, Tolerance
from iksamples.task import Task, study_chain


if TYPE_CHECKING:
    import pandas as pd

_POSTURES = 8192
"""Postures in which an arm that may take any is judged. Eight times as many (in a workspace: twice)
find errors that are larger by 1 % for three joints, 3 % for six and 6 % for seven."""
_JUDGED = 256
"""Those of the largest variance, which are kept of them: four times as many find errors that are
larger by a hundredth at most."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """What is asked of a calibration.

    Attributes:
        drawing: The arm as drawn.
        target: What is measured, and judged.
        tolerance: What is good enough, and how sure that has to be.
        prior: How far the arm may be from its drawing.
        noise_mm: How well a coordinate is measured [mm]; None: as the residuals say.
        noise_rad: Likewise a turn's component [rad].
        region: Where the tool is used; None: anywhere.
        reach: The joints with which an arm like it is used there; None: any that do it.
    """

    drawing: SerialChain
    target: Target
    tolerance: Tolerance
    prior: Prior
    noise_mm: float | None
    noise_rad: float
    region: Region | None = None
    reach: Callable[[Floats, SerialChain], Floats] | None = None

    @classmethod
    def of(cls, study: Study, task: Task | None) -> "Calibration":
        """What a study asks; where it has no workspace (no task), positions anywhere."""
        prior, noise_mm, noise_rad = expectation(study.arm.expectation if study.arm else None)
        noise = noise_mm if study.arm else None
        if task is None:
            chain = study_chain(study)
            return cls(chain, Target(), study.tolerance, prior, noise, noise_rad)
        return cls(
            task.drawing,
            task.target,
            study.tolerance,
            prior,
            noise,
            noise_rad,
            task.region,
            lambda x, chain: followed(task.reach(x), chain),
        )

    def fitted(self, recording: Recording | None) -> Fitted:
        """What is known of the arm once some poses are recorded; None: before the first.

        Where they are too few to tell the noise, as if it were the usual one.
        """
        if recording is None:
            return Fitted.unmeasured(self.drawing, self.prior, self.noise_mm)

        def fit(noise_mm: float | None) -> Fitted:
            return fit_arm(
                self.drawing,
                recording.joints,
                recording.position_mm,
                prior=self.prior,
                noise_mm=noise_mm,
                measured_rotation=recording.rotation,
                noise_rad=self.noise_rad,
            )

        if self.noise_mm is not None:
            found = fit(self.noise_mm)
            return found if found.noise_is_plausible else fit(None)
        try:
            return fit(None)
        except IksamplesError:
            return replace(fit(NOISE_MM), noise_estimated=True, freedom=0.0)

    def judged(self, fitted: Fitted) -> Floats:
        """``worst.judged_effects`` over the workspace."""
        if self.region is not None and self.reach is not None:
            joints = self.reach(region_points(self.region, POINTS), fitted.chain)
            return judged_effects(self.target, self.tolerance, fitted, joints)
        joints = self._postures(_POSTURES, 1, POINTS)
        effects = judged_effects(self.target, self.tolerance, fitted, joints)
        # The worst is among those of the largest variance.
        order = np.argsort(-np.sum((effects @ fitted.root) ** 2, axis=(1, 2)))
        return effects[order[:_JUDGED]]

    def next_poses(
        self, fitted: Fitted, count: int | None = None, anywhere: bool = False
    ) -> tuple[Round, Floats]:
        """What to do next, and the postures to record.

        Args:
            fitted: What is known of the arm.
            count: How many poses; None: the fewest that are expected to be enough.
            anywhere: The tool need not be in the workspace.

        Returns:
            The advice, and joint values [rad or mm], shape (poses, joints).

        Raises:
            IksamplesError: The arm has no postures there, or too few.
        """
        joints = self._postures(CANDIDATES, 0, 0 if anywhere else CANDIDATES)
        measured = Measured(
            fitted.noise_mm, self.noise_rad, self.target.positions, self.target.orientation
        )
        informs, judged = measured.informs(fitted, joints), self.judged(fitted)
        wish = self.tolerance
        if count is None:
            found = next_round(fitted, informs, judged, wish.error_mm, wish.confidence)
        else:
            now = worst_mm(fitted, judged, wish.confidence)
            chosen = optimal(fitted, informs, count, judged)
            then = worst_mm(fitted.expecting(informs[chosen]), judged, wish.confidence)
            found = Round(False, now, chosen, then)
        return found, joints[found.chosen]

    def _postures(self, n: int, seed: int, places: int) -> Floats:
        """Postures with the tool in so many places of the region and its corners; 0: anywhere."""
        positions, there = self.target.positions, None
        if self.region is not None and places:
            there = region_points(self.region, places)[:, : len(positions)]
        return postures(self.drawing, n, np.random.default_rng(seed), positions, there)


def in_order(fitted: Fitted, joints: Floats, start: Floats) -> "pd.DataFrame":
    """Postures in the order in which to visit them, with where the tool will be about.

    Args:
        fitted: What is known of the arm.
        joints: Joint values [rad or mm], shape (poses, joints).
        start: Those from which the arm sets out, shape (joints,).

    Returns:
        Columns pose, x_mm, y_mm, z_mm and, for each joint, as q_elbow_rad.
    """
    import pandas as pd

    chain = fitted.drawing
    # A rad counts as a tenth of a metre.
    weight = np.where(chain.revolute, 1.0, 0.01)
    joints = joints[tour(joints * weight, start * weight)]
    position = deviated_pose(chain, fitted.deviations, joints)[0]
    columns: dict[str, object] = {"pose": np.arange(1, len(joints) + 1)}
    columns |= dict(zip(("x_mm", "y_mm", "z_mm"), position.T, strict=True))
    names = [f"q_{n}_{u}" for n, u in zip(chain.joint_names, chain.joint_units, strict=True)]
    return pd.DataFrame(columns | dict(zip(names, joints.T, strict=True)))
