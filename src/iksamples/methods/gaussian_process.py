"""Gaussian-process regression on the samples, wherever they lie."""

import warnings
from typing import TYPE_CHECKING

import numpy as np

from iksamples.arm.chain import Floats
from iksamples.methods.predictor import Predictor, Single, require_at_most
from iksamples.samples.dataset import SampleSet


if TYPE_CHECKING:
    from sklearn.gaussian_process import GaussianProcessRegressor

MOST_SAMPLES = 4096
MOST_TO_TUNE = 256
"""Samples that choose the kernel's two numbers; the cost grows with their cube."""
JITTER = 1e-10
"""Variance added on the kernel's diagonal, as a share of the joints': keeps the solve sound."""


def fit(samples: SampleSet) -> Predictor:
    """The posterior mean of ``regressor``.

    Raises:
        NotApplicableError: There are too many samples for a dense solve.
    """
    process = regressor(samples)

    def answer(x: Floats) -> Floats:
        mean = process.predict(samples.normalise(x))
        return mean.reshape(len(x), -1)

    return Single(answer)


def regressor(
    samples: SampleSet, kind: str = "gaussian-process", noisy: bool = False
) -> "GaussianProcessRegressor":
    """A Gaussian process, one kernel for all joints, in normalised inputs.

    Matern kernel of smoothness 5/2 whose variance and length maximise the marginal likelihood
    (Rasmussen and Williams, *Gaussian Processes for Machine Learning*, sec. 2.2, 4.2.1 and 5.4.1)
    of all samples, or of 256 drawn from them. The squared exponential would suit a smooth arm
    better still, but its matrix is close to singular in double precision already for a grid of 64,
    and the search for its length then ends anywhere. Joints are centred and scaled to unit
    variance.

    Args:
        samples: The samples.
        kind: The method that asks, for the message.
        noisy: Whether joint values have noise, whose variance is a third number to be chosen.

    Raises:
        NotApplicableError: There are too many samples for a dense solve.
    """
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel

    require_at_most(MOST_SAMPLES, samples, kind)
    inputs = samples.normalise(samples.x)
    extent = float(np.ptp(inputs, axis=0).max())
    kernel = ConstantKernel(1.0, (1e-3, 1e9)) * Matern(
        extent, (1e-2 * extent, 1e3 * extent), nu=2.5
    )
    if noisy:
        kernel = kernel + WhiteKernel(1e-2, (JITTER, 1e1))
    some = np.arange(len(inputs))
    if len(inputs) > MOST_TO_TUNE:
        some = np.random.default_rng(0).choice(len(inputs), MOST_TO_TUNE, replace=False)

    with warnings.catch_warnings():
        # It says that a number reached its limit: a long length is as good as an infinite one.
        warnings.simplefilter("ignore", ConvergenceWarning)
        tuned = GaussianProcessRegressor(kernel, alpha=JITTER, normalize_y=True)
        tuned.fit(inputs[some], samples.joints[some])
    if len(some) == len(inputs):
        return tuned
    whole = GaussianProcessRegressor(tuned.kernel_, alpha=JITTER, optimizer=None, normalize_y=True)
    return whole.fit(inputs, samples.joints)
