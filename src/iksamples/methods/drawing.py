"""Methods that know the drawing: its inverse as it is, fitted to the samples, or corrected."""

from dataclasses import replace

from iksamples.arm.chain import Floats
from iksamples.arm.inverse import POSITION_MM, followed
from iksamples.calibration.fit import fit_samples
from iksamples.calibration.worst import POINTS, judged_effects, worst_mm
from iksamples.methods.predictor import Single
from iksamples.methods.scattered import regressor
from iksamples.samples.dataset import SampleSet
from iksamples.samples.record import region_points
from iksamples.study import Tolerance
from iksamples.task import Task


def nominal(task: Task) -> Single:
    """Answers with the joints that are right for the drawing; it needs no samples.

    On an arm that is its drawing no method can beat it. Where the drawing cannot reach, the answer
    is NaN.
    """
    return Single(lambda x: task.reach(x).joints)


def calibrated(task: Task, samples: SampleSet) -> Single:
    """Answers with the joints that are right for the fitted drawing (`calibration.fit`).

    On the branch of the drawing's, from which they are followed. NaN where either cannot reach, so
    that every answer is right for the fitted arm to `inverse.POSITION_MM`; what the arm itself can
    be off adds to that.
    """
    fitted = fit_samples(task, samples)
    chain = fitted.chain

    def answer(x: Floats) -> Floats:
        return followed(task.reach(x), chain)

    joints = answer(region_points(task.region, POINTS))
    left = worst_mm(fitted, judged_effects(task.target, Tolerance(), fitted, joints))
    return Single(answer, confident_mm=POSITION_MM + left)


def residual(task: Task, samples: SampleSet) -> Single:
    """Answers with the drawing's joints plus the process's correction, noise allowed for.

    It needs to know nothing of how the arm differs from its drawing: bending, backlash and worn
    teeth are corrected as well as lengths. NaN where the drawing cannot reach.

    Raises:
        NotApplicableError: There are too many samples for a dense solve.
    """
    corrections = samples.joints - task.reach(samples.x).joints
    process = regressor(replace(samples, joints=corrections), "residual", noisy=True)

    def answer(x: Floats) -> Floats:
        mean = process.predict(samples.normalise(x))
        return task.reach(x).joints + mean.reshape(len(x), -1)

    return Single(answer)
