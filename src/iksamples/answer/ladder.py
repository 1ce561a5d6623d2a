"""The ladder of sample sizes: which rungs meet the tolerance, and which one is the answer."""

from typing import TYPE_CHECKING

import numpy as np

from iksamples.answer.answer import Rung
from iksamples.answer.outcomes import by_rung
from iksamples.answer.statistics import best_of_share, met_needed, share_lower, single_share
from iksamples.study import Tolerance


if TYPE_CHECKING:
    import pandas as pd


def judge(of_variant: "pd.DataFrame", tolerance: Tolerance, by_chance: bool) -> list[Rung]:
    """Holds every rung of a ladder against the tolerance.

    Of n trainings k meet the tolerance. The one-sided Clopper-Pearson lower end p of the share of
    single trainings that would meet it gives 1 - (1 - p)^K for the best of K. The rung meets the
    wish where that reaches ``success_share``. A method without chance meets it or does not.

    Args:
        of_variant: Outcomes of one method on one design.
        tolerance: The wish.
        by_chance: Whether a training succeeds or fails by chance.

    Returns:
        The rungs, fewest samples first.
    """
    return [_rung(n, group, tolerance, by_chance) for n, group in by_rung(of_variant)]


def standing(rungs: list[Rung]) -> Rung | None:
    """The answer: the smallest rung that meets the wish together with all larger ones.

    A rung that meets it while a larger one does not is luck in one of the two, and no answer. That
    every larger rung must meet it has a second use: it makes this a test in a fixed sequence, from
    the largest rung down to the first that fails, so the confidence holds for the rung chosen and
    not only for a rung named in advance, however many rungs there are (Maurer, Hothorn and
    Lehmacher 1995).
    """
    found = None
    for rung in reversed(rungs):
        if not rung.meets:
            break
        found = rung
    return found


def not_counted(rungs: list[Rung]) -> list[int]:
    """Numbers of samples that meet the wish though a larger one does not."""
    answer = standing(rungs)
    first = answer.n_samples if answer else np.inf
    return [rung.n_samples for rung in rungs if rung.meets and rung.n_samples < first]


def needed_on_ladder(rungs: list[Rung], tolerance_mm: float) -> Rung | None:
    """The answer for another tolerance, at the same share and confidence."""
    found = None
    for rung in reversed(rungs):
        if rung.kept_mm is None or rung.kept_mm > tolerance_mm:
            break
        found = rung
    return found


def _rung(n: int, group: "pd.DataFrame", tolerance: Tolerance, by_chance: bool) -> Rung:
    errors = np.sort(group["error_mm"].to_numpy(float))
    met = group["error_mm"] <= tolerance.error_mm
    undecided = group["certified"] & ~met & (group["attained_mm"] <= tolerance.error_mm)
    n_seeds, n_met = len(errors), int(met.sum())
    if by_chance:
        wish, confidence = tolerance.success_share, tolerance.confidence
        lower = best_of_share(share_lower(n_met, n_seeds, confidence), tolerance.best_of)
        fewest = met_needed(n_seeds, single_share(wish, tolerance.best_of), confidence)
        success = best_of_share(n_met / n_seeds, tolerance.best_of)
        kept = errors[fewest - 1] if fewest else np.inf
        meets = fewest is not None and n_met >= fewest
    else:
        lower, success, kept = None, float(n_met == n_seeds), errors[-1]
        meets = n_met == n_seeds
    return Rung(
        label=str(group["label"].iloc[0]),
        n_samples=n,
        n_seeds=n_seeds,
        n_met=n_met,
        n_undecided=int(undecided.sum()),
        n_certified=int(group["certified"].sum()),
        success=success,
        success_lower=lower,
        meets=meets,
        kept_mm=finite(kept),
        error_best_mm=finite(errors[0]),
        error_median_mm=finite(np.median(errors)),
        error_worst_mm=finite(errors[-1]),
    )


def finite(value: float) -> float | None:
    """A number for the answer's file, where null stands for what is not finite."""
    return float(value) if np.isfinite(value) else None
