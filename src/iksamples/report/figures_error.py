"""Drawings of the error against the number of samples."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from iksamples.arm.chain import Floats
from iksamples.evaluation.errors import CUBE
from iksamples.report import style
from iksamples.report.data import Grid, ReportData
from iksamples.report.statistics import median_interval
from iksamples.report.wording import path_name


AVERAGE_NAMES = {
    "mean": "mean of w",
    "mean_abs": "mean of |w|",
    "rms": "rms of w",
    "max_abs": "largest |w|",
}
"""Meanings of the paper's average weight, in words."""


def region_name(data: ReportData, region: str) -> str:
    """What a panel calls a region."""
    name = "whole workspace" if region == CUBE else path_name(data, region)
    return name.removeprefix("the ").capitalize()


@style.styled
def error_against_samples(data: ReportData) -> tuple[Figure, dict[str, list[str]]]:
    """Mean error of every seed, their median and its interval, on the path and the workspace.

    Returns:
        The drawing, and for each panel's group of seeds a line to show for every mark.
    """
    figure, axes = style.panels(1, 2, 3.5, sharey=True, wspace=0.06, bottom=0.15, top=0.9)
    tips: dict[str, list[str]] = {}
    for axis, region in zip(axes[0], data.regions, strict=True):
        group = f"seeds-{region}"
        tips[group] = _seeds(axis, data.grids, region, group)
        _medians(axis, data.grids, region)
        axis.set_title(region_name(data, region))
        _sample_ticks(axis, data.grids)
    left = axes[0][0]
    _paper_points(left, data, "error")
    everything = np.concatenate(
        [grid.seed_errors(region) for grid in data.grids for region in data.regions]
        + [data.on_paper["paper_error_mm"]]
    )
    _error_ticks(left, everything)
    left.set_ylabel("mean position error [mm]")
    _legend(left, "upper right")
    return figure, tips


@style.styled
def error_over_spacing(data: ReportData) -> Figure:
    """The paper's e/d, and what it would be had the error stopped falling."""
    figure, axes = style.panels(1, 1, 3.0, bottom=0.17, top=0.96)
    axis = axes[0][0]
    spacing = np.array([grid.samples.spacing_mm for grid in data.grids])
    n = np.array([grid.n for grid in data.grids])
    medians = [median_interval(grid.seed_errors(data.first_path)) for grid in data.grids]
    ratio = np.array([interval.value for interval in medians]) / spacing
    for grid, d in zip(data.grids, spacing, strict=True):
        values = grid.seed_errors(data.first_path).to_numpy() / d
        axis.scatter(
            _spread(grid.n, len(values)), values, s=9, color=style.NETWORK, alpha=0.22, lw=0
        )
    whiskers = [
        [(i.value - i.low) / d, (i.high - i.value) / d]
        for i, d in zip(medians, spacing, strict=True)
    ]
    axis.errorbar(
        n,
        ratio,
        np.nan_to_num(np.transpose(whiskers)),
        color=style.NETWORK,
        marker="o",
        ms=4.5,
        capsize=2.5,
        label="here: median of the seeds",
        zorder=3,
    )
    paper = data.on_paper
    if len(paper):
        axis.plot(
            paper["n_samples"],
            paper["paper_error_over_spacing"],
            color=style.PAPER,
            marker="D",
            ms=4.5,
            mfc=style.PANEL,
            ls="--",
            lw=1,
            label="paper, Table 1",
        )
    start = saturation_start(data.grids)
    if start is not None:
        level = ratio[start] * spacing[start]
        axis.plot(
            n[start:],
            level / spacing[start:],
            color=style.MUTED,
            ls=":",
            lw=1.2,
            label=f"if the error had stopped falling at {n[start]} samples",
        )
    _sample_ticks(axis, data.grids)
    axis.set_ylabel("error / spacing, e/d")
    axis.set_ylim(bottom=0)
    _legend(axis, "best")
    return figure


@style.styled
def estimate_against_measured(data: ReportData) -> Figure:
    """The paper's estimate with every meaning of the average weight, and where it is exceeded."""
    figure, axes = style.panels(1, 2, 3.5, wspace=0.42, bottom=0.15, top=0.9, right=0.9)
    left, right = axes[0]
    grids = data.grids
    n = np.array([grid.n for grid in grids])
    chosen = data.study.bounds.average_weight
    measured = [float(grid.seed_errors(data.first_path).mean()) for grid in grids]
    left.plot(n, measured, color=style.NETWORK, marker="o", ms=4.5, zorder=4)
    ends = [(measured[-1], "measured", style.NETWORK)]
    shares = []
    limits = list(measured)
    for name, words in AVERAGE_NAMES.items():
        estimate = np.array([grid.bounds[f"estimate_{name}_mm"].mean() for grid in grids])
        share = np.array([grid.bounds[f"above_{name}"].mean() for grid in grids]) * 100
        strong = name == chosen
        look: Any = {
            "color": style.ESTIMATE,
            "lw": 1.6 if strong else 0.9,
            "alpha": 1.0 if strong else 0.65,
            "marker": "s",
            "ms": 4 if strong else 2.2,
            "zorder": 3,
        }
        left.plot(n, estimate, **look)
        right.plot(n, share, **look)
        limits += estimate.tolist()
        ends.append((float(estimate[-1]), words, style.ESTIMATE))
        shares.append((float(share[-1]), words, style.ESTIMATE))
    paper = data.on_paper
    if len(paper):
        left.plot(
            paper["n_samples"],
            paper["paper_estimate_mm"],
            color=style.PAPER,
            ls="--",
            lw=1,
            marker="D",
            ms=4.5,
            mfc=style.PANEL,
            zorder=2,
        )
        limits += paper["paper_estimate_mm"].tolist()
        # Labelled on the line, since it may end before ours does.
        at = paper.iloc[len(paper) // 2]
        first = at["n_samples"] == n[0]
        left.annotate(
            "paper's estimate",
            (at["n_samples"], at["paper_estimate_mm"]),
            (8, -3) if first else (-8, -12),
            textcoords="offset points",
            ha="left" if first else "right",
            color=style.PAPER,
            fontsize=8,
        )
    _error_ticks(left, np.array(limits))
    left.set_ylabel("error, estimate [mm]")
    left.set_title("Eq. 25 beside the measured mean error")
    right.set_ylim(-4, 104)
    right.set_ylabel("share of the workspace [%]")
    right.set_title("Where the error exceeds the estimate")
    for axis, labels in ((left, ends), (right, shares)):
        _sample_ticks(axis, grids)
        _label_ends(axis, float(n[-1]), labels)
    return figure


def saturation_start(grids: Sequence[Grid]) -> int | None:
    """Row of the grid at which the paper sees saturation: 64 samples, if two larger follow."""
    at = next((i for i, grid in enumerate(grids) if grid.m == 4), None)
    return at if at is not None and len(grids) - at > 2 else None


def _seeds(axis: Axes, grids: Sequence[Grid], region: str, group: str) -> list[str]:
    """Every seed as a faint mark; returns what to say about each."""
    x, y, tips = [], [], []
    for grid in grids:
        errors = grid.seed_errors(region)
        worst = grid.seed_errors(region, "error_max_mm")
        x += list(_spread(grid.n, len(errors)))
        y += errors.tolist()
        tips += [
            f"{grid.n} samples, seed {seed}: mean {mean:.2f} mm, worst {largest:.2f} mm"
            for seed, mean, largest in zip(
                errors.index, errors, worst.loc[errors.index], strict=True
            )
        ]
    marks = axis.scatter(x, y, s=11, color=style.NETWORK, alpha=0.28, lw=0, label="here: one seed")
    marks.set_gid(group)
    return tips


def _medians(axis: Axes, grids: Sequence[Grid], region: str) -> None:
    intervals = [median_interval(grid.seed_errors(region)) for grid in grids]
    value = [interval.value for interval in intervals]
    whiskers = np.transpose([[i.value - i.low, i.high - i.value] for i in intervals])
    known = any(interval.known for interval in intervals)
    axis.errorbar(
        [grid.n for grid in grids],
        value,
        np.nan_to_num(whiskers),
        color=style.NETWORK,
        marker="o",
        ms=4.5,
        capsize=2.5,
        zorder=3,
        label="here: median, 95 % interval" if known else "here: median",
    )


def _paper_points(axis: Axes, data: ReportData, what: str) -> None:
    paper = data.on_paper
    if len(paper):
        axis.errorbar(
            paper["n_samples"],
            paper[f"paper_{what}_mm"],
            paper[f"paper_{what}_sd_mm"],
            color=style.PAPER,
            marker="D",
            ms=4.5,
            mfc=style.PANEL,
            ls="--",
            lw=1,
            capsize=2.5,
            label="paper, Table 1 (±)",
        )


def _spread(n: int, count: int) -> Floats:
    """Places of a group's marks, side by side around n on a logarithmic axis."""
    return n * np.exp(np.linspace(-0.07, 0.07, count) if count > 1 else np.zeros(1))


def _sample_ticks(axis: Axes, grids: Sequence[Grid]) -> None:
    """The grids' own sizes as ticks; the crowded ones go unlabelled."""
    sizes = [grid.n for grid in grids]
    style.number_ticks(axis, "x", sizes)
    axis.set_xlim(sizes[0] / 1.35, sizes[-1] * 1.35)
    span = np.log(sizes[-1] / sizes[0]) or 1.0
    labels, last = [], -np.inf
    for size in sizes:
        show = np.log(size) - last > 0.06 * span
        labels.append(str(size) if show else "")
        last = np.log(size) if show else last
    axis.set_xticklabels(labels)
    axis.set_xlabel("number of samples n")


def _error_ticks(axis: Axes, values: Floats) -> None:
    low, high = float(np.min(values)) / 1.25, float(np.max(values)) * 1.25
    wide = np.log10(high / low) > 2.5
    ticks = style.decades(low, high, (1,) if wide else (1, 2, 5))
    style.number_ticks(axis, "y", ticks)
    axis.set_ylim(low, high)


def _legend(axis: Axes, where: Any) -> None:
    legend = axis.legend(loc=where)
    for mark in legend.legend_handles:
        if mark is not None:
            mark.set_alpha(1.0 if not hasattr(mark, "get_sizes") else 0.5)


def _label_ends(axis: Axes, x: float, ends: list[tuple[float, str, str]]) -> None:
    """Writes each line's name at its right end, moved apart where they would overlap."""
    to_pixels = axis.transData.transform
    gap = 10.5 * axis.figure.dpi / 72
    placed = -np.inf
    for value, words, colour in sorted(ends):
        wanted = to_pixels((x, value))[1]
        placed = max(wanted, placed + gap)
        axis.annotate(
            words,
            (x, value),
            (8, (placed - wanted) * 72 / axis.figure.dpi),
            textcoords="offset points",
            color=colour,
            fontsize=8,
            va="center",
            annotation_clip=False,
        )
