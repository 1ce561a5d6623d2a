"""Errors on slices through the workspace, for the report's map of where a network is bad."""

from typing import TYPE_CHECKING

import numpy as np

from iksamples.arm.chain import SerialChain
from iksamples.evaluation.errors import send
from iksamples.network import StackedMLP
from iksamples.samples.dataset import AXES
from iksamples.study import Study


if TYPE_CHECKING:
    import pandas as pd

POINTS = 49
"""Points along each side of a slice."""


def error_slices(
    study: Study, chain: SerialChain, network: StackedMLP, seed: int
) -> "pd.DataFrame":
    """The error of one network on planes of its first two inputs.

    The planes lie at the bottom, in the middle and at the top of the third input, and in the middle
    of any further one; of two inputs there is one plane.

    Args:
        study: The study, for its workspace.
        chain: Its arm.
        network: Stacked networks.
        seed: The one that is sent there.

    Returns:
        One row per point: seed, slice (in words), the position (x_mm, y_mm, ...), error_mm.
    """
    import pandas as pd

    lower, upper = np.array(study.workspace.lower_mm), np.array(study.workspace.upper_mm)
    one = network.select([network.seeds.index(seed)])
    plane = np.meshgrid(*(np.linspace(lower[i], upper[i], POINTS) for i in (0, 1)))
    frames = []
    for share in (0.0, 0.5, 1.0) if len(lower) > 2 else (0.5,):
        points = np.tile((lower + upper) / 2, (POINTS**2, 1))
        points[:, :2] = np.stack(plane, axis=-1).reshape(-1, 2)
        words = ""
        if len(lower) > 2:
            points[:, 2] = lower[2] + share * (upper[2] - lower[2])
            words = f"{AXES[2]} = {points[0, 2]:g} mm"
        frame = pd.DataFrame(points, columns=[f"{axis}_mm" for axis in AXES[: len(lower)]])
        frame.insert(0, "slice", words)
        frame.insert(0, "seed", seed)
        frames.append(frame.assign(error_mm=send(one, chain, points).error_mm[0]))
    return pd.concat(frames, ignore_index=True)
