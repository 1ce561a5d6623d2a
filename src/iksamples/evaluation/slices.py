"""Errors on slices through the workspace, for the report's map of where a network is bad."""

import numpy as np
import pandas as pd

from iksamples.evaluation.errors import send
from iksamples.network import StackedMLP
from iksamples.samples.record import region_points
from iksamples.task import Task


POINTS = 49
"""Points along each side of a slice."""


def error_slices(task: Task, network: StackedMLP, seed: int, n_points: int) -> pd.DataFrame:
    """The error of one network on planes of two inputs.

    Of three inputs the planes are of the first two, at the bottom, in the middle and at the top of
    the third. Of more they are of the first two, the next two and the last two, and go through the
    point where the largest position error is found.

    Args:
        task: What is learned.
        network: Stacked networks.
        seed: The one that is sent there.
        n_points: Points of the region among which the largest error is looked for.

    Returns:
        One row per point: seed, slice (in words), the inputs (x_mm, y_mm, ...), error_mm, and
        angle_deg where the tool's orientation is asked for. Outside the region the errors are NaN.
    """
    one = network.select([network.seeds.index(seed)])
    lower, upper, names = task.x.lower, task.x.upper, task.x.names
    d, middle = len(names), (lower + upper) / 2
    planes = {"": ((0, 1), middle)}
    if d == 3:
        heights = lower[2] + np.array([0.0, 0.5, 1.0]) * (upper[2] - lower[2])
        planes = {
            f"{names[2]} = {height:g} {task.x.units[2]}": ((0, 1), np.r_[middle[:2], height])
            for height in heights
        }
    elif d > 3:
        points = region_points(task.region, n_points)
        worst = points[np.nanargmax(send(one, task, points).error_mm[0])]
        pairs = sorted({(i, i + 1) for i in (0, min(2, d - 2), d - 2)})
        planes = {f"{names[i]} and {names[j]}": ((i, j), worst) for i, j in pairs}
    frames = []
    for words, (pair, through) in planes.items():
        plane = np.meshgrid(*(np.linspace(lower[i], upper[i], POINTS) for i in pair))
        points = np.tile(through, (POINTS**2, 1))
        points[:, pair] = np.stack(plane, axis=-1).reshape(-1, 2)
        frame = pd.DataFrame(points, columns=task.x.columns())
        frame.insert(0, "slice", words)
        frame.insert(0, "seed", seed)
        outside = ~task.region.contains(points)
        for measure, values in send(one, task, points).errors().items():
            frame[measure] = np.where(outside, np.nan, values[0])
        frames.append(frame)
    return pd.concat(frames, ignore_index=True)
