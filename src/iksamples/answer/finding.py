"""What one variant of the comparison comes to: the answer on its ladder, or what lies beyond it."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from iksamples.answer.answer import Rung, Status
from iksamples.answer.beyond import Beyond, curves_to_extrapolate, is_random, look_beyond
from iksamples.answer.collect import Variant, variants
from iksamples.answer.curves import Curve
from iksamples.answer.ladder import judge, needed_on_ladder, standing
from iksamples.answer.outcomes import errors_matrix
from iksamples.answer.statistics import Floats, draws, met_needed, seeds_needed, single_share
from iksamples.study import Study


if TYPE_CHECKING:
    import pandas as pd

STREAM = 20260523
"""Seed of the resampling: the same results have the same answer, and all lines the same draws."""
_MOST_FAILURES = 10_000
"""Where the share seen is so near the wish that more trainings are no advice."""
_TOLERANCES = 60


@dataclass(frozen=True)
class Finding:
    """What one variant comes to.

    Attributes:
        variant: The method and design.
        status: As in ``answer.MethodAnswer``.
        rungs: Its ladder.
        found: The rung that is the answer; None: there is none.
        beyond: What the learning curves say; None where the ladder has the answer.
        seeds: Trainings that would settle it, where too few is all that is wrong.
    """

    variant: Variant
    status: Status
    rungs: list[Rung]
    found: Rung | None
    beyond: Beyond | None
    seeds: int | None

    @property
    def shown(self) -> Rung:
        """The rung to speak of: the answer, or else the most samples tried."""
        return self.found or self.rungs[-1]

    @property
    def smaller(self) -> Rung | None:
        """The rung below the answer."""
        position = self.rungs.index(self.found) if self.found else 0
        return self.rungs[position - 1] if position else None

    @property
    def n_samples(self) -> int | None:
        """Samples on the ladder or by extrapolation."""
        if self.found:
            return self.found.n_samples
        return self.beyond.n_samples if self.beyond and self.status == "extrapolated" else None


def find(study: Study, variant: Variant, of_variant: "pd.DataFrame") -> Finding:
    """Answers the study's tolerance for one variant.

    Args:
        study: The study.
        variant: The method and design.
        of_variant: Its outcomes.
    """
    by_chance = is_random(study, variant.method)
    rungs = judge(of_variant, study.tolerance, by_chance)
    found = standing(rungs)
    if found:
        return Finding(variant, "answered", rungs, found, None, None)
    curves = _curves(study, variant, of_variant)
    beyond = look_beyond(study, variant, curves, study.tolerance.error_mm, rungs[-1].n_samples)
    seeds = _seeds_to_settle(study, rungs[-1]) if by_chance else None
    return Finding(variant, "more-seeds" if seeds else beyond.verdict, rungs, None, beyond, seeds)


def samples_needed(
    study: Study, rows: "pd.DataFrame", tolerances_mm: Floats | None = None
) -> "pd.DataFrame":
    """Samples needed against tolerance, a variant per method and design.

    Each tolerance is answered as the study's own is: at the same share of trainings and the same
    confidence, on the ladder, and beyond it by the learning curve.

    Args:
        study: The study; of its tolerance all but the number counts.
        rows: Outcomes.
        tolerances_mm: Tolerances [mm]; None: 60, evenly spread in the logarithm from the smallest
            to the largest error that any rung keeps to (but for the exact inverse).

    Returns:
        By variant and tolerance: method, design, tolerance_mm, n_samples (NaN: no answer), status
        (as in ``answer.MethodAnswer``), certified.
    """
    import pandas as pd

    every = variants(rows)
    ladders = {
        variant: judge(of_variant, study.tolerance, is_random(study, variant.method))
        for variant, of_variant in every.items()
    }
    if tolerances_mm is None:
        learned = [
            rungs
            for variant, rungs in ladders.items()
            if study.all_methods[variant.method].kind != "analytic"
        ]
        tolerances_mm = _spread(
            [rung.kept_mm for rungs in learned for rung in rungs if rung.kept_mm]
        )
    records: list[tuple[object, ...]] = []
    for variant, of_variant in every.items():
        rungs, curves = ladders[variant], _curves(study, variant, of_variant)
        largest = rungs[-1]
        for tolerance in tolerances_mm:
            rung = needed_on_ladder(rungs, tolerance)
            if rung:
                certified = rung.n_certified == rung.n_seeds
                records.append((*variant, tolerance, rung.n_samples, "answered", certified))
                continue
            beyond = look_beyond(study, variant, curves, tolerance, largest.n_samples)
            status = "more-seeds" if _too_few(study, largest) else beyond.verdict
            records.append((*variant, tolerance, beyond.n_samples or np.nan, status, False))
    columns = ["method", "design", "tolerance_mm", "n_samples", "status", "certified"]
    return pd.DataFrame(records, columns=columns)


def _too_few(study: Study, rung: Rung) -> bool:
    """Whether there are so few trainings that all of them could not be enough."""
    if rung.success_lower is None:
        return False
    tolerance = study.tolerance
    share = single_share(tolerance.success_share, tolerance.best_of)
    return met_needed(rung.n_seeds, share, tolerance.confidence) is None


def _curves(study: Study, variant: Variant, of_variant: "pd.DataFrame") -> list[Curve]:
    n_seeds = len(errors_matrix(of_variant))
    if not n_seeds:
        return []
    resampled = draws(n_seeds, np.random.default_rng(STREAM))
    return curves_to_extrapolate(study, variant, of_variant, resampled)


def _seeds_to_settle(study: Study, rung: Rung) -> int | None:
    """Trainings it takes to be sure at the share seen, where that is large enough.

    Those that failed stay, and more trainings bring more of them, in the proportion seen.
    """
    tolerance = study.tolerance
    needed = single_share(tolerance.success_share, tolerance.best_of)
    seen = rung.n_met / rung.n_seeds
    if rung.meets or seen <= needed:
        return None
    failures = rung.n_seeds - rung.n_met
    while failures < _MOST_FAILURES:
        n = seeds_needed(needed, tolerance.confidence, failures)
        expected = int(n * (1 - seen) + 1e-9)
        if failures >= expected:
            return n
        failures = expected
    return None


def _spread(kept_mm: list[float]) -> Floats:
    if not kept_mm:  # too few trainings for any tolerance: the answer says how many it takes
        return np.empty(0)
    return np.geomspace(min(kept_mm), max(kept_mm), _TOLERANCES)
