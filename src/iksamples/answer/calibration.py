"""Whether an answer keeps its word: the same trainings again, with fresh seeds."""

from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import Field, TypeAdapter

from iksamples.answer.answer import Answer, Part
from iksamples.answer.collect import Variant, collect, variants
from iksamples.answer.outcomes import by_rung, outcomes
from iksamples.answer.statistics import best_of_share, share_interval
from iksamples.answer.words import percent, several
from iksamples.errors import IksamplesError
from iksamples.study import NETWORK, Study, Tolerance


if TYPE_CHECKING:
    import pandas as pd

FILE = "calibration.json"
FRESH = "fresh"
"""Folder inside a study's results that holds the fresh trainings."""


class Share(Part):
    """A share with its two-sided 95 % interval."""

    value: float = Field(description="The share.")
    low: float = Field(description="Lower end.")
    high: float = Field(description="Upper end.")


class HitRate(Part):
    """How often fresh trainings met the tolerance."""

    n_samples: int = Field(description="Samples.")
    n_seeds: int = Field(description="Fresh trainings.")
    n_met: int = Field(description="Those that met it.")
    success: Share = Field(
        description="How often the best of `best_of` of them meets it; the share itself where that "
        "is 1."
    )


class Calibration(Part):
    """Fresh trainings at the answer and one rung below."""

    method: str = Field(description="Name of the method.")
    design: str = Field(description="How its samples are placed.")
    at: HitRate = Field(description="At the recommended number of samples.")
    below: HitRate | None = Field(description="One rung below; null: there is none.")
    kept: bool | None = Field(
        description="Whether the share that met the tolerance is at least the promised one; null: "
        "its interval lies on both sides of it."
    )
    sharp: bool | None = Field(
        description="Whether the share one rung below is smaller than promised; null: cannot be "
        "told, or no such rung."
    )
    statement: str = Field(description="The same in sentences.")


def calibrate(
    tolerance: Tolerance,
    fresh: "pd.DataFrame",
    variant: Variant,
    n_samples: int,
    n_below: int | None,
) -> Calibration:
    """Holds an answer against fresh trainings.

    The answer promises a share; the rung below is only not promised. So a rung below that does as
    well is no fault, but the answer was careful there, and the statement says so. A share counts as
    reached or missed where its 95 % interval says so.

    Args:
        tolerance: The wish the answer was given for.
        fresh: Outcomes of seeds that the answer has not seen (200, say), of one method and design.
        variant: The method and design they are of.
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
    kept = _reaches(at.success, tolerance.success_share)
    does_below = below and _reaches(below.success, tolerance.success_share)
    sharp = None if does_below is None else not does_below
    return Calibration(
        method=variant.method,
        design=variant.design,
        at=at,
        below=below,
        kept=kept,
        sharp=sharp,
        statement=_statement(tolerance, at, below, kept, sharp),
    )


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
    variant = Variant(method, one.design)
    rows = variants(outcomes(asked, collect(asked, fresh_results, method)))[variant]
    below = one.below.n_samples if one.below else None
    return calibrate(answer.tolerance, rows, variant, one.n_samples, below)


def read_calibrations(results: str | Path) -> list[Calibration]:
    """What fresh trainings said of a study's answers; nothing where it asked for none.

    Raises:
        IksamplesError: The file cannot be read.
    """
    file = Path(results) / FILE
    if not file.exists():
        return []
    try:
        return _LIST.validate_json(file.read_bytes())
    except ValueError as error:
        raise IksamplesError(f"{file}: not of this version ({error}). Run it again.") from None


def to_json(found: list[Calibration]) -> str:
    """The text of ``calibration.json``."""
    return _LIST.dump_json(found, indent=2).decode() + "\n"


def _rate(tolerance: Tolerance, n: int, group: "pd.DataFrame") -> HitRate:
    met, n_seeds = int((group["error_mm"] <= tolerance.error_mm).sum()), len(group)
    value, low, high = (
        best_of_share(share, tolerance.best_of) for share in share_interval(met, n_seeds)
    )
    success = Share(value=value, low=low, high=high)
    return HitRate(n_samples=n, n_seeds=n_seeds, n_met=met, success=success)


_LIST = TypeAdapter(list[Calibration])


def _reaches(share: Share, wish: float) -> bool | None:
    """Whether a share is at least the wish; None: its interval leaves both open."""
    if share.low >= wish:
        return True
    return False if share.high < wish else None


def _statement(
    tolerance: Tolerance,
    at: HitRate,
    below: HitRate | None,
    kept: bool | None,
    sharp: bool | None,
) -> str:
    promised = percent(tolerance.success_share)
    verdict = {
        True: "The answer keeps its word",
        False: "The answer does not keep its word",
        None: "Whether the answer keeps its word cannot be told from so few",
    }[kept]
    text = f"{verdict}: with {_in_words(tolerance, at)}; promised were {promised}."
    if below is None:
        return text
    text += f" One rung below, with {_in_words(tolerance, below)}"
    if sharp:
        return f"{text}: too few."
    if sharp is None:
        return f"{text}: it cannot be told whether that is enough."
    more = ", so the answer was more careful than it had to be" if kept else ""
    return f"{text}: enough as well{more}."


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
