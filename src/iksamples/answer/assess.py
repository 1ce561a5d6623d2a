"""How many samples, by which method, and how sure: the study's answer."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from iksamples.answer.answer import (
    VERSION,
    Answer,
    Comparison,
    Confidence,
    Diagnosis,
    Extrapolation,
    Floor,
    Size,
    Status,
    VariantAnswer,
)
from iksamples.answer.collect import WORKSPACE, Variant, outcomes, read_runs, variants
from iksamples.answer.diagnosis import diagnose
from iksamples.answer.extrapolate import STREAM, Forecast, extrapolate, forecast, seen, shape
from iksamples.answer.sentences import failures, floor_told, headline, of_itself, told
from iksamples.answer.sizes import answer_of, is_random, judge, required_share
from iksamples.columns import RUNS, stored_table
from iksamples.evaluation.errors import FLOOR
from iksamples.results import CUBE, Cell
from iksamples.stats import Floats, Interval, compare, seeds_needed
from iksamples.study import NETWORK, Study
from iksamples.text import described


_MOST_FAILURES = 10_000
"""Where the share seen is so near the required one that more trainings are no advice."""
_TOLERANCES = 60


def answer_study(study: Study, results: str | Path) -> Answer:
    """Answers the study's question from its results.

    Args:
        study: The study.
        results: Its results folder, such as ``results/paper``.

    Raises:
        IksamplesError: The results are not complete, or contradict each other.
    """
    rows = outcomes(study, read_runs(study, results))
    # Of records no network is kept, in which a reason could be looked for.
    folder = None if study.samples.recorded else Path(results)
    return answer(study, rows, folder, read_floor(study, results))


def answer(
    study: Study,
    rows: pd.DataFrame,
    results: Path | None = None,
    floor: Floor | None = None,
) -> Answer:
    """Answers the study's question from the outcomes of its methods.

    Args:
        study: The study.
        rows: What ``outcomes`` returned.
        results: Results folder, in whose files the reasons of a failure are looked for; None: they
            are not.
        floor: What no samples can beat.
    """
    of_variants = variants(rows)
    confidence, sizes = judge(study, of_variants)
    found = [
        _variant_answer(study, variant, of_variants[variant], sizes[variant], confidence)
        for variant in of_variants
    ]
    answers = {Variant(one.method, one.design): one.found for one in found if one.found}
    methods = []
    for one in found:
        why: list[Diagnosis] = []
        if results and one.status != "answered" and one.kind == "network":
            cell = Cell(study, results, one.method, one.shown.label)
            variant, rng = Variant(one.method, one.design), np.random.default_rng(STREAM)
            why = diagnose(study, variant, of_variants, cell, answers, rng)
        own = of_variants[Variant(one.method, one.design)]
        shown = own[own["label"] == one.shown.label]
        sentences = [*told(study, one, confidence), *of_itself(study, shown)]
        sentences += [cause.text for cause in why]
        methods.append(one.model_copy(update={"diagnosis": why, "sentences": sentences}))
    share = float(rows["region_share"].iloc[0])
    return Answer(
        version=VERSION,
        study=study.name,
        digest=study.digest(),
        tolerance=study.tolerance,
        confidence=confidence,
        n_points=int(rows["n_points"].iloc[0]),
        sizes=sorted({size.n_samples for one in methods for size in one.sizes} - {0}),
        region_share=share,
        floor=floor,
        headline=headline(study, methods, confidence, share),
        failures=failures(study, methods),
        variants=methods,
        comparisons=_comparisons(study, of_variants),
    )


def read_floor(study: Study, results: str | Path) -> Floor | None:
    """What the study's arms leave of the error of their own inverse; None where it has none.

    Args:
        study: The study.
        results: Its results folder.
    """
    if study.arm is None:
        return None
    n, errors = len(study.arms), np.zeros(1)
    if not study.arm.repeats:
        rows = stored_table(Path(results) / FLOOR / "errors.parquet")
        rows["region"] = rows["region"].replace({CUBE: WORKSPACE})
        rows = rows.reindex(columns=list(RUNS)).assign(failed="", method=NETWORK)
        errors = outcomes(study, rows)["error_mm"].to_numpy(float)
    middle, worst = float(np.median(errors)), float(errors.max())
    return Floor(
        error_median_mm=middle,
        error_worst_mm=worst,
        n_arms=n,
        sentence=floor_told(study, middle, worst),
    )


def samples_needed(
    study: Study, rows: pd.DataFrame, tolerances_mm: Floats | None = None
) -> pd.DataFrame:
    """Samples needed against tolerance, a line per variant.

    Each tolerance is answered as the study's own is, and its answers hold together as that one's
    do; those of different tolerances are different questions.

    Args:
        study: The study; of its tolerance all but the number counts.
        rows: Outcomes.
        tolerances_mm: Tolerances [mm]; None: 60, evenly spread in the logarithm from the smallest
            to the largest tolerance that any size meets (but for the drawing's inverse).

    Returns:
        By variant and tolerance: method, design, tolerance_mm, n_samples (NaN: no answer), status
        (as in ``answer.VariantAnswer``), certified.
    """
    of_variants = variants(rows)
    if tolerances_mm is None:
        tolerances_mm = _spread(study, judge(study, of_variants)[1])
    known = {
        variant: forecast(study, variant, *seen(study, variant, own))
        for variant, own in of_variants.items()
    }
    records: list[tuple[object, ...]] = []
    for tolerance_mm in tolerances_mm:
        tolerance = study.tolerance.model_copy(update={"error_mm": float(tolerance_mm)})
        asked = study.model_copy(update={"tolerance": tolerance})
        confidence, sizes = judge(asked, of_variants)
        for variant in known:
            one = _verdict(asked, variant, sizes[variant], known[variant], confidence)
            certified = one.found is not None and one.found.certified
            records.append((*variant, tolerance_mm, one.n_samples, one.status, certified))
    names = ["method", "design", "tolerance_mm", "n_samples", "status", "certified"]
    table = pd.DataFrame(records, columns=names).astype({"n_samples": float})
    # Answered tolerance by tolerance; a variant's line is wanted in one piece.
    lines = [table.iloc[position :: len(known)] for position in range(len(known))]
    return pd.concat(lines, ignore_index=True)


class _Verdict(NamedTuple):
    """What one variant comes to at one tolerance."""

    status: Status
    n_samples: int | None
    found: Size | None
    seeds: int | None
    beyond: Extrapolation | None


def _verdict(
    study: Study,
    variant: Variant,
    sizes: list[Size],
    known: Forecast,
    confidence: Confidence,
) -> _Verdict:
    found = answer_of(sizes)
    if found:
        return _Verdict("answered", found.n_samples, found, None, None)
    beyond = seeds = None
    if sizes[-1].n_samples:
        beyond = extrapolate(study, variant, known, study.tolerance.error_mm)
    if is_random(study, variant.method):
        seeds = _seeds_to_settle(study, sizes[-1], confidence)
    if seeds:
        return _Verdict("more-seeds", None, None, seeds, beyond)
    if beyond is None or beyond.n_samples is None:
        return _Verdict("open", None, None, None, beyond)
    return _Verdict("extrapolated", beyond.n_samples, None, None, beyond)


def _variant_answer(
    study: Study,
    variant: Variant,
    rows: pd.DataFrame,
    sizes: list[Size],
    confidence: Confidence,
) -> VariantAnswer:
    """One variant's answer, but for what is said of it."""
    n_samples, curves = seen(study, variant, rows)
    known = forecast(study, variant, n_samples, curves)
    verdict = _verdict(study, variant, sizes, known, confidence)
    return VariantAnswer(
        method=variant.method,
        design=variant.design,
        kind=study.all_methods[variant.method].kind,
        description=described(study, variant.method),
        status=verdict.status,
        n_samples=verdict.n_samples,
        sizes=sizes,
        seeds_needed=verdict.seeds,
        curve=shape(n_samples, curves[0]),
        extrapolation=verdict.beyond,
        diagnosis=[],
        sentences=[],
    )


def _comparisons(study: Study, of_variants: Mapping[Variant, pd.DataFrame]) -> list[Comparison]:
    found = []
    first = next((variant for variant in of_variants if variant.method == NETWORK), None)
    for variant, rows in of_variants.items():
        other = first if variant.method == NETWORK else Variant(NETWORK, variant.design)
        if other is None or other == variant or other not in of_variants:
            continue
        chance = is_random(study, variant.method), is_random(study, other.method)
        pairs = compare(rows, of_variants[other], np.random.default_rng(STREAM), chance)
        for n, n_pairs, ratio, low, high, better in pairs.to_numpy(float):
            found.append(
                Comparison(
                    method=variant.method,
                    design=variant.design,
                    other=other.method,
                    other_design=other.design,
                    n_samples=int(n),
                    n_pairs=int(n_pairs),
                    ratio=Interval(ratio, low, high),
                    better=better,
                )
            )
    return found


def _seeds_to_settle(study: Study, size: Size, confidence: Confidence) -> int | None:
    """Trainings it takes to be sure at the share seen, where that is large enough.

    Those that failed stay, and more trainings bring more of them, in the proportion seen.
    """
    needed = required_share(study.tolerance)
    # As if every variant had trainings enough to share in the error.
    each = 1 - (1 - confidence.together) / confidence.n_variants
    seen_share = size.n_met / size.n_seeds
    if size.meets or seen_share <= needed:
        return None
    failures = size.n_seeds - size.n_met
    while failures < _MOST_FAILURES:
        n = seeds_needed(needed, each, failures)
        expected = int(n * (1 - seen_share) + 1e-9)
        if failures >= expected:
            return n
        failures = expected
    return None


def _spread(study: Study, sizes: Mapping[Variant, list[Size]]) -> Floats:
    bounds = [
        size.tolerance_bound_mm
        for variant, of_variant in sizes.items()
        if study.all_methods[variant.method].kind != "nominal"
        for size in of_variant
        if size.tolerance_bound_mm > 0 and np.isfinite(size.tolerance_bound_mm)
    ]
    if not bounds:  # too few trainings for any tolerance: the answer says how many it takes
        return np.empty(0)
    return np.geomspace(min(bounds), max(bounds), _TOLERANCES)
