"""The drawing, fitted to the samples, and its inverse kinematics."""

from iksamples.arm.chain import Floats
from iksamples.arm.inverse import followed
from iksamples.calibration.fit import fit_samples
from iksamples.methods.predictor import Predictor, Single
from iksamples.samples.dataset import SampleSet
from iksamples.task import Task


def fit(task: Task, samples: SampleSet) -> Predictor:
    """Answers with the joints that are right for the fitted drawing (`calibration.fit`).

    On the branch of the drawing's, from which they are followed. NaN where either cannot reach.
    """
    chain = fit_samples(task, samples).chain

    def answer(x: Floats) -> Floats:
        return followed(task.reach(x), chain)

    return Single(answer)
