"""Beyond the ladder: what the learning curves say where no number of samples tried was enough."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from iksamples.answer.collect import Variant
from iksamples.answer.curves import Curve, Law, Summary, fit_seeds
from iksamples.answer.outcomes import errors_matrix
from iksamples.answer.statistics import Draws, Floats, share_quantile, single_share
from iksamples.study import Study


if TYPE_CHECKING:
    import pandas as pd

MOST = 8
"""Extrapolates to at most so many times the most samples tried: half of a grid's spacing."""
TRUSTED = 0.25
"""A curve that misses the held-out rung by a larger share is not extrapolated."""
_LEFT_OUT = 3
"""Curves are fitted to the whole ladder and without its smallest one and two rungs."""


@dataclass(frozen=True)
class Beyond:
    """What the curves say of one tolerance.

    Attributes:
        verdict: ``extrapolated``, ``unreachable`` or ``open``.
        n_samples: Samples to take, where extrapolated: a whole grid for a design of grids.
        curve: The curve used; None: there is none.
        reason: Why the verdict is ``open``.
    """

    verdict: Literal["extrapolated", "unreachable", "open"]
    n_samples: int | None = None
    curve: Curve | None = None
    reason: str = ""


def is_random(study: Study, method: str) -> bool:
    """Whether chance has a part in a method: a network's seed, and nothing in the others."""
    return study.all_methods[method].kind == "network"


def grows_with_samples(study: Study, method: str) -> bool:
    """Whether more samples also mean a longer training: a fixed number of passes over them.

    Then the error falls with the samples for two reasons, and what looks like a floor may be the
    end of the training.
    """
    training = study.all_methods[method].training
    return is_random(study, method) and training.steps is None and training.optimizer == "adam"


def laws(variant: Variant) -> tuple[Law, ...]:
    """Laws that suit a variant: the grid's own law is for even grids alone."""
    return ("grid", "power") if variant.design == "grid" else ("power",)


def fitted(
    variant: Variant, of_variant: "pd.DataFrame", resampled: Draws, summary: Summary, skip: int = 0
) -> list[Curve]:
    """Learning curves of one variant, one for each law that its rungs are enough for.

    Args:
        variant: The variant.
        of_variant: Its outcomes.
        resampled: Draws of as many seeds as every rung has.
        summary: What is fitted of each rung's seeds.
        skip: Smallest rungs to leave out.
    """
    matrix = errors_matrix(of_variant)
    n = matrix.columns.to_numpy(float)
    m = np.cbrt(n)
    errors = matrix.to_numpy(float)
    fits = [
        fit_seeds(law, n[skip:], m[skip:], errors[:, skip:], resampled, summary)
        for law in laws(variant)
    ]
    return [curve for curve in fits if curve is not None]


def curves_to_extrapolate(
    study: Study, variant: Variant, of_variant: "pd.DataFrame", resampled: Draws
) -> list[Curve]:
    """Curves of the error that the wished share of trainings does not exceed.

    Of the whole ladder and without its smallest one and two rungs, since the first rungs often lie
    on no curve and bend it; and only those with a rung left to be tested on.
    """
    share = single_share(study.tolerance.success_share, study.tolerance.best_of)

    def quantile(errors: Floats, axis: int) -> Floats:
        return share_quantile(errors, share, axis)

    curves = []
    for skip in range(_LEFT_OUT):
        curves += fitted(variant, of_variant, resampled, quantile, skip)
    return [curve for curve in curves if curve.held_out is not None]


def look_beyond(
    study: Study, variant: Variant, curves: list[Curve], tolerance_mm: float, largest: int
) -> Beyond:
    """What the curves say of a tolerance that the ladder does not meet.

    The curve that predicted the held-out largest rung best is used, unless it missed that too by
    more than a quarter.

    * *unreachable*: every curve that did not miss, and every one with a free exponent, stays above
      the tolerance with the confidence asked for; and more samples mean no longer training.
    * *extrapolated*: the curve used comes down to it, with that confidence, within ``MOST`` times
      the most samples tried.
    * *open*: anything else.

    Args:
        study: The study.
        variant: The method and design.
        curves: What ``curves_to_extrapolate`` returned.
        tolerance_mm: The tolerance [mm].
        largest: Most samples tried.
    """
    confidence, by_chance = study.tolerance.confidence, is_random(study, variant.method)
    if not curves:
        return Beyond("open", reason="too few numbers of samples for a learning curve")
    curve = min(curves, key=_miss)
    if _miss(curve) > TRUSTED:
        much = f"{100 * _miss(curve):.0f} %"
        reason = f"fitted without the most samples tried, its learning curve misses them by {much}"
        return Beyond("open", curve=curve, reason=reason)
    if by_chance and not curve.floor_mm.known:
        return Beyond("open", curve=curve, reason="too few seeds to tell how sure its curve is")
    if by_chance and _stay_above(curves, tolerance_mm, confidence):
        if not grows_with_samples(study, variant.method):
            return Beyond("unreachable", curve=curve)
        reason = (
            "its learning curve has levelled off above the tolerance, yet with a fixed number of "
            "epochs more samples also train it longer, so that may be no floor (training.steps "
            "would tell)"
        )
        return Beyond("open", curve=curve, reason=reason)
    needed = curve.needed(tolerance_mm, confidence)
    n = needed.upper if by_chance else needed.n_samples
    reason = ""
    if by_chance and curve.law == "power" and curve.exponent.low <= 0:
        reason = "its learning curve may as well be flat (the interval of its exponent spans 0)"
    elif not np.isfinite([n, needed.n_samples]).all():
        reason = "its learning curve may level off above the tolerance or below it"
    elif n > MOST * largest:
        reason = f"by its learning curve more than {MOST * largest}, too far to extrapolate"
    elif n <= largest:
        reason = (
            "its learning curve is at the tolerance already, and the trainings scatter about it"
        )
    if reason:
        return Beyond("open", curve=curve, reason=reason)
    return Beyond("extrapolated", _whole_design(variant, n), curve)


def _miss(curve: Curve) -> float:
    return abs(curve.held_out.relative_error) if curve.held_out else np.inf


def _stay_above(curves: list[Curve], tolerance_mm: float, confidence: float) -> bool:
    """Whether the curves never come down to a tolerance, as surely as asked."""
    asked = [curve for curve in curves if curve.law == "power" or _miss(curve) <= TRUSTED]
    return any(curve.law == "power" for curve in asked) and all(
        curve.needed(tolerance_mm, confidence).reachable <= 1 - confidence for curve in asked
    )


def _whole_design(variant: Variant, n_samples: float) -> int:
    """The next number of samples that the design can have."""
    if variant.design not in ("grid", "chebyshev"):
        return int(np.ceil(n_samples))
    return int(np.ceil(np.cbrt(n_samples) - 1e-9)) ** 3
