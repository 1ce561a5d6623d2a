"""Sections about the paper: its estimate put to the test, and where this study differs from it."""

from typing import Any

import numpy as np

from iksamples.paper.audit import scale_mm
from iksamples.report import figures_error
from iksamples.report.blocks import Column, Figure, Number, Section, Table, Text
from iksamples.report.data import ReportData
from iksamples.report.figures_error import AVERAGE_NAMES
from iksamples.report.verdict import paper_recipe, paper_task
from iksamples.report.wording import (
    ACTIVATION_NAMES,
    box_ranges,
    box_size,
    budget,
    grid_name,
    joined,
    minus,
    mm,
    one_seed,
    path_name,
    percent,
    seeds,
    seeds_mean,
    span,
)
from iksamples.study import DoubleRectangle, Robot, Study


_PAPER_BOX_MM = ((20.0, 20.0, -10.0), (100.0, 100.0, 60.0))
_PAPER_LINK_MM = 70.0
_PAPER_ELBOW_RAD = (np.pi / 3, 2 * np.pi / 3)
_PAPER_SIDE_MM = 60.0


def estimate_against_measured(data: ReportData) -> Section:
    """The paper's Eq. 25 beside the measured error."""
    chosen = data.study.bounds.average_weight
    first, last = data.measured.iloc[0], data.measured.iloc[-1]
    name = AVERAGE_NAMES[chosen]
    exceeded = (
        f"{percent(first.above_estimate, 1)} of the workspace with {int(first.n_samples)} samples"
    )
    if len(data.measured) > 1:
        exceeded += f" and on {percent(last.above_estimate, 1)} with {int(last.n_samples)}"
    texts = [
        "The paper estimates the error from the trained weights alone: e ≤ (27 w̄² + 1) / "
        "(4 (m − 1)²), with w̄ “the average weight” and m the points per axis (Eq. 25), rescaled "
        f"to millimetres. By which length is not said; here it is {scale_mm(data.study):g} mm.",
        _which_average(data),
        f"With the {name}, the error exceeds the estimate on {exceeded}.",
        _as_a_square(data),
    ]
    figure = Figure(
        "estimate-against-measured",
        "",
        "The paper’s estimate against the measured mean error, for each meaning of w̄ (left; "
        f"thick: the {name}, as in the table), and the share of the workspace on which the error "
        "exceeds it (right)" + ("." if one_seed(data) else "; means over the seeds."),
        figures_error.estimate_against_measured(data),
        f"{data.source('bounds')}, {data.source('errors')}",
        f"{figures_error.__name__}.estimate_against_measured",
    )
    blocks = [Text(text) for text in texts if text]
    return Section(
        "estimate", "The paper’s estimate, tested", [blocks[0], figure, *blocks[1:], _table(data)]
    )


def differences(data: ReportData) -> Section:
    """What differs from the paper and why: each row from the paper's text or from the data."""
    columns = [Column(title, text=True) for title in ("", "The paper", "Here, and why")]
    caption = "Section numbers are the paper’s (arXiv 2605.23583)."
    blocks = [Table(columns, _difference_rows(data), caption, "table-differences")]
    changed = changed_settings(data.study)
    if changed:
        blocks.append(
            Table(
                [Column(title, text=True) for title in ("setting", "paper study", "here")],
                changed,
                "Settings in which this study differs from the paper study of this project.",
                "changed-settings",
            )
        )
    return Section("differences", "What differs from the paper, and why", blocks)


def changed_settings(study: Study) -> list[list[str]]:
    """Keys of the study file whose value is not the paper study's."""
    about = {"name", "title", "tracking"}
    ours = study.model_dump(mode="json", exclude=about)
    theirs = Study(name="paper").model_dump(mode="json", exclude=about)
    return [
        [f"`{key}`", _setting(there), _setting(here)]
        for key, there, here in _differing(theirs, ours)
    ]


def _table(data: ReportData) -> Table:
    scale = scale_mm(data.study)
    group = "w̄ of the trained networks"
    columns = [
        Column("samples", text=True),
        Column("measured mean", "mm", ours=True),
        Column("estimate", "mm"),
        Column("exceeded on", "% of workspace"),
        *(Column(name, group=group) for name in AVERAGE_NAMES.values()),
        Column("w̄ that gives the paper’s column"),
        Column("Eq. 25 as a square", "mm"),
    ]
    by_m = {grid.m: grid for grid in data.grids}
    rows: list[list[str | Number]] = []
    for _, row in data.table.iterrows():
        grid = by_m.get(int(row["samples_per_axis"]))
        weights = [
            Number(grid.bounds[f"wbar_{name}"].mean() if grid else np.nan, 3)
            for name in AVERAGE_NAMES
        ]
        rows.append(
            [
                grid_name(int(row["samples_per_axis"]), int(row["n_samples"])),
                Number(row["error_mean_mm"], 2, source="error_mean_mm"),
                Number(row["estimate_mm"], 2, source="estimate_mm"),
                Number(100 * row["above_estimate"], 1),
                *weights,
                Number(row["wbar_for_paper"], 3, source="wbar_for_paper"),
                Number(float(np.sqrt(row["estimate_mm"] * scale)), 1),
            ]
        )
    caption = (
        f"The estimate uses the {AVERAGE_NAMES[data.study.bounds.average_weight]}; "
        f"{seeds_mean(data)}. Data: `{(data.results / 'table.csv').as_posix()}`, "
        f"`{data.source('bounds')}`."
    )
    return Table(columns, rows, caption, "table-3")


def _which_average(data: ReportData) -> str:
    """Which mean of the weights comes nearest to the one behind the paper's column."""
    needed = data.table["wbar_for_paper"].dropna()
    if needed.empty:
        return ""
    means = {
        name: float(np.mean([grid.bounds[f"wbar_{name}"].mean() for grid in data.grids]))
        for name in AVERAGE_NAMES
    }
    nearest = min(means, key=lambda name: abs(abs(means[name]) - float(needed.median())))
    listed = joined(
        [f"{minus(f'{means[name]:.2f}')} ({words})" for name, words in AVERAGE_NAMES.items()]
    )
    return (
        f"Which average is meant the paper does not say. Its column needs a w̄ of "
        f"{span(needed.to_list(), 3)}; the weights trained here average {listed} over the grids, "
        f"so the {AVERAGE_NAMES[nearest]} comes nearest. Only the largest |w| bounds every weight."
    )


def _as_a_square(data: ReportData) -> str:
    """Eq. 25 taken for what its derivation says: a bound on a squared length."""
    table = data.measured
    root = np.sqrt(table["estimate_mm"] * scale_mm(data.study))
    above = int(np.sum(root > table["error_mean_mm"]))
    return (
        "Eq. 25 is derived for a squared error, yet its value is compared with millimetres. Taken "
        "as a square, its root times the same length gives "
        f"{span(root.to_list(), 1, 'mm')}, above the measured mean at {above} of {len(table)} "
        f"grid{'' if len(table) == 1 else 's'} (last column). Even so it is no proven bound: its "
        "first lemma leaves out the training error and rests on an inequality between squares that "
        "does not hold (|3² − 1²| = 8 is not at most |3 − 1|² = 4)."
    )


def _difference_rows(data: ReportData) -> list[list[str]]:
    study = data.study
    rows = []
    if study.robot == Robot():
        rows.append(_forward_kinematics(data))
    rows += [
        ["Workspace", _paper_workspace(), _workspace_here(data)],
        _neurons(study),
        _held_out(data),
        _early_stopping(study),
        [
            "The ± of Table 1",
            "Not defined: runs, seeds or points.",
            "None: a single seed."
            if one_seed(data)
            else f"Standard deviation over {seeds(data)} of a network’s mean error.",
        ],
        [
            "Squared and plain error",
            "Eqs. 3, 6, 21 and 25 are about a squared error; Table 1 is in mm.",
            "Measured errors are plain distances in mm. Eq. 25 is multiplied by a length once, as "
            "the paper’s column must have been, and tested as such.",
        ],
        [
            "Average weight w̄",
            "“Dealt with empirically”; neither value nor kind of mean is given.",
            f"The {AVERAGE_NAMES[study.bounds.average_weight]} over the kernels of all layers; "
            "the other readings are beside it.",
        ],
        _test_path(data),
        [
            "Best number of samples",
            "125 in the abstract, 64 in Sections 5 and 6, both from e/d.",
            "None is derived from e/d: it has no cost in it, and where it is constant the error "
            "still falls.",
        ],
        [
            "Software",
            "TensorFlow 2.11 (Keras), number of runs not given.",
            "PyTorch and Lightning, all seeds of a grid as one stack of networks; "
            + ("the paper’s optimiser settings." if paper_recipe(data) else "settings below."),
        ],
    ]
    return rows


def _forward_kinematics(data: ReportData) -> list[str]:
    middle = np.array([np.pi / 2, -np.pi / 2, -np.pi / 2])
    height = data.chain.forward_mm(middle)[2]
    return [
        "Forward kinematics",
        "Three revolute joints, links of 70 mm (Section 3); equations and zero pose are left to a "
        "reference.",
        f"`{data.study.robot.urdf}`: at zero the arm stands upright, and negative shoulder and "
        "elbow angles lean it forward. The middle of the paper’s joint ranges, (90°, −90°, −90°), "
        "is then the pose of a drawing robot: forearm straight down, tool at "
        f"z = {mm(abs(round(height, 6)), 0)}.",
    ]


def _paper_workspace() -> str:
    low, high = _PAPER_BOX_MM
    return minus(
        f"Stated as x and y in {low[0]:g} to {high[0]:g} mm, z in {low[2]:g} to {high[2]:g} mm "
        "(Section 3). Its own spacings (20 mm for 64 samples, 15 mm for 125; Sections 5 and 6) are "
        f"those of a {_PAPER_SIDE_MM:g} mm side."
    )


def _workspace_here(data: ReportData) -> str:
    study = data.study
    corner = float(np.hypot(*_PAPER_BOX_MM[1][:2]))
    # Distance shoulder to tip with equal links, at either end of the elbow's range.
    far, near = (2 * _PAPER_LINK_MM * np.cos(bend / 2) for bend in _PAPER_ELBOW_RAD)
    text = f"A {box_size(study)}: {box_ranges(study)} mm."
    if not paper_task(data):
        return text
    return (
        f"{text} The stated box cannot be reached: its corners at x = y = 100 mm lie "
        f"{corner:.1f} mm from a base axis at the origin, and the two moving links reach "
        f"{2 * _PAPER_LINK_MM:g} mm. Nor do the stated joint ranges allow a {_PAPER_SIDE_MM:g} mm "
        f"cube anywhere: they keep the tool {near:.0f} to {far:.0f} mm from the shoulder, a shell "
        f"{far - near:.0f} mm thick. So the cube is as large as the paper’s spacings, placed where "
        "the arm reaches all of it, and the joint limits are those of hobby servos."
    )


def _neurons(study: Study) -> list[str]:
    layers = " and ".join(str(width) for width in study.network.hidden) or "no"
    return [
        "Hidden neurons",
        "10 in the first paragraph of Section 4, 16 in the third.",
        f"{layers}, {ACTIVATION_NAMES[study.network.activation]}; other widths are one line in the "
        "study file.",
    ]


def _held_out(data: ReportData) -> list[str]:
    held_out = data.study.training.held_out
    few, many = data.grids[0].members.iloc[0], data.grids[-1].members.iloc[0]
    counts = [f"{int(few.n_validation)} + {int(few.n_test)} with {data.grids[0].n} samples"]
    if len(data.grids) > 1:
        counts.append(f"{int(many.n_validation)} + {int(many.n_test)} with {data.grids[-1].n}")
    if held_out.source == "fresh":
        here = (
            "Every grid point trains, since taking one away breaks the grid that the spacing "
            "describes. Validation and test points are fresh points of the workspace: "
            f"{joined(counts)}."
        )
    else:
        here = (
            f"Points are taken from the grid, drawn anew for each seed; validation and test: "
            f"{joined(counts)}. Really trained on: {int(few.n_trained)} of {data.grids[0].n}"
            + (f", {int(many.n_trained)} of {data.grids[-1].n}." if len(data.grids) > 1 else ".")
        )
    return [
        "Validation and test",
        "5 % for both; of 8 samples that is 0.4 of a sample.",
        here,
    ]


def _early_stopping(study: Study) -> list[str]:
    stop = study.training.early_stopping
    here = (
        f"Patience {stop.patience}, threshold {stop.min_delta_rad2:g} rad², per seed."
        if stop
        else f"Off: every network trains for {budget(study.training)}."
    )
    return [
        "Early stopping",
        "“Selectively implemented” with patience 10; which runs, and the threshold, are not said.",
        here,
    ]


def _test_path(data: ReportData) -> list[str]:
    path = data.study.evaluation.paths[data.first_path]
    text = path_name(data, data.first_path).removeprefix("the ").capitalize()
    if isinstance(path, DoubleRectangle):
        sides = np.subtract(path.upper_mm, path.lower_mm)
        text += (
            f" of {sides[0]:g} × {sides[1]:g} mm at z = {mm(path.heights_mm[0], 0)} and "
            f"{mm(path.heights_mm[1], 0)}"
        )
    return [
        "Test path",
        "Double rectangles at a low and a high height; sizes only in the pictures.",
        f"{text}, {path.waypoints} waypoints; beside it, errors over the whole workspace.",
    ]


def _differing(there: Any, here: Any, key: str = "") -> list[tuple[str, Any, Any]]:
    """Settings that differ, as (dotted key, there, here); None where one side has no such key."""
    if not (isinstance(there, dict) and isinstance(here, dict)):
        return [] if there == here else [(key, there, here)]
    return [
        row
        for name in [*there, *(name for name in here if name not in there)]
        for row in _differing(there.get(name), here.get(name), f"{key}.{name}" if key else name)
    ]


def _setting(value: Any) -> str:
    """A setting as the study file writes it, in short."""
    if value is None:
        return "—"
    if isinstance(value, dict):
        return ", ".join(f"{key}: {_setting(item)}" for key, item in value.items())
    if isinstance(value, list):
        return f"[{', '.join(_setting(item) for item in value)}]"
    return minus(f"{value:g}") if isinstance(value, float) else str(value)
