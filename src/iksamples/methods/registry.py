"""The methods by the name that the study file gives them."""

from iksamples.arm.chain import SerialChain
from iksamples.errors import IksamplesError
from iksamples.methods import analytic, cubic, gaussian_process, multilinear, polynomial, rbf
from iksamples.methods.predictor import Fit, Predictor
from iksamples.samples.dataset import SampleSet
from iksamples.study import Study


FITS: dict[str, Fit] = {
    "multilinear": multilinear.fit,
    "cubic": cubic.fit,
    "polynomial": polynomial.fit,
    "rbf": rbf.fit,
    "gaussian-process": gaussian_process.fit,
    "analytic": analytic.fit,
}
"""Kind of method (``study.MethodKind``) -> how it is fitted. Networks are trained instead."""

ON_A_GRID = ("multilinear", "cubic", "polynomial")
"""Kinds that need a sample at every crossing of a grid (``tensor.tensor_grid``)."""


def fit(kind: str, study: Study, chain: SerialChain, samples: SampleSet) -> Predictor:
    """Fits a method to samples.

    Args:
        kind: Key of ``FITS``.
        study: The study.
        chain: Its arm.
        samples: What the method may know.

    Raises:
        NotApplicableError: The method cannot use samples that lie like this.
        IksamplesError: There is no such method, or the samples are faulty.
    """
    if kind not in FITS:
        raise IksamplesError(
            f"no method '{kind}' to fit; there are {', '.join(FITS)} (a network is trained)."
        )
    return FITS[kind](study, chain, samples)
