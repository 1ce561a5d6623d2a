"""Radial basis functions centred on the samples, wherever they lie."""

import numpy as np

from iksamples.arm.chain import Floats
from iksamples.errors import IksamplesError
from iksamples.methods.predictor import Predictor, Single, require_at_most
from iksamples.samples.dataset import SampleSet


MOST_SAMPLES = 4096


def fit(samples: SampleSet) -> Predictor:
    """Interpolates with the cubic kernel r^3 and a linear polynomial, in normalised inputs.

    Of the interpolants of scattered data this is the one with no length to tune: scaling the inputs
    changes nothing (Wendland, *Scattered Data Approximation*, ch. 8 and 11). All samples count
    everywhere.

    Raises:
        NotApplicableError: There are too many samples for a dense solve.
        IksamplesError: Two samples coincide, or all lie in a plane.
    """
    from scipy.interpolate import RBFInterpolator

    require_at_most(MOST_SAMPLES, samples, "rbf")
    try:
        interpolate = RBFInterpolator(samples.normalise(samples.x), samples.joints, kernel="cubic")
    except (np.linalg.LinAlgError, ValueError) as error:
        raise IksamplesError(
            f"rbf: cannot interpolate {samples.label} ({error}). Take out samples of the same "
            "position, and have at least four that do not lie in one plane."
        ) from None

    def answer(x: Floats) -> Floats:
        return interpolate(samples.normalise(x))

    return Single(answer)
