"""A drawing fitted to records, to take away: its uncertainty, its error on records held out."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from iksamples.arm.chain import Floats
from iksamples.arm.real import deviated_pose
from iksamples.arm.target import Orientation
from iksamples.calibration.fit import expectation, fit_samples
from iksamples.calibration.known import Fitted
from iksamples.calibration.worst import Measured
from iksamples.recorded.judge import beginning, off_model, whole_set
from iksamples.recorded.learn import read_checked, recorded_task
from iksamples.recorded.read import Recording
from iksamples.study import Study


if TYPE_CHECKING:
    import pandas as pd

PARTS = 5
"""Parts of the records; each is judged by a fit to the others."""
TIMES = (1, 2, 4)
"""How many times as many records are looked ahead to."""
_STREAM = 70
_COMPONENTS = ("move_x", "move_y", "move_z", "turn_x", "turn_y", "turn_z")


@dataclass(frozen=True, eq=False)
class ArmFit:
    """A drawing fitted to all records.

    Attributes:
        recording: The records.
        doubts: What is odd about them.
        fitted: The fit.
        prior_sd: Standard deviations before [mm and rad], shape (joints + 1, 6).
        drawn_mm: By how much the drawing misses each record [mm], shape (n,).
        held_out_mm: By how much a fit to the other parts misses each record [mm], shape (n,).
        model_mm: What the parameters' uncertainty makes of the tool's position, root mean square
            over the records [mm], with ``TIMES`` as many records like these.
    """

    recording: Recording
    doubts: list[str]
    fitted: Fitted
    prior_sd: Floats
    drawn_mm: Floats
    held_out_mm: Floats
    model_mm: tuple[float, ...]

    def parameters(self) -> "pd.DataFrame":
        """The posterior, a row per parameter: joint, parameter, unit, value, sd, prior_sd.

        A displacement [mm] or a rotation vector [rad] along the base's axes with all joints at
        zero, of a joint with all that it carries or of the tool (`arm.real`).
        """
        import pandas as pd

        names = [*self.recording.joint_names, "tool"]
        sd = np.sqrt(np.diag(self.fitted.covariance)).reshape(self.fitted.deviations.shape)
        return pd.DataFrame(
            {
                "joint": np.repeat(names, len(_COMPONENTS)),
                "parameter": np.tile(_COMPONENTS, len(names)),
                "unit": np.tile(["mm"] * 3 + ["rad"] * 3, len(names)),
                "value": self.fitted.deviations.ravel(),
                "sd": sd.ravel(),
                "prior_sd": self.prior_sd.ravel(),
            }
        )


def fit_recording(study: Study) -> ArmFit:
    """Fits the study's drawing to all its records.

    Args:
        study: The study, with ``samples.recorded``.

    Raises:
        IksamplesError: The records cannot be read or used.
    """
    recording, doubts = read_checked(study, has_drawing=True)
    task, whole, n = recorded_task(study, recording), whole_set(study, recording), len(recording)
    held_out = np.empty(n)
    order = np.random.default_rng([0, _STREAM]).permutation(n)
    for part in np.array_split(order, PARTS):
        others = np.setdiff1d(order, part)
        model = fit_samples(task, beginning(whole, others)).chain
        held_out[part] = off_model(model, recording, part)[0]
    fitted = fit_samples(task, whole)
    prior_sd = expectation(task.expected)[0].deviations(task.drawing.n_joints)
    every: Any = np.arange(n)
    return ArmFit(
        recording,
        doubts,
        fitted,
        prior_sd,
        off_model(task.drawing, recording, every)[0],
        held_out,
        _model_mm(study, fitted, recording),
    )


def _model_mm(study: Study, fitted: Fitted, recording: Recording) -> tuple[float, ...]:
    """The model's uncertainty with ``TIMES`` as many records like these."""
    noise_rad = expectation(study.recording.assumed)[2]
    turned: Orientation = "free" if recording.rotation is None else "fixed"
    measured = Measured(fitted.noise_mm, noise_rad, tuple(recording.positions), turned)
    informs = measured.informs(fitted, recording.joints)
    # As much as all of them tell, in no more rows than there are parameters.
    told = np.linalg.qr(informs.reshape(-1, informs.shape[-1]), mode="r")
    by = deviated_pose(fitted.drawing, fitted.deviations, recording.joints)[2]
    left = [fitted.expecting(np.sqrt(times - 1) * told).root for times in TIMES]
    moved = [by[:, recording.positions] @ root for root in left]
    return tuple(float(np.sqrt(np.mean(np.sum(one**2, axis=(1, 2))))) for one in moved)
