"""The methods by the name that the study file gives them, and what sets each apart."""

from collections.abc import Callable
from dataclasses import dataclass

from iksamples.errors import IksamplesError
from iksamples.methods import drawing, grid, scattered, trigonometric
from iksamples.methods.predictor import Single, Stacked, attempt, no_answer
from iksamples.samples.dataset import SampleSet
from iksamples.task import Task


@dataclass(frozen=True)
class Kind:
    """A kind of method.

    Attributes:
        fit: Fits samples and returns what answers; None where it is trained instead.
        stochastic: Every seed gives another answer.
        needs_grid: Needs a sample at every crossing of a grid (``grid.tensor_grid``).
        certifiable: Its worst case can be proved.
        needs_samples: It learns from the samples at all.
        dense: It solves a matrix of all samples, of ``scattered.MOST_SAMPLES`` at most.
    """

    fit: Callable[[Task, SampleSet], Single] | None
    stochastic: bool = False
    needs_grid: bool = False
    certifiable: bool = False
    needs_samples: bool = True
    dense: bool = False


KINDS: dict[str, Kind] = {
    "network": Kind(None, stochastic=True, certifiable=True),
    "multilinear": Kind(lambda _, s: grid.multilinear(s), needs_grid=True, certifiable=True),
    "cubic": Kind(lambda _, s: grid.cubic(s), needs_grid=True),
    "polynomial": Kind(lambda _, s: grid.polynomial(s), needs_grid=True),
    "rbf": Kind(lambda _, s: scattered.rbf(s), dense=True),
    "gaussian-process": Kind(lambda _, s: scattered.gaussian_process(s), dense=True),
    "nominal": Kind(lambda task, _: drawing.nominal(task), needs_samples=False),
    "calibrated": Kind(drawing.calibrated),
    "trigonometric": Kind(trigonometric.fit),
    "residual": Kind(drawing.residual, dense=True),
}
"""Kind of method (``study.MethodKind``) -> what it is."""


def fit(kind: str, task: Task, samples: SampleSet) -> Single:
    """Fits a method to samples.

    Args:
        kind: Key of ``KINDS``.
        task: What is learned.
        samples: What the method may know.

    Raises:
        NotApplicableError: The method cannot use samples that lie like this.
        IksamplesError: There is no such method to fit, or the samples are faulty.
    """
    of_kind = KINDS.get(kind)
    if of_kind is None or of_kind.fit is None:
        fitted = ", ".join(name for name, one in KINDS.items() if one.fit)
        raise IksamplesError(
            f"no method '{kind}' to fit; there are {fitted} (a network is trained)."
        )
    return of_kind.fit(task, samples)


def fit_each(kind: str, task: Task, samples: SampleSet, seeds: tuple[int, ...]) -> Single | Stacked:
    """Fits a method to what each of some arms has recorded.

    Args:
        kind: Key of ``KINDS``.
        task: What is learned.
        samples: The samples.
        seeds: The arms' seeds.

    Returns:
        A member for each arm; a single one where all arms are as the drawing has them. Each is as
        ``fit_or_failed`` has it.

    Raises:
        NotApplicableError: As ``fit``.
    """
    if not samples.arms:
        return fit_or_failed(kind, task, samples)
    if not KINDS[kind].needs_samples:
        return Stacked([fit_or_failed(kind, task, samples)] * len(seeds), seeds)
    return Stacked([fit_or_failed(kind, task, samples.of(seed)) for seed in seeds], seeds)


def fit_or_failed(kind: str, task: Task, samples: SampleSet) -> Single:
    """As ``fit``; where what was recorded defeats the method, NaN and why (``Single.failed``).

    Raises:
        NotApplicableError: As ``fit``.
    """
    found, why = attempt(f"{kind} on {samples.label}", lambda: fit(kind, task, samples))
    return found or no_answer(samples.joints.shape[1], why)
