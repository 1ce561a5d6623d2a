"""How many samples, by which method, and how sure: the study's answer."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from iksamples.errors import IksamplesError
from iksamples.results import NETWORK, Cell
from iksamples.sizing import sentences
from iksamples.sizing.answer import (
    VERSION,
    Answer,
    Below,
    Comparison,
    CurveOf,
    Extrapolation,
    HeldOut,
    LearningCurve,
    MethodAnswer,
    Range,
    Rung,
    Status,
)
from iksamples.sizing.beyond import Beyond, is_random, learning_curves, look_beyond
from iksamples.sizing.causes import causes
from iksamples.sizing.curves import Curve
from iksamples.sizing.ladder import finite, judge, not_counted, standing
from iksamples.sizing.outcomes import all_cells, certificates, errors_matrix, outcomes
from iksamples.sizing.statistics import Interval, compare, draws, seeds_needed, single_share
from iksamples.sizing.words import described
from iksamples.study import Study


if TYPE_CHECKING:
    import pandas as pd

_STREAM = 20260523
"""Seed of the resampling: the same study has the same answer."""
_MOST_FAILURES = 10_000
"""Where the share seen is so near the wish that more trainings are no advice."""
_CURVES: tuple[CurveOf, ...] = ("interquartile mean", "share quantile")


def answer_study(study: Study, results: str | Path) -> Answer:
    """Answers the study's question from its results.

    Args:
        study: The study.
        results: Its results folder, such as ``results/paper``; ``certificates.csv`` is used if it
            is there.

    Raises:
        IksamplesError: The results are not complete, or contradict each other.
    """
    cells = list(all_cells(study, results))
    rows = outcomes(study, cells, certificates(results))
    return answer(study, rows, cells)


def answer(study: Study, rows: "pd.DataFrame", cells: list[Cell]) -> Answer:
    """Answers the study's question from the outcomes of its methods.

    Args:
        study: The study.
        rows: What ``outcomes`` returned.
        cells: The methods' cells, in which the causes of a failure are looked for; those of methods
            without outcomes are not touched.
    """
    n_points = _points(study)
    names = [name for name in study.all_methods if (rows["method"] == name).any()]
    ladders = {name: judge(rows, name, study.tolerance, is_random(study, name)) for name in names}
    answers = {name: standing(rungs) for name, rungs in ladders.items()}
    sufficient = {name: rung.n_samples for name, rung in answers.items() if rung}
    methods = []
    beyonds: dict[str, Beyond | None] = {}
    for name in names:
        of_method = {cell.label: cell for cell in cells if cell.method == name}
        one, beyond = _one_method(study, rows, name, ladders[name], of_method, sufficient, n_points)
        methods.append(one)
        beyonds[name] = beyond
    return Answer(
        version=VERSION,
        study=study.name,
        digest=study.digest(),
        tolerance=study.tolerance,
        n_points=n_points,
        ladder=sorted({rung.n_samples for rungs in ladders.values() for rung in rungs}),
        headline=_headline(study, methods, beyonds, n_points),
        methods=methods,
        comparisons=_comparisons(rows, names),
    )


def _one_method(
    study: Study,
    rows: "pd.DataFrame",
    name: str,
    rungs: list[Rung],
    cells: dict[str, Cell],
    sufficient: dict[str, int],
    n_points: int,
) -> tuple[MethodAnswer, Beyond | None]:
    tolerance, by_chance = study.tolerance, is_random(study, name)
    rng = np.random.default_rng(_STREAM)  # the same draws for every method
    resampled = draws(len(errors_matrix(rows, name)), rng)
    curves = {of: learning_curves(study, rows, name, resampled, of) for of in _CURVES}
    found, largest = standing(rungs), rungs[-1]
    beyond, seeds, why = None, None, []
    status: Status = "answered"
    if found is None:
        beyond = look_beyond(
            study, curves["share quantile"], tolerance.error_mm, largest.n_samples, by_chance
        )
        status = beyond.verdict
        seeds = _seeds_to_settle(study, largest) if by_chance else None
        if seeds:
            status = "more-seeds"
        if by_chance and largest.label in cells:
            why = causes(study, rows, cells[largest.label], sufficient, rng)
    below, smaller = _below(study, rungs, found)
    lucky = not_counted(rungs)
    shown = found or largest
    if found:
        lines = sentences.answered(study, found, below, smaller, n_points)
    else:
        lines = sentences.not_answered(study, status, largest, beyond, seeds)
    failing = [rung.n_samples for rung in rungs if not rung.meets]
    lines += sentences.luck(lucky, failing[-1] if failing else 0)
    lines += sentences.undecided(shown) + sentences.reasons(why)
    extrapolated = beyond if beyond and status == "extrapolated" else None
    one = MethodAnswer(
        method=name,
        kind=study.all_methods[name].kind,
        description=described(study, name),
        status=status,
        n_samples=found.n_samples if found else extrapolated and extrapolated.n_samples,
        points_per_axis=(
            found.points_per_axis if found else extrapolated and extrapolated.points_per_axis
        ),
        more_than=None if found else largest.n_samples,
        certified=shown.n_certified == shown.n_seeds,
        kept_mm=found.kept_mm if found else None,
        rungs=rungs,
        below=below,
        not_counted=lucky,
        seeds_needed=seeds,
        curves=[_described_curve(of, curve) for of in _CURVES for curve in curves[of]],
        extrapolation=_extrapolation(study, beyond) if beyond else None,
        causes=why,
        sentences=lines,
    )
    return one, beyond


def _points(study: Study) -> int:
    """Points at which the error that the tolerance is about is measured."""
    where = study.tolerance.where
    if where == "workspace":
        return study.evaluation.cube_points
    return study.evaluation.paths[where].waypoints


def _below(study: Study, rungs: list[Rung], found: Rung | None) -> tuple[Below | None, Rung | None]:
    """The rung below the answer."""
    position = rungs.index(found) if found else 0
    if position == 0:
        return None, None
    rung, tolerance = rungs[position - 1], study.tolerance
    short = None
    if rung.success_lower is not None:
        short = tolerance.success_share - rung.success_lower
    excess = None if rung.kept_mm is None else rung.kept_mm - tolerance.error_mm
    return Below(n_samples=rung.n_samples, short=short, excess_mm=excess), rung


def _seeds_to_settle(study: Study, rung: Rung) -> int | None:
    """Trainings it takes to be sure at the share seen, where that is large enough.

    The share of failures stays as seen, so more trainings bring more failures with them.
    """
    tolerance = study.tolerance
    needed = single_share(tolerance.success_share, tolerance.best_of)
    seen = rung.n_met / rung.n_seeds
    if rung.meets or seen <= needed:
        return None
    failures = 0
    while failures < _MOST_FAILURES:
        n = seeds_needed(needed, tolerance.confidence, failures)
        expected = int(n * (1 - seen) + 1e-9)
        if failures >= expected:
            return n
        failures = expected
    return None


def _headline(
    study: Study, methods: list[MethodAnswer], beyonds: dict[str, Beyond | None], n_points: int
) -> str:
    """The wish; the method that needs fewest samples; the study's own network; the best other.

    The exact inverse is a reference and recommended to nobody who asks for samples.
    """
    if not methods:
        raise IksamplesError(f"{study.name}: no method has results. Run the study to its end.")
    candidates = [one for one in methods if one.kind != "analytic"]
    answered = [one for one in candidates if one.status == "answered"]
    answered.sort(key=lambda one: (one.n_samples or 0, not one.certified, one.kind != "network"))
    best = answered[0] if answered else None
    best_network = next((one for one in answered if one.kind == "network"), None)
    best_other = next((one for one in answered if one.kind != "network"), None)
    own = next((one for one in methods if one.method == NETWORK), None)
    others = []
    for one in (best_network, own, best_other):
        if one and one is not best and one not in others:
            others.append(one)
    clauses = []
    if best:
        rung = next(rung for rung in best.rungs if rung.n_samples == best.n_samples)
        clauses.append(sentences.lead(study, best.method, rung, n_points))
    for one in others or ([] if best else candidates[:1]):
        rung = next((r for r in one.rungs if r.n_samples == one.n_samples), one.rungs[-1])
        clauses.append(
            sentences.clause(
                study, one.method, one.status, rung, beyonds[one.method], one.seeds_needed, n_points
            )
        )
    head = sentences.wish(
        study,
        any(one.certified for one in methods),
        any(one.kind == "network" for one in methods),
        n_points,
    )
    return f"{head}: {'; '.join(clauses)}."


def _comparisons(rows: "pd.DataFrame", names: list[str]) -> list[Comparison]:
    if NETWORK not in names:
        return []
    found = []
    for name in names:
        if name == NETWORK:
            continue
        pairs = compare(rows, name, NETWORK, np.random.default_rng(_STREAM))
        for n, n_pairs, ratio, low, high, better in pairs.to_numpy(float):
            found.append(
                Comparison(
                    method=name,
                    other=NETWORK,
                    n_samples=int(n),
                    n_pairs=int(n_pairs),
                    ratio=_range(Interval(ratio, low, high)),
                    better=better,
                )
            )
    return found


def _described_curve(of: CurveOf, curve: Curve) -> LearningCurve:
    held_out = None
    if curve.held_out:
        held_out = HeldOut(
            n_samples=curve.held_out.n_samples,
            observed_mm=curve.held_out.observed_mm,
            predicted_mm=_range(curve.held_out.predicted_mm),
            relative_error=curve.held_out.relative_error,
        )
    return LearningCurve(
        of=of,
        law=curve.law,
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
        law=curve.law if curve else None,
        n_fit=finite(needed.n_samples) if needed else None,
        n_upper=finite(needed.upper) if needed else None,
        reachable=finite(needed.reachable) if needed else None,
        reason=beyond.reason,
    )


def _range(ends: Interval) -> Range:
    return Range(value=finite(ends.value), low=finite(ends.low), high=finite(ends.high))
