"""Paths the tool is asked to draw."""

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iksamples.arm.chain import Floats
from iksamples.errors import IksamplesError
from iksamples.samples.measured import Place, plain, read_columns, with_units
from iksamples.samples.table import Table, read_table
from iksamples.study import (
    AnyPath,
    Circle,
    CsvPath,
    DoubleRectangle,
    Heart,
    Helix,
    Lemniscate,
    Study,
)
from iksamples.task import Task


_MOST_WAYPOINTS = 100_000  # as of the other shapes
_INSET = 6
"""Rectangles lie a sixth of the workspace from its sides."""


class Waypoints(NamedTuple):
    """A path, point by point.

    Attributes:
        x: Inputs of the task [mm or rad], shape (waypoints, d).
        pen_up: Whether the pen is lifted on the way to each waypoint, shape (waypoints,).
    """

    x: Floats
    pen_up: NDArray[np.bool_]


def waypoints(path: AnyPath, task: Task) -> Waypoints:
    """Waypoints of a path.

    Args:
        path: The path's entry in the study file. What it leaves out follows from the largest box of
            the task's region.
        task: What is learned. Angles among its inputs stay in the middle of their range, but for a
            file that says otherwise.

    Raises:
        IksamplesError: The path does not fit the task's inputs, or its file cannot be read.
    """
    if isinstance(path, CsvPath):
        return _from_file(path.file, task)
    largest = int(np.argmax(task.region.shares))
    lower, upper = task.region.lower[largest], task.region.upper[largest]
    n = len(task.target.positions)
    pen_up = np.zeros(path.waypoints, bool)
    if isinstance(path, DoubleRectangle):
        points = _rectangles(path, lower[:n], upper[:n])
        pen_up[path.waypoints // 2] = True
    else:
        points = _flat(path, lower[:n], upper[:n])
    x = np.tile((lower + upper) / 2, (len(points), 1))
    x[:, :n] = points
    return Waypoints(x, pen_up)


def count_waypoints(path: AnyPath) -> int:
    """Waypoints of a path."""
    if isinstance(path, CsvPath):
        return len(with_units(_table(path.file))[1].rows)
    return path.waypoints


def require_reachable(study: Study, task: Task) -> None:
    """Stops where a waypoint of the study cannot be used.

    Raises:
        IksamplesError: Names the path, the waypoint and why.
    """
    for name, path in study.evaluation.paths.items():
        task.reach(waypoints(path, task).x).require_usable(
            f"evaluation.paths.{name}", "Move the path or make it smaller."
        )


def _rectangles(path: DoubleRectangle, lower: Floats, upper: Floats) -> Floats:
    """Two rectangles, each closed by its last waypoint, shape (waypoints, 2 or 3)."""
    inset = (upper - lower) / _INSET
    near, far = lower + inset, upper - inset
    low = np.array(near[:2] if path.lower_mm is None else path.lower_mm)
    high = np.array(far[:2] if path.upper_mm is None else path.upper_mm)
    counts = path.waypoints // 2, path.waypoints - path.waypoints // 2
    if len(lower) == 2:
        if path.heights_mm:
            raise IksamplesError(
                "evaluation.paths: heights_mm of a double_rectangle, but the task has no z among "
                "its inputs; leave them out."
            )
        second = (high - low) / _INSET
        return np.concatenate(
            [_around(low, high, counts[0]), _around(low + second, high - second, counts[1])]
        )
    heights = path.heights_mm or (near[2], far[2])
    return np.concatenate(
        [
            np.column_stack([_around(low, high, n), np.full(n, height)])
            for n, height in zip(counts, heights, strict=True)
        ]
    )


def _around(low: Floats, high: Floats, n: int) -> Floats:
    """n points at equal distances around a rectangle, from its lower corner and back to it."""
    (left, front), (right, back) = low, high
    corners = np.array([[left, front], [right, front], [right, back], [left, back], [left, front]])
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    at = np.concatenate([[0.0], np.cumsum(lengths)])
    where = np.linspace(0.0, at[-1], n)
    return np.column_stack([np.interp(where, at, column) for column in corners.T])


def _flat(path: Heart | Circle | Lemniscate | Helix, lower: Floats, upper: Floats) -> Floats:
    """A curve scaled to its width, leaned about the x axis and moved to its centre."""
    width = path.width_mm or 11 * float(np.min(upper - lower)) / 15
    centre = np.asarray((lower + upper) / 2 if path.centre_mm is None else path.centre_mm, float)
    if len(centre) != len(lower):
        raise IksamplesError(
            f"evaluation.paths: centre_mm of the {path.shape} has {len(centre)} numbers; the task "
            f"has {len(lower)} positions among its inputs."
        )
    t = np.linspace(0.0, 2 * np.pi, path.waypoints)
    along_z = np.zeros_like(t)
    if isinstance(path, Heart):
        curve = width / 32 * _heart(t)
    elif isinstance(path, Lemniscate):
        curve = width / 2 * np.column_stack([np.cos(t), np.sin(t) * np.cos(t)])
    elif isinstance(path, Circle):
        curve = width / 2 * np.column_stack([np.cos(t), np.sin(t)])
    else:
        if len(lower) == 2:
            raise IksamplesError("evaluation.paths: a helix needs z among the task's inputs.")
        height = path.height_mm or 2 * float(upper[2] - lower[2]) / 3
        along_z = np.linspace(-height / 2, height / 2, path.waypoints)
        curve = width / 2 * np.column_stack([np.cos(path.turns * t), np.sin(path.turns * t)])
    if len(lower) == 2:
        return centre + curve
    cos, sin = np.cos(path.tilt_rad), np.sin(path.tilt_rad)
    u, v = curve.T
    return centre + np.column_stack([u, cos * v - sin * along_z, sin * v + cos * along_z])


def _heart(t: Floats) -> Floats:
    """The sine-and-cosine heart curve, 32 wide, shape (points, 2)."""
    across = 16 * np.sin(t) ** 3
    along = 13 * np.cos(t) - 5 * np.cos(2 * t) - 2 * np.cos(3 * t) - np.cos(4 * t)
    # The curve reaches from -17 to about 12; centred, so that the middle of it is the origin.
    return np.column_stack([across, along - (along.max() + along.min()) / 2])


def _from_file(file: str, task: Task) -> Waypoints:
    """Waypoints from a table, in the units of the task.

    Raises:
        IksamplesError: An input has no column, a unit is not said, or a cell is no number.
    """
    units = zip(task.x.names, task.x.units, strict=True)
    places = [Place(name, unit, [name]) for name, unit in units]
    x, table, _ = read_columns(_table(file), places, fewest=2)
    lifted = [i for i, name in enumerate(table.names) if plain(name) == "pen_up"]
    return Waypoints(x, np.asarray(table.numbers(lifted).any(axis=1)))


@cache
def _table(file: str) -> Table:
    return read_table(file, _MOST_WAYPOINTS)
