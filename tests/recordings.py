"""Records of an arm that is not its drawing, as a table that people would write."""

import numpy as np
import pandas as pd

from iksamples.arm.real import deviated
from iksamples.study import parse_study
from iksamples.task import study_task


NAMES = ["x_mm", "y_mm", "z_mm", "q_yaw_rad", "q_shoulder_rad", "q_elbow_rad"]


def recorded(n=60, noise_mm=0.05, seed=0):
    """A drawing, the arm itself, and n records of it in mm and rad."""
    task = study_task(parse_study({"name": "paper"}))
    rng = np.random.default_rng(seed)
    arm = deviated(task.drawing, rng.normal(size=(4, 6)) * np.repeat([1, 0.017], 3))
    q = task.reach(rng.uniform(task.x.lower, task.x.upper, (n, 3))).joints
    x = arm.forward_mm(q) + noise_mm * rng.normal(size=(n, 3))
    return task.drawing, arm, pd.DataFrame(np.hstack([x, q]), columns=NAMES)
