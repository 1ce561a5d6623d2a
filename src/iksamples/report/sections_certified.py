"""The section about what is proved: the certified worst case and mean of every network."""

import numpy as np
import pandas as pd

from iksamples.evaluation.errors import CUBE
from iksamples.report import figures_certified
from iksamples.report.blocks import Block, Column, Figure, Number, Section, Table, Text
from iksamples.report.data import Grid, ReportData
from iksamples.report.wording import (
    count,
    grid_name,
    joined,
    minus,
    one_seed,
    percent,
    span,
    thousands,
)
from iksamples.study import NETWORK


_CORNER_MM = 1e-6


def certified_worst_case(data: ReportData) -> Section | None:
    """What is proved of every network; None where nothing is."""
    if data.proofs is None or "label" not in data.proofs:
        return None
    rows = of_network(data)
    if not rows:
        return None
    every = pd.concat(rows.values())
    blocks: list[Block] = [
        Text(_scope(every)),
        Figure(
            "certified-worst-case",
            "",
            "Certified worst case against number of samples: a dot for each network, a line for "
            "the median. Beside it the largest error at the "
            f"{thousands(data.grids[0].n_workspace)} points tested, the enclosed mean (band: its "
            "bounds), and what the paper’s Eq. 25 puts as the upper bound.",
            figures_certified.certified(data, rows),
            f"{(data.results / 'certificates.csv').as_posix()}, {data.source('errors')}, "
            f"{data.source('bounds')}",
            f"{figures_certified.__name__}.certified",
        ),
        Text(_beside(data, rows)),
        _table(data, rows),
        Text(_where(data, rows)),
        # What depends on the machine stays out of the Markdown twin.
        Text(_cost(rows), in_readme=False),
    ]
    others = _other_methods(data)
    return Section(
        "certified", "The certified worst case", [*blocks, *([Text(others)] if others else [])]
    )


def of_network(data: ReportData) -> dict[int, pd.DataFrame]:
    """The certificates of the study's network for each grid of the report, by n."""
    assert data.proofs is not None
    own = data.proofs[data.proofs["method"] == NETWORK]
    found = {}
    for grid in data.grids:
        rows = own[(own["label"] == grid.samples.label) & own["seed"].isin(grid.members["seed"])]
        if len(rows):
            found[grid.n] = rows
    return found


def _scope(rows: pd.DataFrame) -> str:
    """For which function, over which box, in which arithmetic."""
    complete, verified = rows["complete"].astype(bool), rows["verified"].astype(bool)
    ratio = float((rows["sup_upper_mm"] / rows["sup_lower_mm"])[complete].max())
    text = (
        "A largest error among tested points is only a lower bound. The worst case here is "
        "proved for the stored float32 weights read as exact real numbers, over the closed box, "
        "in real arithmetic"
    )
    if verified.all():
        text += "; checked by a separate outward-rounded program"
    elif verified.any():
        text += (
            f"; for {int(verified.sum())} of {len(rows)} networks checked by a separate "
            "outward-rounded program, for the rest not"
        )
    else:
        text += "; not checked by a second program"
    text += "."
    if np.isfinite(ratio):
        text += (
            f" Upper and lower bound differ by at most {percent(ratio - 1, 2)}"
            + ("" if complete.all() else " where the search came to its end")
            + "."
        )
    if not complete.all():
        text += (
            f" For {count(int((~complete).sum()), 'network')} the search ended early: the upper "
            "bound holds all the same, but may be far above the truth."
        )
    return text


def _beside(data: ReportData, rows: dict[int, pd.DataFrame]) -> str:
    """The certified worst case beside the dense maximum, the mean and the paper's estimate."""
    tested, mean, estimates = [], [], []
    for grid in data.grids:
        if grid.n in rows:
            own = rows[grid.n].set_index("seed")
            lower, upper = own["sup_lower_mm"], own["sup_upper_mm"]
            dense = grid.seed_errors(CUBE, "error_max_mm").reindex(own.index)
            tested.append(float((dense / lower).min()))
            mean.append(float(lower.median() / own["mean_upper_mm"].median()))
            estimates.append(float(upper.median() / _estimate(data, grid)))
    return (
        f"The median worst case is at least {span(mean, 1)} times the mean. Testing "
        f"{thousands(data.grids[0].n_workspace)} points finds as little as "
        f"{percent(min(tested), 1)} of a network’s true worst case. Eq. 25 would have to "
        f"be multiplied by {span(estimates, 1)} to reach the median worst case."
    )


def _table(data: ReportData, rows: dict[int, pd.DataFrame]) -> Table:
    several = not one_seed(data)
    worst = "certified worst case [mm]"
    columns = [
        Column("samples", text=True),
        Column("median ≥" if several else "≥", group=worst),
        Column("median ≤" if several else "≤", group=worst, ours=True),
        *([Column("worst seed ≤", group=worst)] if several else []),
        Column("largest tested", "mm"),
        Column("≥", group="certified mean [mm]"),
        Column("≤", group="certified mean [mm]"),
        Column("Eq.\u00a025", "mm"),
        Column("at a corner", "%"),
        Column("boxes"),
        Column("checked"),
    ]
    table: list[list[str | Number]] = []
    for grid in data.grids:
        if grid.n not in rows:
            continue
        own = rows[grid.n]
        tested = grid.seed_errors(CUBE, "error_max_mm").median()
        table.append(
            [
                grid_name(grid.m, grid.n),
                Number(own["sup_lower_mm"].median(), 2, source="sup_lower_mm"),
                Number(own["sup_upper_mm"].median(), 2, source="sup_upper_mm"),
                *([Number(own["sup_upper_mm"].max(), 2, source="sup_worst_mm")] if several else []),
                Number(tested, 2),
                Number(own["mean_lower_mm"].median(), 2, source="mean_lower_mm"),
                Number(own["mean_upper_mm"].median(), 2, source="mean_upper_mm"),
                Number(_estimate(data, grid), 2),
                Number(100 * float(_at_corner(data, own).mean()), 0),
                Number(own["boxes"].median(), 0, source="boxes"),
                Number(int(own["verified"].astype(bool).sum()), 0),
            ]
        )
    caption = (
        ("Medians over the seeds. " if several else "")
        + "≥ and ≤: lower and upper bound. At a corner: networks whose worst point is a corner of "
        "the workspace. Checked: networks whose proof the second program went through. "
        "Boxes: of the search for the worst case. "
        + f"Data: `{(data.results / 'certificates.csv').as_posix()}`."
    )
    return Table(columns, table, caption, "table-certified")


def _where(data: ReportData, rows: dict[int, pd.DataFrame]) -> str:
    every = pd.concat(rows.values())
    corner = _at_corner(data, every)
    places = every.loc[corner, _ARGMAX].round(6).value_counts()
    text = f"The worst point is a corner of the workspace for {percent(float(corner.mean()))} of "
    text += count(len(every), "network")
    if len(places):
        # Of several corners equally often the worst, the first in order is named.
        at = min(places[places == places.max()].index)
        where = ", ".join(f"{value:g}" for value in at)
        text += minus(f", most often ({where}) mm")
        inset = _inset_mm(data)
        if inset > 0:
            text += f"; the test path stays {inset:g} mm inside and never comes near"
    return f"{text}."


def _cost(rows: dict[int, pd.DataFrame]) -> str:
    every = pd.concat(rows.values())
    return (
        f"The searches took {every['seconds'].sum():.1f} s and "
        f"{thousands(int(every['boxes'].sum()))} boxes in all, "
        f"{1000 * every['seconds'].median():.1f} ms for a network (median)."
    )


def _inset_mm(data: ReportData) -> float:
    """How far the first path keeps from the sides of the workspace [mm]."""
    first = data.grids[0]
    path = first.track(data.first_path, first.median_seed(data.first_path)).target_mm
    box = data.study.workspace
    return float(min((path - box.lower_mm).min(), (np.asarray(box.upper_mm) - path).min()))


def _other_methods(data: ReportData) -> str:
    """Other methods that are certified, too."""
    assert data.proofs is not None
    parts = []
    for method, kind in ((k, v.kind) for k, v in data.study.methods.items()):
        own = data.proofs[data.proofs["method"] == method]
        if own.empty:
            continue
        medians = own.groupby("n_samples")["sup_upper_mm"].median()
        checked = "" if own["verified"].astype(bool).all() else ", not checked independently"
        what = "the look-up table" if kind == "multilinear" else f"“{method}”"
        ends = f"{medians.iloc[0]:.2f}"
        if len(medians) > 1:
            ends += f" to {medians.iloc[-1]:.2f}"
        parts.append(f"{what} {ends} mm{checked}")
    if not parts:
        return ""
    return f"Other methods’ certified worst case, fewest to most samples: {joined(parts)}."


def _estimate(data: ReportData, grid: Grid) -> float:
    return float(grid.bounds[f"estimate_{data.study.bounds.average_weight}_mm"].mean())


_ARGMAX = ["argmax_x_mm", "argmax_y_mm", "argmax_z_mm"]


def _at_corner(data: ReportData, rows: pd.DataFrame) -> "pd.Series[bool]":
    place = rows[_ARGMAX].to_numpy(float)
    box = data.study.workspace
    gap = np.minimum(np.abs(place - box.lower_mm), np.abs(place - box.upper_mm))
    return pd.Series((gap <= _CORNER_MM).all(axis=1), index=rows.index)
