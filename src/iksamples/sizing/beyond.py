"""Beyond the ladder: what the learning curves say where no number of samples tried was enough."""

from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from iksamples.errors import IksamplesError
from iksamples.sizing.curves import Curve, Law, fit_seeds
from iksamples.sizing.ladder import judge, needed_on_ladder
from iksamples.sizing.outcomes import errors_matrix
from iksamples.sizing.statistics import (
    Draws,
    Floats,
    draws,
    interquartile_mean,
    share_quantile,
    single_share,
)
from iksamples.study import Study


if TYPE_CHECKING:
    import pandas as pd

MOST = 8
"""Extrapolates to at most so many times the largest rung: half of a grid's spacing."""
TRUSTED = 0.25
"""A curve that misses the held-out rung by a larger share is not extrapolated."""


class Beyond(NamedTuple):
    """What the curves say of one tolerance.

    Attributes:
        verdict: ``extrapolated``, ``unreachable`` or ``open``.
        n_samples: Samples to take, where extrapolated: a whole grid for a design of grids.
        points_per_axis: m of that grid; None for other designs.
        curve: The curve used; None: there is none.
        reason: Why the verdict is ``open``.
    """

    verdict: Literal["extrapolated", "unreachable", "open"]
    n_samples: int | None
    points_per_axis: int | None
    curve: Curve | None
    reason: str


def learning_curves(
    study: Study, rows: "pd.DataFrame", method: str, resampled: Draws, of: str
) -> list[Curve]:
    """Fits every law that suits the study's design.

    Args:
        study: The study.
        rows: Outcomes.
        method: The method.
        resampled: Draws of seeds, for as many seeds as every rung has.
        of: ``interquartile mean`` over seeds, or ``share quantile``: the error that the wished
            share of trainings does not exceed.
    """
    matrix = errors_matrix(rows, method)
    n = matrix.columns.to_numpy(float)
    grids = rows[rows["method"] == method].groupby("n_samples")["points_per_axis"].first()
    share = single_share(study.tolerance.success_share, study.tolerance.best_of)

    def quantile(errors: Floats, axis: int) -> Floats:
        return share_quantile(errors, share, axis)

    summary = {"interquartile mean": interquartile_mean, "share quantile": quantile}[of]
    laws: list[Law] = ["grid", "power"] if study.samples.design == "grid" else ["power"]
    fits = [
        fit_seeds(law, n, grids.loc[matrix.columns], matrix.to_numpy(float), resampled, summary)
        for law in laws
    ]
    return [curve for curve in fits if curve is not None]


def look_beyond(
    study: Study, curves: list[Curve], tolerance_mm: float, largest: int, by_chance: bool
) -> Beyond:
    """What curves of the share quantile say of a tolerance that the ladder does not meet.

    Of the laws, the one that predicted the held-out largest rung best is used, and none that missed
    it by more than a quarter. It is *unreachable* where the law with a free exponent is identified
    and every trusted law has its floor above the tolerance in as many resamples as the confidence
    asks for; *extrapolated* where the curve comes down to it, with that confidence, within
    ``MOST`` times the largest rung; else *open*.

    Args:
        study: The study.
        curves: Curves of the share quantile over seeds.
        tolerance_mm: The tolerance [mm].
        largest: Most samples tried.
        by_chance: Whether the method's errors scatter over seeds; without, the fit alone counts.
    """
    confidence = study.tolerance.confidence
    tested = [curve for curve in curves if curve.held_out is not None]
    if not tested:
        return Beyond("open", None, None, None, "too few numbers of samples for a learning curve")
    curve = min(tested, key=_miss)
    miss = _miss(curve)
    if miss > TRUSTED:
        reason = f"the learning curve misses the largest number of samples by {100 * miss:.0f} %"
        return Beyond("open", None, None, curve, reason)
    if by_chance and not curve.floor_mm.known:
        return Beyond("open", None, None, curve, "too few seeds for the curve's interval")
    trusted = [one for one in tested if _miss(one) <= TRUSTED]
    if by_chance and _above(trusted, tolerance_mm, confidence):
        return Beyond("unreachable", None, None, curve, "")
    reason = ""
    needed = curve.needed(tolerance_mm, confidence)
    n = needed.upper if by_chance else needed.n_samples
    if by_chance and curve.law == "power" and curve.exponent.low <= 0:
        reason = "the interval of the curve's exponent spans 0"
    elif not np.isfinite(n):
        reason = "the curve may level off above the tolerance, or below it"
    elif n > MOST * largest:
        reason = f"by the curve more than {MOST * largest}, too far to extrapolate"
    elif n <= largest:
        reason = "the curve comes down to the tolerance, yet the trainings scatter about it"
    if reason:
        return Beyond("open", None, None, curve, reason)
    return Beyond("extrapolated", *_whole_design(study, n), curve, "")


def samples_needed(
    study: Study,
    rows: "pd.DataFrame",
    rng: np.random.Generator,
    tolerances_mm: Floats | None = None,
) -> "pd.DataFrame":
    """Samples needed against tolerance, a line per method.

    Each tolerance is answered as the study's own is: at the same share of trainings and the same
    confidence, on the ladder, and beyond it by the learning curve.

    Args:
        study: The study; of its tolerance all but the number counts.
        rows: Outcomes.
        rng: Draws the resamples.
        tolerances_mm: Tolerances [mm]; None: 60, evenly spread in the logarithm from the smallest
            to the largest error that any method's rung keeps to.

    Returns:
        By method and tolerance: method, tolerance_mm, n_samples (NaN: no answer), status
        (``answered``, ``extrapolated``, ``unreachable``, ``more-seeds`` or ``open``, as in
        ``answer.MethodAnswer``), certified.
    """
    import pandas as pd

    names = [name for name in study.all_methods if (rows["method"] == name).any()]
    random = {name: is_random(study, name) for name in names}
    ladders = {name: judge(rows, name, study.tolerance, random[name]) for name in names}
    if tolerances_mm is None:
        tolerances_mm = _spread(
            [rung.kept_mm for rungs in ladders.values() for rung in rungs if rung.kept_mm]
        )
    records: list[tuple[str, float, float, str, bool]] = []
    for name, rungs in ladders.items():
        resampled = draws(len(errors_matrix(rows, name)), rng)
        curves = learning_curves(study, rows, name, resampled, "share quantile")
        for tolerance in tolerances_mm:
            on_ladder = needed_on_ladder(rungs, tolerance)
            if on_ladder:
                certified = on_ladder.n_certified == on_ladder.n_seeds
                records.append((name, tolerance, on_ladder.n_samples, "answered", certified))
                continue
            beyond = look_beyond(study, curves, tolerance, rungs[-1].n_samples, random[name])
            status = beyond.verdict if rungs[-1].kept_mm else "more-seeds"
            n = beyond.n_samples or np.nan
            records.append((name, tolerance, n, status, False))
    columns = ["method", "tolerance_mm", "n_samples", "status", "certified"]
    return pd.DataFrame(records, columns=columns)


def is_random(study: Study, method: str) -> bool:
    """Whether chance has a part in a method: a network's seed, and nothing in the others."""
    return study.all_methods[method].kind == "network"


def _miss(curve: Curve) -> float:
    return abs(curve.held_out.relative_error) if curve.held_out else np.inf


def _above(curves: list[Curve], tolerance_mm: float, confidence: float) -> bool:
    """Whether the floors lie above a tolerance as surely as asked."""
    free = any(curve.law == "power" and not curve.unidentified for curve in curves)
    return free and all(
        curve.needed(tolerance_mm, confidence).reachable <= 1 - confidence for curve in curves
    )


def _whole_design(study: Study, n_samples: float) -> tuple[int, int | None]:
    """The next number of samples that the study's design can have."""
    if study.samples.design != "grid":
        return int(np.ceil(n_samples)), None
    m = int(np.ceil(n_samples ** (1 / 3) - 1e-9))
    return m**3, m


def _spread(kept_mm: list[float]) -> Floats:
    if not kept_mm:
        raise IksamplesError(
            "no number of samples has trainings enough for any tolerance; raise training.seeds or "
            "lower tolerance.success_share."
        )
    return np.geomspace(min(kept_mm), max(kept_mm), 60)
