"""Pictures of the arm, of paths as drawn and of where errors are, and the view that turns."""

from collections.abc import Callable, Sequence
from itertools import combinations, product
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from iksamples.arm.chain import Floats, SerialChain
from iksamples.report import figures
from iksamples.report.data import ReportData
from iksamples.report.markdown import mm, number


_AZIMUTH_RAD, _ELEVATION_RAD = np.deg2rad(-62.0), np.deg2rad(22.0)
_MOST_POINTS = 1000
_DASHES = (0, (4, 1.6))


class Strokes:
    """One network on one path.

    Attributes:
        seed: Its seed.
        names: The coordinates of the position that are asked for, such as ``x_mm``.
        target: Where the tool was sent [mm], shape (waypoints, coordinates).
        reached: Where it went [mm], same shape.
        middle: The middle of where it went [mm], shape (3,).
        joints: What the network answered [rad or mm], shape (waypoints, joints).
        error: Distance between the two [mm], shape (waypoints,).
        breaks: Waypoints before which the pen is lifted.
    """

    def __init__(self, waypoints: pd.DataFrame) -> None:
        """Reads the rows of one network on one path, in any order."""
        rows = waypoints.sort_values("waypoint")
        self.seed = int(rows["seed"].iloc[0])
        targets = [str(name) for name in rows.filter(regex="^target_.*_mm$")]
        self.names = [name.removeprefix("target_") for name in targets]
        self.target: Floats = rows[targets].to_numpy(float)
        self.reached: Floats = rows[[f"reached_{name}" for name in self.names]].to_numpy(float)
        self.middle: Floats = rows.filter(regex="^reached_").mean().to_numpy(float)
        self._asked = [
            list(rows.filter(regex="^reached_")).index(f"reached_{n}") for n in self.names
        ]
        self.joints: Floats = rows.filter(regex="^q_").to_numpy(float)
        self.error: Floats = rows["error_mm"].to_numpy(float)
        pen_up = rows["pen_up"].to_numpy(bool)
        self.breaks = [int(i) for i in np.flatnonzero(pen_up) if i]

    def in_space(self, points: Floats) -> Floats:
        """Positions as x, y, z: a coordinate that is not asked for is where the tool went."""
        full = np.tile(self.middle, (len(points), 1))
        full[:, self._asked] = points
        return full

    def lifted(self, points: Floats) -> Floats:
        """A polyline with gaps (NaN) where the pen is lifted."""
        return np.insert(points, self.breaks, np.nan, axis=0)


@figures.styled
def plans(panels: Sequence[tuple[int, Strokes, Floats]]) -> Figure:
    """A path as networks draw it, seen along each axis of the workspace in turn.

    Args:
        panels: For each row: the number of samples, the path, and where the samples are [mm].
    """
    names = panels[0][1].names
    pairs = list(combinations(range(len(names)), 2))[:: 2 if len(names) == 3 else 1]
    # A pair of rows for each network, or two networks side by side where there is one pair.
    rows = -(-len(panels) * len(pairs) // 2)
    height = 0.75 + 3.55 * rows
    figure, axes = figures.panels(
        rows,
        2,
        height,
        width_in=7.6,
        left=0.085,
        wspace=0.24,
        hspace=0.22,
        bottom=0.42 / height,
        top=1 - 0.55 / height,
    )
    flat = [axis for row in axes for axis in row]
    for axis in flat[len(panels) * len(pairs) :]:
        axis.set_visible(False)
    everything = np.concatenate(
        [points for _, path, samples in panels for points in (path.target, path.reached, samples)]
    )
    low, high = everything.min(axis=0), everything.max(axis=0)
    half = 0.54 * np.max(high - low)
    for k, (n, path, samples) in enumerate(panels):
        row = flat[k * len(pairs) : (k + 1) * len(pairs)]
        for axis, (i, j) in zip(row, pairs, strict=True):
            seen = np.unique(samples[:, [i, j]].round(6), axis=0)
            axis.scatter(
                seen[:, 0], seen[:, 1], s=12, color=figures.SAMPLE, lw=0, label="samples", zorder=2
            )
            _path(axis, path, path.target[:, [i, j]], path.reached[:, [i, j]])
            axis.set_xlabel(_axis_title(names[i]))
            axis.set_ylabel(_axis_title(names[j]))
            axis.set_xlim((low + high)[i] / 2 - half, (low + high)[i] / 2 + half)
            axis.set_ylim((low + high)[j] / 2 - half, (low + high)[j] / 2 + half)
            axis.set_aspect("equal")
        row[0].set_title(f"{n} samples; mean error {mm(path.error.mean())}")
    handles, labels = axes[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper right", ncols=3, borderaxespad=0.1)
    return figure


@figures.styled
def arm(
    chain_of: Callable[[int], SerialChain],
    box: tuple[Floats, Floats],
    panels: Sequence[tuple[int, Strokes, Floats]],
) -> Figure:
    """The arm where a network strays farthest from a path, a panel each.

    Args:
        chain_of: The arm of each seed.
        box: Corners of the workspace [mm], a number per coordinate that is asked for.
        panels: For each: the number of samples, the path, and where the samples are [mm].
    """
    figure, axes = figures.panels(
        1, len(panels), 3.9, left=0.01, right=0.99, bottom=0.09, top=0.93, wspace=0.02
    )
    corners = np.array(list(product(*np.transpose(box))))
    edges = [
        panels[0][1].in_space(np.array(edge))
        for edge in combinations(corners, 2)
        if np.sum(edge[0] != edge[1]) == 1
    ]
    seen = []
    for axis, (n, path, samples) in zip(axes[0], panels, strict=True):
        worst = int(np.argmax(path.error))
        links = np.vstack([np.zeros((1, 3)), chain_of(path.seed).skeleton_mm(path.joints[worst])])
        for edge in edges:
            axis.plot(*_project(edge).T, color=figures.RULE, lw=0.9, zorder=1)
        axis.plot(*_project(links).T, color=figures.MUTED, lw=5, solid_joinstyle="round", zorder=5)
        knots = _project(links[:-1])
        axis.plot(*knots.T, "o", color=figures.PANEL, ms=5, mec=figures.INK, mew=1, zorder=6)
        target, reached = path.in_space(path.target), path.in_space(path.reached)
        _path(axis, path, _project(target), _project(reached))
        miss = _project(np.stack([target[worst], reached[worst]]))
        axis.plot(*miss.T, color=figures.INK, lw=1.2, label="largest error", zorder=9)
        if len(samples) <= _MOST_POINTS:
            points = _project(path.in_space(samples))
            axis.plot(*points.T, ".", ms=3, color=figures.SAMPLE, label="samples", zorder=4)
        axis.set_title(
            f"{n} samples: mean error {mm(path.error.mean())}, here {mm(path.error.max())}",
            loc="center",
        )
        seen += [_project(points) for points in (links, reached, *edges)]
    everything = np.concatenate(seen)
    low, high = everything.min(axis=0) - 6, everything.max(axis=0) + 6
    for axis in axes[0]:
        axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        axis.set_axis_off()
    figure.legend(*axes[0][0].get_legend_handles_labels(), loc="lower center", ncols=4)
    return figure


@figures.styled
def error_map(slices: pd.DataFrame, error: str, tolerance: float | None) -> Figure:
    """An error on slices through the workspace, with the tolerance as a line.

    Args:
        slices: Rows of one network: slice, the error, and coordinates, two of which vary along a
            slice.
        error: Column of the error, such as ``error_mm``.
        tolerance: The study's tolerance, in the error's unit, if it has one.
    """
    names = [str(name) for name in slices.filter(regex="_(mm|rad)$") if name != "error_mm"]
    planes = [rows for _, rows in slices.groupby("slice", sort=False)]
    pairs = [[name for name in names if rows[name].nunique() > 1] for rows in planes]
    alike, several = pairs == pairs[:1] * len(pairs), len(planes) > 1
    figure, axes = figures.panels(
        1, len(planes), 3.25, 9.2 if several else 4.6, sharey=alike, wspace=0.12 if alike else 0.4,
        left=0.08 if several else 0.16, right=0.93 if several else 0.86, top=0.9,
    )  # fmt: skip
    levels = MaxNLocator(10).tick_values(0.0, float(slices[error].max()))
    for axis, rows, (across, up) in zip(axes[0], planes, pairs, strict=True):
        grid = rows.pivot(index=up, columns=across, values=error)
        where = grid.columns.to_numpy(float), grid.index.to_numpy(float), grid.to_numpy(float)
        filled = axis.contourf(*where, levels=levels, cmap="Blues")
        if tolerance is not None and np.nanmin(where[2]) < tolerance < np.nanmax(where[2]):
            axis.contour(*where, levels=[tolerance], colors=figures.TARGET, linewidths=1.2)
        _worst(axis, rows, error, across, up)
        axis.set_title(rows["slice"].iloc[0])
        axis.set_xlabel(_axis_title(across))
        axis.xaxis.set_major_locator(MaxNLocator(4, prune="upper" if alike and several else None))
        if alike and across[-3:] == up[-3:]:
            axis.set_aspect("equal")
        else:
            axis.set_box_aspect(1)
        axis.grid(visible=False)
        if axis is axes[0][0] or not alike:
            axis.set_ylabel(_axis_title(up), labelpad=2)
    bar = figure.colorbar(filled, ax=axes[0], fraction=0.02 * len(planes), pad=0.02)
    bar.set_label("position error [mm]" if error == "error_mm" else "angle [deg]")
    return figure


def _worst(axis: Axes, rows: pd.DataFrame, error: str, across: str, up: str) -> None:
    """A slice's largest error, as a mark with its number."""
    at = rows.nlargest(1, error).iloc[0]
    right, high = (at[name] > rows[name].mean() for name in (across, up))
    axis.plot(at[across], at[up], "o", ms=6, color=figures.TARGET, mec="white", clip_on=False)
    axis.annotate(
        mm(at[error], 1) if error == "error_mm" else f"{number(at[error], 1)}°",
        (at[across], at[up]),
        (-7 if right else 7, -11 if high else 6),
        textcoords="offset points",
        ha="right" if right else "left",
        fontweight="bold",
        bbox={"facecolor": figures.PANEL, "edgecolor": "none", "pad": 1.5, "alpha": 0.85},
    )


def _path(axis: Axes, path: Strokes, target: Floats, reached: Floats) -> None:
    look: dict[str, Any] = {"color": figures.NETWORK, "lw": 1.5, "ls": _DASHES, "zorder": 8}
    axis.plot(*path.lifted(target).T, color=figures.TARGET, lw=1.6, label="target", zorder=7)
    axis.plot(*path.lifted(reached).T, label="reached", **look)


def _project(points_mm: Floats) -> Floats:
    """Orthographic view from a little above, shape (n, 2 or 3) to (n, 2)."""
    c, s = np.cos(_AZIMUTH_RAD), np.sin(_AZIMUTH_RAD)
    across, depth = -s * points_mm[:, 0] + c * points_mm[:, 1], points_mm[:, :2] @ [c, s]
    up = np.cos(_ELEVATION_RAD) * points_mm[:, 2] - np.sin(_ELEVATION_RAD) * depth
    return np.column_stack([across, up])


def _axis_title(column: str) -> str:
    """``x_mm`` as an axis has it: ``x [mm]``."""
    name, unit = column.rsplit("_", 1)
    return f"{name} [{unit}]"


_MOST_WAYPOINTS = 300
_BUDGET = 120_000
"""Numbers of all polylines together, which keeps the page small."""


def scene(
    data: ReportData, chain_of: Callable[[int], SerialChain], waypoints: pd.DataFrame
) -> dict[str, object]:
    """Workspace, paths, and for every set of samples its points, networks and arm poses.

    Of each set and path the best, the median and the worst network (by mean error on the path) are
    kept, thinned alike. Lengths in millimetres, positions flattened to x, y, z, x, y, z...

    Args:
        data: The report's data.
        chain_of: The arm of each seed.
        waypoints: Every waypoint of every network that did not diverge.
    """
    box = data.study.workspace
    paths = list(data.study.evaluation.paths)
    lines = len(data.cells) * len(paths) * 3 * (1 + chain_of(0).n_joints)
    most = int(np.clip(_BUDGET // (3 * lines), 24, _MOST_WAYPOINTS))
    first = waypoints[waypoints["label"] == next(iter(data.cells))]
    drawn = [Strokes(_one(first, path, first["seed"].iloc[0])) for path in paths]
    return {
        "box": drawn[0].in_space(np.array([box.lower_mm, box.upper_mm])).tolist(),
        "paths": [
            {
                "name": name,
                "target": _flat(path.in_space(path.target[_keep(path, most)])),
                "breaks": np.searchsorted(_keep(path, most), path.breaks).tolist(),
            }
            for name, path in zip(paths, drawn, strict=True)
        ],
        "grids": [_set(data, chain_of, waypoints, label, drawn[0], most) for label in data.cells],
    }


def _set(
    data: ReportData,
    chain_of: Callable[[int], SerialChain],
    waypoints: pd.DataFrame,
    label: str,
    first: Strokes,
    most: int,
) -> dict[str, object]:
    points = first.in_space(data.samples_mm(label))
    rows = waypoints[waypoints["label"] == label]
    return {
        "n": len(points),
        "samples": _flat(points[:: -(-len(points) // _MOST_POINTS)]),
        "runs": [_runs(chain_of, rows, path, most) for path in data.study.evaluation.paths],
    }


def _runs(
    chain_of: Callable[[int], SerialChain], rows: pd.DataFrame, path: str, most: int
) -> list[dict[str, object]]:
    mean = rows[rows["path"] == path].groupby("seed")["error_mm"].mean()
    ranked = mean.sort_values(kind="stable").index
    chosen = {"best": ranked[0], "median": ranked[(len(ranked) - 1) // 2], "worst": ranked[-1]}
    runs = []
    for rank, seed in chosen.items():
        track = Strokes(_one(rows, path, seed))
        keep = _keep(track, most)
        knots = chain_of(track.seed).skeleton_mm(track.joints[keep])[:, :-1]
        runs.append(
            {
                "rank": rank,
                "seed": int(seed),
                "mean": round(float(track.error.mean()), 3),
                "max": round(float(track.error.max()), 3),
                "reached": _flat(track.in_space(track.reached[keep])),
                "error": _flat(track.error[keep]),
                # A joint that never moves is sent once.
                "knots": [
                    _flat(knots[:, i] if np.ptp(knots[:, i], axis=0).max() > 1e-6 else knots[:1, i])
                    for i in range(knots.shape[1])
                ],
            }
        )
    return runs


def _one(rows: pd.DataFrame, path: str, seed: int) -> pd.DataFrame:
    return rows[(rows["path"] == path) & (rows["seed"] == seed)]


def _keep(track: Strokes, most: int) -> NDArray[np.int64]:
    """Waypoints to show: evenly thinned, with the ends of every stroke."""
    n = len(track.error)
    if n <= most:
        return np.arange(n)
    ends = [edge for cut in track.breaks for edge in (cut - 1, cut)]
    return np.union1d(np.linspace(0, n - 1, most).round().astype(int), np.array(ends, int))


def _flat(lengths_mm: Floats) -> list[float]:
    return [round(float(value), 2) for value in lengths_mm.ravel()]
