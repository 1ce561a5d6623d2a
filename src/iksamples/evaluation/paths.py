"""Paths the tool is asked to draw."""

import numpy as np

from iksamples.arm.chain import Floats
from iksamples.study import DoubleRectangle, Heart, Study
from iksamples.task import Task


def waypoints_mm(path: DoubleRectangle | Heart) -> Floats:
    """Waypoints of a path.

    Args:
        path: The path's entry in the study file.

    Returns:
        Positions [mm], shape (path.waypoints, 3); the last waypoint closes the path (each of the
        two rectangles by itself).
    """
    if isinstance(path, Heart):
        return _heart(path)
    (left, front), (right, back) = path.lower_mm, path.upper_mm
    corners = np.array([[left, front], [right, front], [right, back], [left, back], [left, front]])
    counts = (path.waypoints // 2, path.waypoints - path.waypoints // 2)
    rectangles = [
        np.column_stack([_along(corners, n), np.full(n, height)])
        for n, height in zip(counts, path.heights_mm, strict=True)
    ]
    return np.concatenate(rectangles)


def require_reachable(study: Study, task: Task) -> None:
    """Stops where a waypoint of the study cannot be used.

    Raises:
        IksamplesError: Names the path, the waypoint and why.
    """
    for name, path in study.evaluation.paths.items():
        task.reach(waypoints_mm(path)).require_usable(
            f"evaluation.paths.{name}", "Move the path or make it smaller."
        )


def _along(corners: Floats, n: int) -> Floats:
    """n points at equal distances along a polyline, both ends included."""
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    at = np.concatenate([[0.0], np.cumsum(lengths)])
    where = np.linspace(0.0, at[-1], n)
    return np.column_stack([np.interp(where, at, column) for column in corners.T])


def _heart(path: Heart) -> Floats:
    """The sine-and-cosine heart curve, scaled to a width and leaned about the x axis."""
    t = np.linspace(0.0, 2 * np.pi, path.waypoints)
    across = 16 * np.sin(t) ** 3
    along = 13 * np.cos(t) - 5 * np.cos(2 * t) - 2 * np.cos(3 * t) - np.cos(4 * t)
    unit = path.width_mm / 32
    # The curve reaches from -17 to about 12; centred, so that `centre_mm` is its middle.
    along = along - (along.max() + along.min()) / 2
    tilt = np.array([[1, 0], [0, np.cos(path.tilt_rad)], [0, np.sin(path.tilt_rad)]])
    return np.asarray(path.centre_mm) + unit * np.column_stack([across, along]) @ tilt.T
