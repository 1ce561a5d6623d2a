"""What the view in three dimensions shows, as plain numbers for the page's script."""

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iksamples.arm.chain import Floats, SerialChain
from iksamples.report.data import ReportData
from iksamples.report.views import Strokes


_MOST_POINTS = 1000
_MOST_WAYPOINTS = 300
_BUDGET = 120_000
"""Numbers of all polylines together, which keeps the page small."""


def scene(data: ReportData, chain: SerialChain, waypoints: pd.DataFrame) -> dict[str, object]:
    """Workspace, paths, and for every set of samples its points, networks and arm poses.

    Of each set and path the best, the median and the worst network (by mean error on the path) are
    kept, thinned alike. Lengths in millimetres, positions flattened to x, y, z, x, y, z...

    Args:
        data: The report's data.
        chain: The arm.
        waypoints: Every waypoint of every network that did not diverge.
    """
    box = data.study.workspace
    paths = list(data.study.evaluation.paths)
    lines = len(data.cells) * len(paths) * 3 * (1 + chain.n_joints)
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
        "grids": [_set(data, chain, waypoints, label, drawn[0], most) for label in data.cells],
    }


def _set(
    data: ReportData,
    chain: SerialChain,
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
        "runs": [_runs(chain, rows, path, most) for path in data.study.evaluation.paths],
    }


def _runs(chain: SerialChain, rows: pd.DataFrame, path: str, most: int) -> list[dict[str, object]]:
    mean = rows[rows["path"] == path].groupby("seed")["error_mm"].mean()
    ranked = mean.sort_values(kind="stable").index
    chosen = {"best": ranked[0], "median": ranked[(len(ranked) - 1) // 2], "worst": ranked[-1]}
    runs = []
    for rank, seed in chosen.items():
        track = Strokes(_one(rows, path, seed))
        keep = _keep(track, most)
        knots = chain.skeleton_mm(track.joints[keep])[:, :-1]
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
