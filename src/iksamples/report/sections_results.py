"""Sections about what was measured: the table, the errors, the training and the paths."""

import numpy as np

from iksamples.report import figures_error, figures_paper
from iksamples.report.blocks import Block, Column, Figure, Number, Section, Table, Text, Viewer
from iksamples.report.data import ReportData
from iksamples.report.scene import scene
from iksamples.report.statistics import Interval, slope_interval
from iksamples.report.verdict import paper_recipe, paper_task
from iksamples.report.wording import (
    box_size,
    grid_name,
    minus,
    mm,
    one_seed,
    path_name,
    power_of,
    seeds,
    shown_network,
    span,
    thousands,
)
from iksamples.study import DoubleRectangle, Heart


def drawn_by(function: object) -> str:
    """Module and name of a drawing function, for a caption."""
    return f"{getattr(function, '__module__', '')}.{getattr(function, '__name__', '')}"


def table_one(data: ReportData) -> Section:
    """Table 1 of the paper beside this study's, and what the table leaves out."""
    paper = bool(len(data.on_paper))
    columns = [Column("samples", text=True), Column("spacing d", "mm")]
    groups = (
        (
            "measured error [mm]",
            "error_mean_mm",
            "error_sd_mm",
            "paper_error_mm",
            "paper_error_sd_mm",
        ),
        ("estimate, Eq. 25 [mm]", "estimate_mm", "", "paper_estimate_mm", ""),
        ("e/d", "error_over_spacing", "", "paper_error_over_spacing", ""),
    )
    for group, *_ in groups:
        columns += [Column("paper", group=group)] if paper else []
        columns += [Column("here", group=group, ours=True)]
        columns += [Column("ratio", group=group)] if paper and group != "e/d" else []
    rows: list[list[str | Number]] = []
    for _, grid in data.table.iterrows():
        row: list[str | Number] = [
            grid_name(int(grid["samples_per_axis"]), int(grid["n_samples"])),
            Number(grid["spacing_mm"], 1, source="spacing_mm"),
        ]
        for group, ours, ours_sd, theirs, theirs_sd in groups:
            spread = grid[ours_sd] if ours_sd else np.nan
            there = Number(grid[theirs], 2, grid[theirs_sd] if theirs_sd else np.nan, theirs)
            here = Number(grid[ours], 2, spread, ours)
            ratio = Number(grid[ours] / grid[theirs], 2)
            row += ([there, here, ratio] if group != "e/d" else [there, here]) if paper else [here]
        rows.append(row)
    path = path_name(data, data.first_path)
    caption = f"Mean position error along {path}, {seeds(data)} per grid."
    notes = [] if one_seed(data) else ["± is the standard deviation over seeds here."]
    notes += (
        ["The paper does not say what its ± is. Ratio: here divided by paper."] if paper else []
    )
    if paper and not paper_task(data):
        caption += " The paper’s numbers are for its own arm, workspace and path."
    blocks: list[Block] = [
        Table(
            columns,
            rows,
            f"{' '.join([caption, *notes])} Data: {_file(data, 'table.csv')}.",
            "table-1",
        ),
    ]
    return Section("table", "Table 1, beside the paper" if paper else "Errors", blocks)


def error_against_samples(data: ReportData) -> Section:
    """How the error falls with the number of samples."""
    drawing, tips = figures_error.error_against_samples(data)
    interval = "bars: 95 % bootstrap interval of the median" if _enough_seeds(data) else ""
    caption = "Mean error against number of samples. Each dot is one trained network"
    blocks: list[Block] = [
        Figure(
            "error-against-samples",
            "",
            f"{caption}; line: median{'; ' + interval if interval else ''}.",
            drawing,
            data.source("errors"),
            drawn_by(figures_error.error_against_samples),
            "Point at a dot for its seed and error.",
            tips,
        )
    ]
    if len(data.grids) > 1:
        blocks += [Text(text) for text in _fall_texts(data)]
    if len(data.grids) > 1 and has_spacing(data):
        blocks.append(
            Figure(
                "error-over-spacing",
                "",
                "Error divided by the spacing of the grid, the paper’s measure of sample efficiency"
                + (
                    ". The dotted line is what e/d would be had the error stopped falling."
                    if figures_error.saturation_start(data.grids) is not None
                    else "."
                ),
                figures_error.error_over_spacing(data),
                f"{data.source('errors')}, {(data.results / 'table.csv').as_posix()}",
                drawn_by(figures_error.error_over_spacing),
            )
        )
    blocks += [Text(_workspace_text(data)), _beyond_the_mean(data)]
    return Section("error", "Error against the number of samples", blocks)


def training_progress(data: ReportData) -> Section:
    """The paper's Figure 3, and how long each grid was really trained."""
    first, last = data.grids[0], data.grids[-1]
    training = data.study.training
    texts = []
    steps = [float(grid.members["steps"].median()) for grid in (first, last)]
    if steps[1] > 1.05 * steps[0] and not training.steps:
        stopped = "" if training.early_stopping is None else "at most "
        texts.append(
            f"Equal epochs are not equal training: in {stopped}{training.epochs} epochs a network "
            f"takes {thousands(steps[0])} optimiser steps with {first.n} samples and "
            f"{thousands(steps[1])} with {last.n}. Part of what looks like an effect of the "
            "samples is an effect of the steps."
        )
    loss = first.members["validation_loss_rad2"].dropna()
    if first.m == 2 and paper_recipe(data) and len(loss):
        texts.append(
            "With 8 samples the paper reports a validation loss of about 1.5 after 500 epochs; the "
            f"median here is {loss.median():.2g} rad²."
        )
    figure = Figure(
        "figure-3",
        "Figure 3",
        "Training progress for each grid, after the paper’s Figure 3. Loss: squared error of the "
        "joint angles"
        + ("." if one_seed(data) else "; line: median over the seeds; band: all seeds."),
        figures_paper.training_progress(data),
        data.source("history"),
        drawn_by(figures_paper.training_progress),
    )
    return Section("training", "Training progress", [figure, *(Text(text) for text in texts)])


def arm_with_heart(data: ReportData) -> Section:
    """The paper's Figure 2."""
    path = figures_paper.path_of_shape(data, Heart)
    name = path_name(data, path)
    figure = Figure(
        "figure-2",
        "Figure 2",
        f"The arm drawing {name}, after the paper’s Figure 2. The arm is shown where the tool is "
        f"farthest from its target{shown_network(data)}. Box: the workspace, a "
        f"{box_size(data.study)}.",
        figures_paper.arm_with_heart(data),
        f"{data.source('waypoints')}, {data.study.robot.urdf}",
        drawn_by(figures_paper.arm_with_heart),
    )
    return Section("arm", f"The arm and {name}", [figure])


def path_views(data: ReportData) -> Section:
    """The paper's Figures 4 and 5, and a view that can be turned."""
    path = figures_paper.path_of_shape(data, DoubleRectangle)
    name = path_name(data, path)
    grids = figures_paper.shown_grids(data.grids)
    blocks: list[Block] = []
    for number, pair in ((4, grids[:2]), (5, grids[2:])):
        if pair:
            blocks.append(
                Figure(
                    f"figure-{number}",
                    f"Figure {number}",
                    f"{name[0].upper()}{name[1:]} with {' and '.join(str(g.n) for g in pair)} "
                    f"samples, after the paper’s Figure {number}: target red, reached blue and "
                    f"dashed, training points black{shown_network(data)}.",
                    figures_paper.path_views(data, pair),
                    data.source("waypoints"),
                    drawn_by(figures_paper.path_views),
                )
            )
    viewer = Viewer(
        "",
        "The paths in three dimensions, with the arm that draws them.",
        scene(data),
        f"{data.source('waypoints')}, {data.study.robot.urdf}",
        drawn_by(scene),
        "Drag to turn it, or use the arrow keys; the slider moves the arm along the path.",
    )
    return Section("paths", "The paths, as the networks draw them", [viewer, *blocks])


def has_spacing(data: ReportData) -> bool:
    """Whether the samples are even grids, which alone have a spacing."""
    return bool(np.isfinite([grid.samples.spacing_mm for grid in data.grids]).all())


def _fall_texts(data: ReportData) -> list[str]:
    grids = [grid for grid in data.grids if grid.m >= 4] or data.grids
    grids = grids if len(grids) > 1 else data.grids
    errors = [grid.seed_errors(data.first_path) for grid in grids]
    by_n = slope_interval([grid.n for grid in grids], errors)
    text = (
        f"From {grids[0].n} to {grids[-1].n} samples the error on "
        f"{path_name(data, data.first_path)} goes as {power_of('n', by_n.value)}{_range(by_n)}"
    )
    if not has_spacing(data):
        return [f"{text}."]
    by_d = slope_interval([grid.samples.spacing_mm for grid in grids], errors)
    texts = [f"{text}, or as {power_of('d', by_d.value)}{_range(by_d)} in the spacing d."]
    ratio = data.table[data.table["samples_per_axis"].isin([grid.m for grid in grids])]
    values = span(ratio["error_over_spacing"].to_list(), 2)
    texts.append(
        f"The paper divides the error by the spacing and takes a constant e/d for saturation. Over "
        f"the same grids e/d is {values} here. But a constant e/d means that the error falls in "
        "proportion to the spacing; had the error stopped falling, e/d would rise as 1/d. Nor does "
        "e/d hold any cost of a sample, so no best number of samples follows from it."
    )
    return texts


def _range(interval: Interval) -> str:
    if not interval.known:
        return ""
    return minus(f" (95 % interval {interval.low:.2f} to {interval.high:.2f})")


def _workspace_text(data: ReportData) -> str:
    table = data.measured
    ratio = span((table["cube_error_mean_mm"] / table["error_mean_mm"]).to_list(), 2)
    last = table.iloc[-1]
    tested = thousands(data.grids[-1].n_workspace)
    return (
        f"A mean along one path hides where a network fails. Over the whole workspace (the same "
        f"{tested} points for every grid) the mean error is {ratio} times that of the path, and at "
        f"its worst point a network trained on {int(last.n_samples)} samples misses by "
        f"{mm(last.cube_error_max_mm, 1)}."
    )


def _beyond_the_mean(data: ReportData) -> Table:
    path = path_name(data, data.first_path)
    groups = ((f"{path} [mm]", ""), ("whole workspace [mm]", "cube_"))
    columns = [Column("samples", text=True), Column("trained on")]
    for group, prefix in groups:
        columns += [Column("mean", group=group)] if prefix else []
        columns += [Column(title, group=group) for title in ("95th percentile", "maximum")]
    columns += [Column("networks"), Column("diverged")]
    rows: list[list[str | Number]] = []
    for _, grid in data.table.iterrows():
        row: list[str | Number] = [
            grid_name(int(grid["samples_per_axis"]), int(grid["n_samples"])),
            Number(grid["n_trained"], 0, source="n_trained"),
        ]
        for _, prefix in groups:
            if prefix:
                mean, sd = grid["cube_error_mean_mm"], grid["cube_error_sd_mm"]
                row.append(Number(mean, 2, sd, "cube_error_mean_mm"))
            for name in (f"{prefix}error_p95_mm", f"{prefix}error_max_mm"):
                row.append(Number(grid[name], 2, source=name))
        row += [Number(grid["n_seeds"], 0), Number(grid["n_diverged"], 0)]
        rows.append(row)
    caption = (
        "Beyond the mean along the path. 95th percentile: mean over seeds; maximum: worst point of "
        f"the worst seed. Data: {_file(data, 'table.csv')}."
    )
    return Table(columns, rows, caption, "table-2")


def _enough_seeds(data: ReportData) -> bool:
    return min(len(grid.members) for grid in data.grids) >= 5


def _file(data: ReportData, name: str) -> str:
    return f"`{(data.results / name).as_posix()}`"
