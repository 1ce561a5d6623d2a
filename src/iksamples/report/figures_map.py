"""Drawings of where a network's error is too large, and of its worst case along the training."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from iksamples.arm.chain import Floats
from iksamples.network import StackedMLP
from iksamples.report import style
from iksamples.report.data import Grid, ReportData


_POINTS = 49  # along each side of a slice


@dataclass(frozen=True, eq=False)
class Slice:
    """The error on a plane of one height through the workspace.

    Attributes:
        height_mm: Its z [mm].
        x_mm: Places along x [mm], shape (points,).
        y_mm: Places along y [mm], shape (points,).
        error_mm: The error [mm], shape (points along y, points along x).
    """

    height_mm: float
    x_mm: Floats
    y_mm: Floats
    error_mm: Floats

    @property
    def worst(self) -> tuple[float, float, float]:
        """Where the largest error of the points drawn is, x and y [mm], and how large [mm]."""
        row, column = np.unravel_index(self.error_mm.argmax(), self.error_mm.shape)
        return (
            float(self.x_mm[column]),
            float(self.y_mm[row]),
            float(self.error_mm[row, column]),
        )


def slices(data: ReportData, network: StackedMLP) -> list[Slice]:
    """The error of one network at the bottom, the middle and the top of the workspace.

    Args:
        data: The report's data.
        network: A stack of one network.
    """
    lower, upper = np.array(data.study.workspace.lower_mm), np.array(data.study.workspace.upper_mm)
    x, y, _ = (np.linspace(a, b, _POINTS) for a, b in zip(lower, upper, strict=True))
    found = []
    for height in (lower[2], (lower[2] + upper[2]) / 2, upper[2]):
        points = np.stack([*np.meshgrid(x, y), np.full((_POINTS, _POINTS), height)], axis=-1)
        reached = data.chain.forward_mm(network.predict(points.reshape(-1, 3))[0])
        error = np.linalg.norm(reached - points.reshape(-1, 3), axis=-1)
        found.append(Slice(float(height), x, y, error.reshape(_POINTS, _POINTS)))
    return found


@style.styled
def error_map(data: ReportData, parts: Sequence[Slice], tolerance_mm: float) -> Figure:
    """The error on the slices, with the tolerance as a line and each slice's worst point.

    Args:
        data: The report's data, for the workspace.
        parts: The slices.
        tolerance_mm: The study's tolerance [mm].
    """
    figure, axes = style.panels(
        1, 3, 3.25, sharey=True, wspace=0.12, left=0.06, right=0.9, bottom=0.13, top=0.9
    )
    largest = max(float(part.error_mm.max()) for part in parts)
    levels = MaxNLocator(10).tick_values(0.0, largest)
    for axis, part in zip(axes[0], parts, strict=True):
        filled = axis.contourf(part.x_mm, part.y_mm, part.error_mm, levels=levels, cmap="Blues")
        if part.error_mm.min() < tolerance_mm < part.error_mm.max():
            axis.contour(
                part.x_mm,
                part.y_mm,
                part.error_mm,
                levels=[tolerance_mm],
                colors=style.TARGET,
                linewidths=1.2,
            )
        x, y, error = part.worst
        axis.plot(x, y, "o", ms=6, color=style.TARGET, mec="white", clip_on=False, zorder=5)
        right, up = x > np.mean(part.x_mm), y > np.mean(part.y_mm)
        axis.annotate(
            f"{error:.1f} mm",
            (x, y),
            (-7 if right else 7, -11 if up else 6),
            textcoords="offset points",
            ha="right" if right else "left",
            color=style.INK,
            fontweight="bold",
            bbox={"facecolor": style.PANEL, "edgecolor": "none", "pad": 1.5, "alpha": 0.85},
        )
        axis.set_title(f"z = {part.height_mm:g} mm")
        axis.set_xlabel("x [mm]")
        axis.xaxis.set_major_locator(MaxNLocator(4))
        axis.set_aspect("equal")
        axis.grid(visible=False)
    axes[0][0].set_ylabel("y [mm]")
    bar = figure.colorbar(filled, cax=figure.add_axes((0.92, 0.16, 0.013, 0.7)))
    bar.set_label("position error [mm]")
    return figure


@style.styled
def bound_against_epochs(parts: Sequence[tuple[Grid, pd.DataFrame]]) -> Figure:
    """Certified worst case beside the errors at the training points, epoch by epoch.

    Args:
        parts: Grids, each with the rows of ``training_bound`` of the network shown.
    """
    figure, axes = style.panels(1, len(parts), 3.3, sharey=True, wspace=0.06, bottom=0.15, top=0.83)
    # The worst point is often a training point: the lower line is wide enough to be seen then.
    lines = (
        ("sup_upper_mm", "certified worst case over the workspace", style.NETWORK, "-", 3.2),
        ("training_max_mm", "largest error at a training point", style.SAMPLE, "-", 1.0),
        ("training_mean_mm", "mean error at the training points", style.SAMPLE, ":", 1.2),
    )
    low, high = np.inf, 0.0
    for axis, (grid, rows) in zip(axes[0], parts, strict=True):
        trained = rows[rows["epoch"] > 0]
        for column, label, colour, dashes, width in lines:
            height = trained[column]
            axis.plot(trained["epoch"], height, color=colour, ls=dashes, lw=width, label=label)
            low, high = min(low, height.min()), max(high, height.max())
        last = int(trained["epoch"].max())
        ticks = [tick for tick in style.decades(1, last, (1,)) if tick < last / 1.5]
        style.number_ticks(axis, "x", [*ticks, last])
        axis.set_title(f"{grid.n} samples")
        axis.set_xlabel("epoch")
    left = axes[0][0]
    wide = np.log10(high / low) > 2.5
    style.number_ticks(left, "y", style.decades(low / 1.2, high * 1.2, (1,) if wide else (1, 2, 5)))
    left.set_ylim(low / 1.2, high * 1.2)
    left.set_ylabel("position error [mm]")
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper right", ncols=3, borderaxespad=0.2)
    return figure
