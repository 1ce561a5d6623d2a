"""Which sizes meet the tolerance, so that all answers of a study hold together.

The claim "n samples are enough" is a test per size of a variant: of its trainings k of N met the
tolerance, and the one-sided Clopper-Pearson lower bound of their true share reaches the share that
is required. Two things keep the confidence what it says though many sizes of many variants are
tested:

* Within a variant the sizes are tested from the largest down to the first that fails, a fixed
  sequence, which costs nothing (Maurer, Hothorn and Lehmacher 1995).
* Between variants the error is shared: of a variants' sequences each gets alpha / a. A sequence
  that is confirmed to its smallest size hands its share on (Holm 1979), and one whose trainings are
  too few to confirm anything needs none (Tarone 1990).

This holds whatever the variants have in common. Suppose that some variants have a size that is not
enough; a false claim needs one of them to confirm the first such size of its sequence. Before the
first time that happens none of them is complete, so at most as many as share the error could do it,
each with probability alpha / a at most.

A method that leaves nothing to chance meets the tolerance or does not, and shares in no error.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from iksamples.answer.answer import Confidence, Size
from iksamples.answer.collect import Variant
from iksamples.errors import IksamplesError
from iksamples.methods.registry import KINDS
from iksamples.stats import Floats, best_of_share, met_needed, share_lower, single_share
from iksamples.study import Study, Tolerance


class Trials(NamedTuple):
    """The trainings of a variant: (trainings, those that met the tolerance) of each size."""

    n_seeds: Sequence[int]
    n_met: Sequence[int]


def is_random(study: Study, method: str) -> bool:
    """Whether chance has a part in a method: a network's seed, the arm, or which records it got."""
    kind = KINDS[study.all_methods[method].kind]
    return (
        kind.stochastic
        or study.arm is not None
        or (study.samples.recorded is not None and kind.needs_samples)
    )


def by_size(rows: pd.DataFrame) -> list[tuple[int, pd.DataFrame]]:
    """The outcomes of one variant for each number of samples, fewest first.

    Raises:
        IksamplesError: Two sets of its samples have the same number of samples.
    """
    groups = []
    for n in sorted(rows["n_samples"].unique()):
        group = rows[rows["n_samples"] == n]
        if group["label"].nunique() > 1:
            labels = " and ".join(group["label"].unique())
            raise IksamplesError(f"{labels} have {n} samples both; leave one of them out.")
        groups.append((int(n), group))
    return groups


def judge(
    study: Study, outcomes: Mapping[Variant, pd.DataFrame]
) -> tuple[Confidence, dict[Variant, list[Size]]]:
    """Holds every size of every variant against the tolerance.

    Args:
        study: The study.
        outcomes: Outcomes of each variant.

    Returns:
        How the confidence is shared, and the sizes of each variant, fewest samples first.

    Raises:
        IksamplesError: Two sets of one variant have the same number of samples.
    """
    tolerance = study.tolerance
    groups = {variant: by_size(rows) for variant, rows in outcomes.items()}
    chance = [variant for variant in groups if is_random(study, variant.method)]
    trials = [trials_of(groups[variant], tolerance.error_mm) for variant in chance]
    confidence = Confidence(
        together=tolerance.confidence,
        n_variants=len(chance),
        each=confidence_of_each(trials, required_share(tolerance), tolerance.confidence),
    )
    sizes = {
        variant: [
            _size(n, group, tolerance, confidence.each if variant in chance else None)
            for n, group in of_variant
        ]
        for variant, of_variant in groups.items()
    }
    return confidence, sizes


def required_share(tolerance: Tolerance) -> float:
    """Share of single trainings that have to meet the tolerance."""
    return single_share(tolerance.success_share, tolerance.best_of)


def trials_of(groups: Sequence[tuple[int, pd.DataFrame]], tolerance_mm: float) -> Trials:
    """How many trainings of each size met a tolerance."""
    errors = [group["error_mm"].to_numpy(float) for _, group in groups]
    return Trials([len(e) for e in errors], [int((e <= tolerance_mm).sum()) for e in errors])


def confidence_of_each(trials: Sequence[Trials], share: float, together: float) -> float:
    """The confidence at which each size is judged, so that all claims hold together.

    Args:
        trials: The variants that are left to chance.
        share: The share of trainings that has to meet the tolerance.
        together: Confidence that no claim about any size of any variant is false.
    """
    left = list(trials)
    while left:
        each = _shared(left, share, together)
        incomplete = [one for one in left if smallest_met(one, share, each) != 0]
        if len(incomplete) == len(left):
            return each
        left = incomplete
    return together


def smallest_met(trials: Trials, share: float, confidence: float) -> int | None:
    """The smallest size that is confirmed together with all larger ones; None: not the largest."""
    found = None
    for i in reversed(range(len(trials.n_met))):
        fewest = met_needed(trials.n_seeds[i], share, confidence)
        if fewest is None or trials.n_met[i] < fewest:
            break
        found = i
    return found


def answer_of(sizes: Sequence[Size]) -> Size | None:
    """The answer: the smallest size that meets the tolerance together with all larger ones.

    One that meets it while a larger one does not is luck in one of the two, and no answer.
    """
    found = None
    for size in reversed(sizes):
        if not size.meets:
            break
        found = size
    return found


def _shared(left: Sequence[Trials], share: float, together: float) -> float:
    """The confidence of each when the error is shared by those that could be confirmed at all."""
    for among in range(1, len(left) + 1):
        each = 1 - (1 - together) / among
        able = sum(met_needed(one.n_seeds[-1], share, each) is not None for one in left)
        if 0 < able <= among:
            return each
    return 1 - (1 - together) / len(left)  # too few trainings for any


def _size(n: int, group: pd.DataFrame, tolerance: Tolerance, confidence: float | None) -> Size:
    """One size; ``confidence`` is None for a method without chance."""
    errors: Floats = np.sort(group["error_mm"].to_numpy(float))
    met = group["error_mm"] <= tolerance.error_mm
    undecided = group["certified"] & ~met & (group["attained_mm"] <= tolerance.error_mm)
    n_seeds, n_met = len(errors), int(met.sum())
    whys = group.loc[group["failed"].ne(""), "failed"]
    fewest: int | None = n_seeds
    rate, lower = float(n_met == n_seeds), None
    if confidence is not None:
        fewest = met_needed(n_seeds, required_share(tolerance), confidence)
        rate = best_of_share(n_met / n_seeds, tolerance.best_of)
        lower = best_of_share(share_lower(n_met, n_seeds, confidence), tolerance.best_of)
    return Size(
        label=str(group["label"].iloc[0]),
        n_samples=n,
        n_seeds=n_seeds,
        n_points=int(group["n_points"].iloc[0]),
        n_met=n_met,
        n_undecided=int(undecided.sum()),
        n_certified=int(group["certified"].sum()),
        success_rate=rate,
        success_rate_lcb=lower,
        meets=fewest is not None and n_met >= fewest,
        tolerance_bound_mm=errors[fewest - 1] if fewest else np.inf,
        error_best_mm=errors[0],
        error_median_mm=float(np.median(errors)),
        error_worst_mm=errors[-1],
        n_failed=len(whys),
        why=str(whys.mode().iloc[0]) if len(whys) else "",
    )
