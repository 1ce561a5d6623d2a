"""Whether an answer keeps its word: the same trainings again, with fresh seeds."""

from pathlib import Path

import pandas as pd
from pydantic import Field, TypeAdapter, ValidationError

from iksamples.answer.answer import Answer, Part, VariantAnswer, first_fault
from iksamples.answer.sizes import by_size
from iksamples.errors import IksamplesError
from iksamples.files import checked
from iksamples.results import sample_sets
from iksamples.stats import Interval, best_of_share, share_interval
from iksamples.study import Study, Tolerance
from iksamples.text import percent, several


FILE = "replication.json"
FRESH = "fresh"
"""Folder inside a study's results that holds the fresh trainings."""

_VERDICTS = {
    True: "The answer keeps its word",
    False: "The answer does not keep its word",
    None: "Whether the answer keeps its word cannot be told from so few",
}
_BELOW = {
    True: "too few",
    False: "enough as well",
    None: "it cannot be told whether that is enough",
}


class HitRate(Part):
    """How often fresh trainings met the tolerance."""

    n_samples: int = Field(description="Samples.")
    n_seeds: int = Field(description="Fresh trainings.")
    n_met: int = Field(description="Those that met it.")
    success: Interval = Field(
        description="How often the best of `best_of` of them meets it; the share itself where that "
        "is 1."
    )


class Replication(Part):
    """Fresh trainings at the answer and one size below."""

    method: str = Field(description="Name of the method.")
    design: str = Field(description="How its samples are placed.")
    at: HitRate = Field(description="At the recommended number of samples.")
    below: HitRate | None = Field(description="One size below; null: there is none.")
    kept: bool | None = Field(
        description="Whether the share that met the tolerance is at least the promised one; null: "
        "its interval lies on both sides of it."
    )
    sharp: bool | None = Field(
        description="Whether the share one size below is smaller than promised; null: cannot be "
        "told, or no such size."
    )
    statement: str = Field(description="The same in sentences.")


_LIST = TypeAdapter(list[Replication])


def answers_to_replicate(answer: Answer) -> list[VariantAnswer]:
    """The answers that chance has a part in."""
    return [one for one in answer.variants if one.kind == "network" and one.found]


def fresh_study(study: Study, one: VariantAnswer) -> Study:
    """A study of one variant's network at its answer and one size below, with fresh seeds.

    Args:
        study: The study; ``replication.seeds`` says how many fresh trainings.
        one: An answer of it.

    Returns:
        The study whose own network is that variant's.
    """
    trainings = [method.training for method in study.all_methods.values()]
    seeds = {
        "seeds": study.replication.seeds,
        "first_seed": max(training.first_seed + training.seeds for training in trainings),
    }
    method, sets = study.all_methods[one.method], sample_sets(study)
    wanted = {sets[size.label][1] for size in (one.smaller, one.found) if size}
    said = "sizes" if study.samples.sizes else "points_per_axis"
    sizes = zip(getattr(study.samples, said), study.sizes, strict=True)
    placing = {said: [size for size, n in sizes if n in wanted], "designs": [one.design]}
    return study.model_copy(
        update={
            "network": method.network,
            "training": method.training.model_copy(update=seeds),
            "methods": {},
            "samples": study.samples.model_copy(update=placing),
        }
    )


def replication(tolerance: Tolerance, one: VariantAnswer, fresh: pd.DataFrame) -> Replication:
    """Holds an answer against fresh trainings.

    The answer promises a share; the size below is only not promised. So a size below that does as
    well is no fault, but the answer was careful there, and the statement says so. A share counts as
    reached or missed where its 95 % interval says so.

    Args:
        tolerance: What the answer was given for.
        one: The answer.
        fresh: Outcomes of seeds that the answer has not seen (200, say).

    Raises:
        IksamplesError: There are no fresh trainings with these samples.
    """
    rates = {n: _rate(tolerance, n, group) for n, group in by_size(fresh)}
    if one.found is None:
        raise IksamplesError(f"{one.method} has no answer among the sizes tried: nothing to check.")
    for size in (one.found, one.smaller):
        if size and size.n_samples not in rates:
            raise IksamplesError(
                f"{one.method}: no fresh trainings with {size.n_samples} samples. Delete its "
                f"folder in {FRESH}/ and run the study again."
            )
    at = rates[one.found.n_samples]
    below = rates[one.smaller.n_samples] if one.smaller else None
    kept = _reaches(at.success, tolerance.success_share)
    does_below = below and _reaches(below.success, tolerance.success_share)
    sharp = None if does_below is None else not does_below
    statement = (
        f"{_VERDICTS[kept]}: with {_in_words(tolerance, at)}; promised were "
        f"{percent(tolerance.success_share)}."
    )
    if below:
        statement += f" One size below, with {_in_words(tolerance, below)}: {_BELOW[sharp]}."
    return Replication(
        method=one.method,
        design=one.design,
        at=at,
        below=below,
        kept=kept,
        sharp=sharp,
        statement=statement,
    )


def read_replications(results: str | Path) -> list[Replication]:
    """What fresh trainings said of a study's answers; nothing where it asked for none.

    Raises:
        IksamplesError: The file cannot be read.
    """
    file = Path(results) / FILE
    if not file.exists():
        return []
    try:
        return _LIST.validate_json(checked(file).read_bytes())
    except ValidationError as error:
        raise IksamplesError(
            f"{file}: not of this version ({first_fault(error)}). Run the study again."
        ) from None


def to_json(found: list[Replication]) -> str:
    """The text of ``replication.json``."""
    return _LIST.dump_json(found, indent=2).decode() + "\n"


def _rate(tolerance: Tolerance, n: int, group: pd.DataFrame) -> HitRate:
    met, n_seeds = int((group["error_mm"] <= tolerance.error_mm).sum()), len(group)
    ends = (best_of_share(share, tolerance.best_of) for share in share_interval(met, n_seeds))
    return HitRate(n_samples=n, n_seeds=n_seeds, n_met=met, success=Interval(*ends))


def _reaches(share: Interval, required: float) -> bool | None:
    """Whether a share is at least the required one; None: its interval leaves both open."""
    if share.low >= required:
        return True
    return False if share.high < required else None


def _in_words(tolerance: Tolerance, rate: HitRate) -> str:
    value, low, high = rate.success
    often = "" if tolerance.best_of == 1 else f"the best of {tolerance.best_of} in "
    return (
        f"{several(rate.n_samples, 'sample')}, {rate.n_met} of {rate.n_seeds} fresh trainings meet "
        f"the tolerance ({often}{percent(value)}, 95 % interval {percent(low)} to {percent(high)})"
    )
