"""The floor under every error: what an arm leaves whose own joints are known exactly."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from iksamples.arm.chain import Floats
from iksamples.arm.inverse import followed
from iksamples.arm.real import RealArm
from iksamples.evaluation.errors import cube_errors, summarise, track_paths
from iksamples.study import Study
from iksamples.task import Task


if TYPE_CHECKING:
    import pandas as pd

FOLDER = "floor"
"""Where it lies among a study's results, as ``errors.parquet``."""


@dataclass(frozen=True)
class OwnInverse:
    """Each arm's own inverse kinematics, its sag included: no method can know more.

    Attributes:
        task: What is learned.
        seeds: The arms' seeds.
    """

    task: Task
    seeds: tuple[int, ...]

    def predict(self, x: ArrayLike, /) -> Floats:
        """Joint values [rad or mm], shape (arms, points, joints), for inputs (points, d)."""
        drawn = self.task.reach(x)
        answers = []
        for seed in self.seeds:
            actual, arm = followed(drawn, self.task.chain_of(seed)), self.task.arm_of(seed)
            answers.append(arm.unloaded(actual) if isinstance(arm, RealArm) else actual)
        return np.stack(answers)


def repeatability(study: Study, task: Task) -> "pd.DataFrame":
    """What is left of the error of each arm's own inverse, by the play and the steps of its joints.

    Args:
        study: The study, with an ``arm`` section.
        task: Its task.

    Returns:
        As ``evaluation.errors.summarise``: a row for each region and arm.
    """
    known = OwnInverse(task, study.arms)
    return summarise(
        track_paths(study.evaluation, task, known), cube_errors(study.evaluation, task, known)
    )
