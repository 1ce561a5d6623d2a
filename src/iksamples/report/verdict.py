"""The first lines of the report: what was found, computed from the results."""

import numpy as np

from iksamples.answer.words import is_paper_recipe
from iksamples.report.data import Grid, ReportData
from iksamples.report.statistics import fall_interval
from iksamples.report.wording import count, mm, path_name, percent, seeds_mean, span, typeset
from iksamples.study import NETWORK, DoubleRectangle, Robot, Workspace


_SATURATION_M = 5
"""The paper sees no further improvement beyond 5 points per axis (abstract and introduction)."""


def verdict(data: ReportData) -> list[str]:
    """The answer, if there is one; the errors beside the paper's; whether its conclusions hold."""
    answer = [typeset(data.answer.headline)] if data.answer else []
    return [*answer, errors_sentence(data), claims_sentence(data)]


def paper_recipe(data: ReportData) -> bool:
    """Whether the networks have the paper's shape and training."""
    return is_paper_recipe(data.study.all_methods[NETWORK])


def paper_task(data: ReportData) -> bool:
    """Whether arm, workspace and kind of path are those of the paper's Table 1."""
    path = data.study.evaluation.paths[data.first_path]
    return (
        data.study.robot == Robot()
        and data.study.workspace == Workspace()
        and isinstance(path, DoubleRectangle)
    )


def errors_sentence(data: ReportData) -> str:
    """How large the error is, with fewest and most samples, and beside the paper's."""
    table = data.measured
    first, last = table.iloc[0], table.iloc[-1]
    who = (
        "networks trained as the paper describes" if paper_recipe(data) else "this study's networks"
    )
    errors = f"miss it by {mm(first.error_mean_mm)} on average with {int(first.n_samples)} samples"
    if len(table) > 1:
        errors += f" and by {mm(last.error_mean_mm)} with {int(last.n_samples)}"
    sentence = f"Sent along {path_name(data, data.first_path)}, {who} {errors} ({seeds_mean(data)})"
    paper = data.on_paper
    if not len(paper):
        return sentence + "."
    ratio = paper["error_mean_mm"] / paper["paper_error_mm"]
    beside = f"{span(ratio.to_list(), 2)} times the paper’s Table 1"
    if not paper_task(data):
        beside += ", which is for another arm, workspace or path"
    return f"{sentence}: {beside}."


def claims_sentence(data: ReportData) -> str:
    """Whether the error levels off, and whether the paper's estimate is an upper bound."""
    estimate = _estimate_clause(data)
    if len(data.grids) < 2:
        return f"{estimate[0].upper()}{estimate[1:]}."
    before, after = levelling_pair(data.grids)
    fall = fall_interval(before.seed_errors(data.first_path), after.seed_errors(data.first_path))
    change = f"{'falls' if fall.value >= 0 else 'rises'} by {percent(abs(fall.value))}"
    where = f"from {before.n} to {after.n} samples"
    if not fall.known:
        few = count(len(after.members), "seed")
        return (
            f"{where[0].upper()}{where[1:]} the error {change}, though {few} cannot say how sure "
            f"that is, and {estimate}."
        )
    interval = f"95 % interval {percent(fall.low)} to {percent(fall.high)}"
    if fall.low > 0:
        claimed = before.m == _SATURATION_M
        place = " where the paper says it does" if claimed else ""
        levelling = f"The error has not levelled off{place}: {where} it still {change} ({interval})"
    else:
        levelling = (
            f"{where[0].upper()}{where[1:]} any further fall is lost in the scatter of the seeds "
            f"({interval})"
        )
    return f"{levelling}, and {estimate}."


def _estimate_clause(data: ReportData) -> str:
    table = data.measured
    below = int(np.sum(table["estimate_mm"] < table["error_mean_mm"]))
    if below:
        grids = f"{below} of {len(table)} grids" if len(table) > 1 else "the only grid"
        return (
            "the paper’s estimate (Eq. 25) is no upper bound, since it lies below the measured "
            f"mean at {grids}"
        )
    worst = float(table["above_estimate"].max())
    if worst > 0:
        return (
            "the paper’s estimate (Eq. 25) lies above the measured mean everywhere, yet is "
            f"exceeded on up to {percent(worst, 1)} of the workspace"
        )
    return "the paper’s estimate (Eq. 25) was exceeded at no point that was tested"


def levelling_pair(grids: list[Grid]) -> tuple[Grid, Grid]:
    """The grid after which the paper sees no improvement (or the last but one), and the last."""
    at = next((grid for grid in grids[:-1] if grid.m == _SATURATION_M), grids[-2])
    return at, grids[-1]
