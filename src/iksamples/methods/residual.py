"""The drawing's inverse, corrected by a Gaussian process that learns by how much it is off."""

from dataclasses import replace

from iksamples.arm.chain import Floats
from iksamples.methods.gaussian_process import regressor
from iksamples.methods.predictor import Predictor, Single
from iksamples.samples.dataset import SampleSet
from iksamples.task import Task


def fit(task: Task, samples: SampleSet) -> Predictor:
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
