"""The paper's Figures 2 to 5, drawn from this study."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from iksamples.arm.chain import Floats
from iksamples.report import style
from iksamples.report.data import Grid, ReportData, Track
from iksamples.study import DoubleRectangle, Heart


_PAPER_GRIDS = (2, 3, 5, 7)
_AZIMUTH_RAD, _ELEVATION_RAD = np.deg2rad(-62.0), np.deg2rad(22.0)
_EPOCH_POINTS = 90
_MOST_POINTS = 1000


def path_of_shape(data: ReportData, shape: type[DoubleRectangle] | type[Heart]) -> str:
    """Name of the first path of a shape, or of the first path at all."""
    paths = data.study.evaluation.paths
    return next((name for name, path in paths.items() if isinstance(path, shape)), data.first_path)


def shown_grids(grids: Sequence[Grid], wanted: Sequence[int] = _PAPER_GRIDS) -> list[Grid]:
    """Up to four grids: the paper's where the study has them, else spread over what it has."""
    chosen = {grid.m for grid in grids} & set(wanted)
    spread = np.linspace(0, len(grids) - 1, min(len(wanted), len(grids))).round().astype(int)
    for i in [*spread, *range(len(grids))]:
        if len(chosen) < min(len(wanted), len(grids)):
            chosen.add(grids[i].m)
    return [grid for grid in grids if grid.m in chosen]


@style.styled
def training_progress(data: ReportData) -> Figure:
    """Loss over the epochs, a panel for each grid: median over the seeds and their range."""
    n = len(data.grids)
    columns = min(4, n)
    rows = -(-n // columns)
    height = 0.95 + 1.75 * rows
    figure, axes = style.panels(
        rows,
        columns,
        height,
        sharex=True,
        sharey=True,
        wspace=0.08,
        hspace=0.28,
        bottom=0.48 / height,
        top=1 - 0.52 / height,
    )
    flat = [axis for row in axes for axis in row]
    low, high = np.inf, 0.0
    for axis, grid in zip(flat, data.grids, strict=False):
        for column, colour, words in (
            ("train_loss_rad2", style.NETWORK, "training"),
            ("validation_loss_rad2", style.VALIDATION, "validation"),
        ):
            epochs, losses = _losses(grid.history, column)
            if not losses.size:
                continue
            axis.fill_between(
                epochs, np.nanmin(losses, 1), np.nanmax(losses, 1), color=colour, alpha=0.18, lw=0
            )
            axis.plot(epochs, np.nanmedian(losses, 1), color=colour, lw=1.3, label=words)
            low = min(low, np.nanmin(losses, where=losses > 0, initial=np.inf))
            high = max(high, np.nanmax(losses))
        axis.set_title(f"{grid.n} samples")
    steps = (1,) if high > 40 * low else (1, 2, 5)
    style.number_ticks(flat[0], "y", style.decades(low / 1.3, high * 1.3, steps))
    flat[0].set_ylim(low / 1.3, high * 1.3)
    flat[0].set_xlim(0, None)
    for axis in flat[n:]:
        axis.set_visible(False)
    for i, axis in enumerate(flat[:n]):
        if i + columns >= n:
            axis.tick_params(labelbottom=True)
            axis.set_xlabel("epoch")
        if i % columns == 0:
            axis.set_ylabel("loss [rad²]")
    handles, labels = flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper right", ncols=2, borderaxespad=0.2)
    return figure


@style.styled
def arm_with_heart(data: ReportData) -> Figure:
    """The arm where a network strays farthest from the path: fewest and most samples."""
    path = path_of_shape(data, Heart)
    grids = [data.grids[0], data.grids[-1]] if len(data.grids) > 1 else list(data.grids)
    figure, axes = style.panels(
        1, len(grids), 3.9, left=0.01, right=0.99, bottom=0.09, top=0.93, wspace=0.02
    )
    tracks = [grid.track(path, grid.median_seed(path)) for grid in grids]
    drawn = [
        _scene(axis, data, grid, track)
        for axis, grid, track in zip(axes[0], grids, tracks, strict=True)
    ]
    corners = np.concatenate(drawn)
    low, high = corners.min(axis=0) - 6, corners.max(axis=0) + 6
    for axis, grid, track in zip(axes[0], grids, tracks, strict=True):
        axis.set_xlim(low[0], high[0])
        axis.set_ylim(low[1], high[1])
        axis.set_aspect("equal")
        axis.set_axis_off()
        mean, largest = np.mean(track.error_mm), np.max(track.error_mm)
        axis.set_title(
            f"{grid.n} samples: mean error {mean:.1f} mm, here {largest:.1f} mm", loc="center"
        )
    handles, labels = axes[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=4)
    return figure


@style.styled
def path_views(data: ReportData, grids: Sequence[Grid]) -> Figure:
    """The path from above (xy) and from the side (yz): target, reached, training points."""
    path = path_of_shape(data, DoubleRectangle)
    height = 0.75 + 3.55 * len(grids)
    figure, axes = style.panels(
        len(grids),
        2,
        height,
        width_in=7.6,
        left=0.085,
        right=0.99,
        wspace=0.24,
        hspace=0.2,
        bottom=0.42 / height,
        top=1 - 0.5 / height,
    )
    tracks = [grid.track(path, grid.median_seed(path)) for grid in grids]
    window = _window(data, tracks)
    for row, grid, track in zip(axes, grids, tracks, strict=True):
        for axis, (i, j) in zip(row, ((0, 1), (1, 2)), strict=True):
            points = np.unique(grid.samples.positions_mm[:, [i, j]].round(6), axis=0)
            axis.scatter(
                points[:, 0],
                points[:, 1],
                s=12,
                color=style.SAMPLE,
                lw=0,
                label="training points",
                zorder=2,
            )
            target = lifted(track.target_mm, track.breaks)
            reached = lifted(track.reached_mm, track.breaks)
            axis.plot(
                target[:, i], target[:, j], color=style.TARGET, lw=1.6, label="target", zorder=3
            )
            axis.plot(
                reached[:, i],
                reached[:, j],
                color=style.NETWORK,
                lw=1.5,
                ls=(0, (4, 1.6)),
                label="reached",
                zorder=4,
            )
            axis.set_xlabel(f"{'xyz'[i]} [mm]")
            axis.set_ylabel(f"{'xyz'[j]} [mm]")
            axis.set_xlim(*window[:, i])
            axis.set_ylim(*window[:, j])
            axis.set_aspect("equal")
        mean = float(np.mean(track.error_mm))
        row[0].set_title(f"{grid.n} samples, from above; mean error {mean:.2f} mm")
        row[1].set_title(f"{grid.n} samples, from the side")
    handles, labels = axes[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper right", ncols=3, columnspacing=1.4, borderaxespad=0.1)
    return figure


def lifted(points: Floats, breaks: Sequence[int]) -> Floats:
    """A polyline with gaps (NaN) where the pen is lifted."""
    return np.insert(points, list(breaks), np.nan, axis=0) if breaks else points


def _window(data: ReportData, tracks: Sequence[Track]) -> Floats:
    """A cube around the workspace and the paths [mm], shape (2, 3): one scale for all panels."""
    box = data.study.workspace
    points = np.concatenate([[box.lower_mm, box.upper_mm], *(track.reached_mm for track in tracks)])
    low, high = points.min(axis=0), points.max(axis=0)
    half = 0.54 * np.max(high - low)
    return np.stack([(low + high) / 2 - half, (low + high) / 2 + half])


def _losses(history: pd.DataFrame, column: str) -> tuple[Floats, Floats]:
    """Epochs and losses, shape (epochs, seeds), thinned to what a small panel can show."""
    wide = history.pivot(index="epoch", columns="seed", values=column).dropna(how="all")
    if wide.empty:
        return np.empty(0), np.empty((0, 0))
    epochs = wide.index.to_numpy(float)
    keep = np.unique(
        np.searchsorted(epochs, np.linspace(epochs[0], epochs[-1], _EPOCH_POINTS).round())
    )
    return epochs[keep], wide.to_numpy(float)[keep]


def _scene(axis: Axes, data: ReportData, grid: Grid, track: Track) -> Floats:
    """Arm, path, workspace and floor, seen from a little above; returns what must be in view."""
    worst = int(np.argmax(track.error_mm))
    arm = np.vstack([np.zeros((1, 3)), data.chain.skeleton_mm(track.joints[worst])])
    floor = min(0.0, float(data.study.workspace.lower_mm[2]))

    def draw(points: Floats, **look: Any) -> None:
        axis.plot(*_project(points).T, **look)

    for edge in _box_edges(data):
        draw(edge, color=style.RULE, lw=0.9, zorder=1)
    shadow = np.column_stack([arm[:, :2], np.full(len(arm), floor)])
    draw(shadow, color=style.RULE, lw=5, zorder=0, solid_joinstyle="round")
    draw(arm, color=style.MUTED, lw=5, zorder=5, solid_joinstyle="round")
    draw(arm[:-1], color=style.PANEL, marker="o", ms=5, lw=0, mec=style.INK, mew=1, zorder=6)
    draw(
        lifted(track.target_mm, track.breaks), color=style.TARGET, lw=1.8, label="target", zorder=7
    )
    draw(
        lifted(track.reached_mm, track.breaks),
        color=style.NETWORK,
        lw=1.6,
        ls=(0, (4, 1.6)),
        label="reached",
        zorder=8,
    )
    miss = np.stack([track.target_mm[worst], track.reached_mm[worst]])
    draw(miss, color=style.INK, lw=1.2, label="largest error", zorder=9)
    points = grid.samples.positions_mm
    if len(points) <= _MOST_POINTS:
        draw(points, color=style.SAMPLE, marker=".", ms=3, lw=0, label="training points", zorder=4)
    box = np.concatenate(_box_edges(data))
    return _project(np.concatenate([arm, shadow, box, track.reached_mm]))


def _project(points_mm: Floats) -> Floats:
    """Orthographic view of points [mm], shape (n, 3) to (n, 2)."""
    c, s = np.cos(_AZIMUTH_RAD), np.sin(_AZIMUTH_RAD)
    across, depth = -s * points_mm[:, 0] + c * points_mm[:, 1], points_mm[:, :2] @ [c, s]
    up = np.cos(_ELEVATION_RAD) * points_mm[:, 2] - np.sin(_ELEVATION_RAD) * depth
    return np.column_stack([across, up])


def _box_edges(data: ReportData) -> list[Floats]:
    """The twelve edges of the workspace."""
    box = np.array([data.study.workspace.lower_mm, data.study.workspace.upper_mm])
    corners = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    return [
        np.array([[box[a[k], k] for k in range(3)], [box[b[k], k] for k in range(3)]])
        for x, a in enumerate(corners)
        for b in corners[x + 1 :]
        if np.sum(np.abs(a - b)) == 1
    ]
