"""Whether an answer keeps its word: the same trainings again, with fresh seeds."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast

from iksamples.errors import IksamplesError
from iksamples.results import NETWORK, cells
from iksamples.sizing.answer import Answer
from iksamples.sizing.outcomes import by_rung, certificates, outcomes
from iksamples.sizing.statistics import Interval, best_of_share, share_interval
from iksamples.sizing.words import percent, several
from iksamples.study import Design, Study, Tolerance


if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class HitRate:
    """How often fresh trainings met the tolerance.

    Attributes:
        n_samples: Samples.
        n_seeds: Fresh trainings.
        n_met: Those that met it.
        success: How often the best of K of them meets it, with its 95 % interval; the share itself
            where K is 1.
    """

    n_samples: int
    n_seeds: int
    n_met: int
    success: Interval


@dataclass(frozen=True)
class Calibration:
    """Fresh trainings at the answer and one rung below.

    Attributes:
        at: At the recommended number of samples.
        below: One rung below; None: there is none.
        kept: Whether at least the promised share met the tolerance.
        sharp: Whether one rung below it did not; None without such a rung.
        statement: The same in sentences.
    """

    at: HitRate
    below: HitRate | None
    kept: bool
    sharp: bool | None
    statement: str


def calibrate(
    tolerance: Tolerance, fresh: "pd.DataFrame", n_samples: int, n_below: int | None
) -> Calibration:
    """Holds an answer against fresh trainings.

    The answer promises a share; the rung below is only not promised. So a rung below that does as
    well is no fault, but the answer was careful there, and the statement says so.

    Args:
        tolerance: The wish the answer was given for.
        fresh: Outcomes of seeds that the answer has not seen (200, say), of one method and design.
        n_samples: The number of samples recommended.
        n_below: The next smaller one of the ladder; None: there is none.

    Raises:
        IksamplesError: There are no fresh trainings with these samples.
    """
    rates = {n: _rate(tolerance, n, group) for n, group in by_rung(fresh)}
    missing = [n for n in (n_samples, n_below) if n is not None and n not in rates]
    if missing:
        raise IksamplesError(
            f"no fresh trainings with {missing[0]} samples; train the recommended number "
            "of samples and the one below again, with a first_seed of their own."
        )
    at = rates[n_samples]
    below = rates[n_below] if n_below is not None else None
    wish = tolerance.success_share
    kept = at.success.value >= wish
    sharp = None if below is None else below.success.value < wish
    return Calibration(at, below, kept, sharp, _statement(tolerance, at, below, kept, sharp))


def calibrate_study(
    answer: Answer,
    study: Study,
    fresh_study: Study,
    fresh_results: str | Path,
    method: str = NETWORK,
    design: str | None = None,
) -> Calibration:
    """Holds a study's answer against the same study with fresh seeds.

    Args:
        answer: The study's answer.
        study: The study.
        fresh_study: The same with a ``first_seed`` of its own; the answer's number of samples and
            the one below it are enough.
        fresh_results: Its results folder.
        method: Whose answer.
        design: On which samples; None: the study's first design.

    Raises:
        IksamplesError: There is no answer to check, or the seeds are not fresh.
    """
    one = answer.method(method, design)
    if one.status != "answered" or one.n_samples is None:
        raise IksamplesError(
            f"{answer.study}: {method} has no answer on its ladder, so there is nothing to check."
        )
    used, fresh = (s.for_method(method, one.n_samples).seeds for s in (study, fresh_study))
    again = sorted(set(used) & set(fresh))
    if again:
        raise IksamplesError(
            f"{fresh_study.name}: seed {again[0]} gave the answer, so it cannot check it. Set "
            f"training.first_seed to {max(used) + 1} or more."
        )
    asked = fresh_study.model_copy(update={"tolerance": answer.tolerance})
    on = cells(asked, fresh_results, method, cast("Design", one.design))
    rows = outcomes(asked, on, certificates(fresh_results))
    below = one.below.n_samples if one.below else None
    return calibrate(answer.tolerance, rows, one.n_samples, below)


def _rate(tolerance: Tolerance, n: int, group: "pd.DataFrame") -> HitRate:
    met, n_seeds = int((group["error_mm"] <= tolerance.error_mm).sum()), len(group)
    ends = (best_of_share(share, tolerance.best_of) for share in share_interval(met, n_seeds))
    return HitRate(n, n_seeds, met, Interval(*ends))


def _statement(
    tolerance: Tolerance, at: HitRate, below: HitRate | None, kept: bool, sharp: bool | None
) -> str:
    promised = percent(tolerance.success_share)
    verdict = "The answer keeps its word" if kept else "The answer does not keep its word"
    text = f"{verdict}: with {_in_words(tolerance, at)}; promised were {promised}."
    if below is None:
        return text
    text += f" One rung below, with {_in_words(tolerance, below)}"
    if sharp:
        return f"{text}: too few."
    return f"{text}: enough as well, so the answer was more careful than it had to be."


def _in_words(tolerance: Tolerance, rate: HitRate) -> str:
    ends = f"95 % interval {percent(rate.success.low)} to {percent(rate.success.high)}"
    head = (
        f"{several(rate.n_samples, 'sample')}, {rate.n_met} of {rate.n_seeds} fresh trainings meet "
        "the tolerance"
    )
    if tolerance.best_of == 1:
        return f"{head} ({percent(rate.success.value)}, {ends})"
    often = f"{percent(rate.success.value)} of the time"
    return f"{head}, the best of {tolerance.best_of} {often} ({ends})"
