"""How many samples, by which method, and how sure: the study's answer."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from iksamples.answer.answer import (
    VERSION,
    Answer,
    Below,
    Cause,
    Comparison,
    Extrapolation,
    HeldOut,
    LearningCurve,
    MethodAnswer,
    Range,
)
from iksamples.answer.beyond import Beyond, fitted, is_random
from iksamples.answer.causes import causes
from iksamples.answer.collect import Variant, read_runs, variants
from iksamples.answer.curves import Curve
from iksamples.answer.finding import STREAM, Finding, find
from iksamples.answer.ladder import finite, not_counted
from iksamples.answer.outcomes import all_cells, errors_matrix, outcomes
from iksamples.answer.sentences import headline, points_measured, told
from iksamples.answer.statistics import Interval, compare, draws, interquartile_mean
from iksamples.answer.words import described
from iksamples.results import NETWORK, Cell
from iksamples.study import Study


if TYPE_CHECKING:
    import pandas as pd


def answer_study(study: Study, results: str | Path) -> Answer:
    """Answers the study's question from its results.

    Args:
        study: The study.
        results: Its results folder, such as ``results/paper``.

    Raises:
        IksamplesError: The results are not complete, or contradict each other.
    """
    cells = list(all_cells(study, results))
    return answer(study, outcomes(study, read_runs(results)), cells)


def answer(study: Study, rows: "pd.DataFrame", cells: list[Cell]) -> Answer:
    """Answers the study's question from the outcomes of its methods.

    Args:
        study: The study.
        rows: What ``outcomes`` returned.
        cells: Networks on sets of samples, in whose files the causes of a failure are looked for;
            nothing is looked for where a network's cell is not among them.
    """
    of_variants = variants(rows)
    findings = [find(study, variant, of_variant) for variant, of_variant in of_variants.items()]
    answers = {one.variant: one.found for one in findings if one.found}
    of_cells = {(cell.method, cell.label): cell for cell in cells}
    methods = []
    for one in findings:
        why: list[Cause] = []
        cell = of_cells.get((one.variant.method, one.shown.label))
        if cell and not one.found and is_random(study, one.variant.method):
            rng = np.random.default_rng(STREAM)
            why = causes(study, one.variant, of_variants, cell, answers, rng)
        methods.append(_method_answer(study, one, of_variants[one.variant], why))
    return Answer(
        version=VERSION,
        study=study.name,
        digest=study.digest(),
        tolerance=study.tolerance,
        n_points=points_measured(study),
        ladder=sorted({rung.n_samples for one in findings for rung in one.rungs}),
        headline=headline(study, findings),
        methods=methods,
        comparisons=_comparisons(study, of_variants),
    )


def _method_answer(
    study: Study, one: Finding, of_variant: "pd.DataFrame", why: list[Cause]
) -> MethodAnswer:
    rung = one.shown
    return MethodAnswer(
        method=one.variant.method,
        design=one.variant.design,
        kind=study.all_methods[one.variant.method].kind,
        description=described(study, one.variant.method),
        status=one.status,
        n_samples=one.n_samples,
        more_than=None if one.found else rung.n_samples,
        certified=rung.n_certified == rung.n_seeds,
        kept_mm=rung.kept_mm if one.found else None,
        rungs=one.rungs,
        below=_below(study, one),
        not_counted=not_counted(one.rungs),
        seeds_needed=one.seeds,
        curves=_curves(one.variant, of_variant),
        extrapolation=_extrapolation(study, one.beyond) if one.beyond else None,
        causes=why,
        sentences=[*told(study, one), *(cause.text for cause in why)],
    )


def _below(study: Study, one: Finding) -> Below | None:
    """The rung below the answer, and by how much it fails."""
    rung, tolerance = one.smaller, study.tolerance
    if rung is None:
        return None
    lower = rung.success_lower
    return Below(
        n_samples=rung.n_samples,
        short=None if lower is None else tolerance.success_share - lower,
        excess_mm=None if rung.kept_mm is None else rung.kept_mm - tolerance.error_mm,
    )


def _curves(variant: Variant, of_variant: "pd.DataFrame") -> list[LearningCurve]:
    """The learning curves of the interquartile mean, for the figures."""
    n_seeds = len(errors_matrix(of_variant))
    if not n_seeds:
        return []
    resampled = draws(n_seeds, np.random.default_rng(STREAM))
    curves = fitted(variant, of_variant, resampled, interquartile_mean)
    return [_learning_curve(curve) for curve in curves]


def _comparisons(study: Study, of_variants: "dict[Variant, pd.DataFrame]") -> list[Comparison]:
    found = []
    first = next((variant for variant in of_variants if variant.method == NETWORK), None)
    for variant, of_variant in of_variants.items():
        other = first if variant.method == NETWORK else Variant(NETWORK, variant.design)
        if other is None or other == variant or other not in of_variants:
            continue
        chance = is_random(study, variant.method), is_random(study, other.method)
        pairs = compare(of_variant, of_variants[other], np.random.default_rng(STREAM), chance)
        for n, n_pairs, ratio, low, high, better in pairs.to_numpy(float):
            found.append(
                Comparison(
                    method=variant.method,
                    design=variant.design,
                    other=other.method,
                    other_design=other.design,
                    n_samples=int(n),
                    n_pairs=int(n_pairs),
                    ratio=_range(Interval(ratio, low, high)),
                    better=better,
                )
            )
    return found


def _learning_curve(curve: Curve) -> LearningCurve:
    held_out = None
    if curve.held_out:
        held_out = HeldOut(
            n_samples=curve.held_out.n_samples,
            observed_mm=curve.held_out.observed_mm,
            predicted_mm=_range(curve.held_out.predicted_mm),
            relative_error=curve.held_out.relative_error,
        )
    return LearningCurve(
        law=curve.law,
        n_samples=[int(n) for n in curve.n_samples],
        observed_mm=[float(error) for error in curve.observed_mm],
        floor_mm=_range(curve.floor_mm),
        scale_mm=_range(curve.scale_mm),
        exponent=_range(curve.exponent),
        unidentified=curve.unidentified,
        held_out=held_out,
    )


def _extrapolation(study: Study, beyond: Beyond) -> Extrapolation:
    tolerance, curve = study.tolerance, beyond.curve
    needed = curve.needed(tolerance.error_mm, tolerance.confidence) if curve else None
    return Extrapolation(
        curve=_learning_curve(curve) if curve else None,
        n_fit=finite(needed.n_samples) if needed else None,
        n_upper=finite(needed.upper) if needed else None,
        reachable=finite(needed.reachable) if needed else None,
        level_mm=_range(curve.level_mm) if curve else None,
        reason=beyond.reason,
    )


def _range(ends: Interval) -> Range:
    return Range(value=finite(ends.value), low=finite(ends.low), high=finite(ends.high))
