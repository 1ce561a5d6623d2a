"""What the view in three dimensions shows, as plain numbers for the page's script."""

import numpy as np

from iksamples.arm.chain import Floats
from iksamples.report.data import Grid, ReportData, Track
from iksamples.report.wording import path_name


_MOST_POINTS = 1000
_MOST_WAYPOINTS = 300
_BUDGET = 120_000
"""Numbers of all polylines together, which keeps the page well under its limit."""


def scene(data: ReportData) -> dict[str, object]:
    """Workspace, paths, and for every grid the training points, networks and arm poses.

    Of each grid and path the best, the median and the worst network (by mean error on the path)
    are kept, thinned alike. Lengths in millimetres, positions flattened to x, y, z, x, y, z...
    """
    box = data.study.workspace
    largest = max(
        len(data.grids[0].track(path, data.grids[0].median_seed(path)).error_mm)
        for path in data.paths
    )
    lines = len(data.grids) * len(data.paths) * 3 * (1 + data.chain.n_joints)
    most = int(np.clip(_BUDGET // (3 * lines), 24, min(_MOST_WAYPOINTS, largest)))
    return {
        "box": [list(box.lower_mm), list(box.upper_mm)],
        "paths": [_path(data, path, most) for path in data.paths],
        "grids": [_grid(data, grid, most) for grid in data.grids],
    }


def _path(data: ReportData, path: str, most: int) -> dict[str, object]:
    track = data.grids[0].track(path, data.grids[0].median_seed(path))
    keep = _keep(track, most)
    return {
        "name": path,
        "title": path_name(data, path).removeprefix("the ").capitalize(),
        "target": _flat(track.target_mm[keep]),
        "breaks": np.searchsorted(keep, track.breaks).tolist(),
    }


def _grid(data: ReportData, grid: Grid, most: int) -> dict[str, object]:
    points = grid.samples.positions_mm
    stride = -(-len(points) // _MOST_POINTS)
    return {
        "n": grid.n,
        "samples": _flat(points[::stride]),
        "runs": [_runs(data, grid, path, most) for path in data.paths],
    }


def _runs(data: ReportData, grid: Grid, path: str, most: int) -> list[dict[str, object]]:
    ranked = grid.ranked_seeds(path)
    chosen = {"best": ranked[0], "median": grid.median_seed(path), "worst": ranked[-1]}
    runs = []
    for rank, seed in chosen.items():
        track = grid.track(path, seed)
        keep = _keep(track, most)
        knots = data.chain.skeleton_mm(track.joints[keep])[:, :-1]
        runs.append(
            {
                "rank": rank,
                "seed": seed,
                "mean": round(float(np.mean(track.error_mm)), 3),
                "max": round(float(np.max(track.error_mm)), 3),
                "reached": _flat(track.reached_mm[keep]),
                "error": _flat(track.error_mm[keep]),
                # A joint that never moves is sent once.
                "knots": [
                    _flat(knots[:, i] if np.ptp(knots[:, i], axis=0).max() > 1e-6 else knots[:1, i])
                    for i in range(knots.shape[1])
                ],
            }
        )
    return runs


def _keep(track: Track, most: int) -> "np.typing.NDArray[np.int64]":
    """Waypoints to show: evenly thinned, with the ends of every stroke."""
    n = len(track.error_mm)
    if n <= most:
        return np.arange(n)
    ends = [edge for cut in track.breaks for edge in (cut - 1, cut)]
    return np.union1d(np.linspace(0, n - 1, most).round().astype(int), np.array(ends, int))


def _flat(lengths_mm: Floats) -> list[float]:
    return [round(float(value), 2) for value in lengths_mm.ravel()]
