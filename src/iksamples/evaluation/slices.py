"""Errors on slices through the workspace, for the report's map of where a network is bad."""

from typing import TYPE_CHECKING

import numpy as np

from iksamples.evaluation.errors import send
from iksamples.network import StackedMLP
from iksamples.task import Task


if TYPE_CHECKING:
    import pandas as pd

POINTS = 49
"""Points along each side of a slice."""


def error_slices(task: Task, network: StackedMLP, seed: int) -> "pd.DataFrame":
    """The error of one network on planes of its first two inputs.

    The planes lie at the bottom, in the middle and at the top of the third input, and in the middle
    of any further one; of two inputs there is one plane.

    Args:
        task: What is learned.
        network: Stacked networks.
        seed: The one that is sent there.

    Returns:
        One row per point: seed, slice (in words), the inputs (x_mm, y_mm, ...), error_mm, and
        angle_deg where the tool's orientation is asked for. Outside the region the errors are NaN.
    """
    import pandas as pd

    lower, upper = task.x.lower, task.x.upper
    one = network.select([network.seeds.index(seed)])
    plane = np.meshgrid(*(np.linspace(lower[i], upper[i], POINTS) for i in (0, 1)))
    frames = []
    for share in (0.0, 0.5, 1.0) if len(task.x) > 2 else (0.5,):
        points = np.tile((lower + upper) / 2, (POINTS**2, 1))
        points[:, :2] = np.stack(plane, axis=-1).reshape(-1, 2)
        words = ""
        if len(task.x) > 2:
            points[:, 2] = lower[2] + share * (upper[2] - lower[2])
            words = f"{task.x.names[2]} = {points[0, 2]:g} {task.x.units[2]}"
        frame = pd.DataFrame(points, columns=task.x.columns())
        frame.insert(0, "slice", words)
        frame.insert(0, "seed", seed)
        outside = ~task.region.contains(points)
        for measure, values in send(one, task, points).errors().items():
            frame[measure] = np.where(outside, np.nan, values[0])
        frames.append(frame)
    return pd.concat(frames, ignore_index=True)
