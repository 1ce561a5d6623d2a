"""Methods that take samples wherever they lie: radial basis functions and a Gaussian process."""

import warnings
from typing import TYPE_CHECKING

import numpy as np

from iksamples.arm.chain import Floats
from iksamples.errors import IksamplesError
from iksamples.methods.predictor import NotApplicableError, Single
from iksamples.samples.dataset import SampleSet
from iksamples.study import RECORDED


if TYPE_CHECKING:
    from sklearn.gaussian_process import GaussianProcessRegressor

MOST_SAMPLES = 4096
"""More make a dense matrix that is not worth solving."""
MOST_TO_TUNE = 256
"""Samples that choose the kernel's two numbers; the cost grows with their cube."""
JITTER = 1e-10
"""Variance added on the kernel's diagonal, as a share of the joints': keeps the solve sound."""


def rbf(samples: SampleSet) -> Single:
    """Interpolates with the cubic kernel r^3 and a linear polynomial, in normalised inputs.

    Of the interpolants of scattered data this is the one with no length to tune: scaling the inputs
    changes nothing (Wendland, *Scattered Data Approximation*, ch. 8 and 11). All samples count
    everywhere.

    Raises:
        NotApplicableError: There are too many samples for a dense solve.
        IksamplesError: Two samples coincide, or all lie in a plane.
    """
    from scipy.interpolate import RBFInterpolator

    _require_few(samples, "rbf")
    try:
        interpolate = RBFInterpolator(samples.normalise(samples.x), samples.joints, kernel="cubic")
    except (np.linalg.LinAlgError, ValueError) as error:
        raise IksamplesError(
            f"rbf: cannot interpolate {samples.label} ({error}). Take out samples of the same "
            f"position, and have at least {samples.x.shape[1] + 1} that do not lie in one plane."
        ) from None
    return Single(lambda x: interpolate(samples.normalise(x)))


def gaussian_process(samples: SampleSet) -> Single:
    """The posterior mean of ``regressor``.

    Raises:
        NotApplicableError: There are too many samples for a dense solve.
    """
    # What was recorded has noise; what is computed has none to allow for.
    process = regressor(samples, noisy=samples.design == RECORDED)

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

    _require_few(samples, kind)
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


def _require_few(samples: SampleSet, kind: str) -> None:
    if samples.n_samples > MOST_SAMPLES:
        raise NotApplicableError(
            f"{kind}: {samples.label} has {samples.n_samples} samples, more than the "
            f"{MOST_SAMPLES} whose dense matrix is worth solving. Use multilinear or cubic on a "
            "grid of this size."
        )
