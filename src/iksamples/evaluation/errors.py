"""Position errors of networks and other methods on paths and over the whole workspace."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from iksamples.arm.chain import Floats, SerialChain
from iksamples.evaluation.paths import waypoints_mm
from iksamples.methods.predictor import Predictor
from iksamples.samples.dataset import AXES
from iksamples.samples.record import region_points
from iksamples.study import Study


if TYPE_CHECKING:
    import pandas as pd

CUBE = "cube"
"""Name of the region that is the whole workspace."""


@dataclass(frozen=True)
class Tracking:
    """What a method does when sent to some positions.

    Attributes:
        joints: Joint values that each seed answers [rad], shape (seeds, points, joints).
        reached_mm: Where the tool goes [mm], shape (seeds, points, 3).
        error_mm: Distance to where it was sent (paper, Eq. 3, unsquared) [mm],
            shape (seeds, points).
    """

    joints: Floats
    reached_mm: Floats
    error_mm: Floats


def send(predictor: Predictor, chain: SerialChain, targets_mm: Floats) -> Tracking:
    """Sends a method to positions and follows it through the forward kinematics.

    Args:
        predictor: Stacked networks, or any other fitted method.
        chain: The arm.
        targets_mm: Positions [mm], shape (points, 3).
    """
    joints = predictor.predict(targets_mm)
    reached = chain.forward_mm(joints)
    return Tracking(joints, reached, np.linalg.norm(reached - targets_mm, axis=-1))


def track_paths(study: Study, chain: SerialChain, predictor: Predictor) -> "pd.DataFrame":
    """Every waypoint of every path for every seed.

    Returns:
        Columns path, waypoint, seed, target_*_mm, reached_*_mm, q_*_rad, error_mm.
    """
    import pandas as pd

    frames = []
    for name, path in study.evaluation.paths.items():
        targets = waypoints_mm(path)
        result = send(predictor, chain, targets)
        n_seeds, n_points = result.error_mm.shape
        columns: dict[str, object] = {
            "path": name,
            "waypoint": np.tile(np.arange(n_points), n_seeds),
            "seed": np.repeat(predictor.seeds, n_points),
        }
        for i, axis in enumerate(AXES):
            columns[f"target_{axis}_mm"] = np.tile(targets[:, i], n_seeds)
        for i, axis in enumerate(AXES):
            columns[f"reached_{axis}_mm"] = result.reached_mm[..., i].ravel()
        for i, joint in enumerate(chain.joint_names):
            columns[f"q_{joint}_rad"] = result.joints[..., i].ravel()
        columns["error_mm"] = result.error_mm.ravel()
        frames.append(pd.DataFrame(columns))
    return pd.concat(frames, ignore_index=True)


def cube_errors(study: Study, chain: SerialChain, predictor: Predictor) -> "pd.DataFrame":
    """The error at every point of the workspace's dense set for every seed.

    Returns:
        Columns point, seed, error_mm; point counts along ``region_points``.
    """
    import pandas as pd

    points = region_points(study, chain, study.evaluation.cube_points)
    error = send(predictor, chain, points).error_mm
    return pd.DataFrame(
        {
            "point": np.tile(np.arange(len(points), dtype=np.int32), len(predictor.seeds)),
            "seed": np.repeat(np.asarray(predictor.seeds, np.int32), len(points)),
            "error_mm": error.astype(np.float32).ravel(),
        }
    )


def summarise(waypoints: "pd.DataFrame", cube: "pd.DataFrame") -> "pd.DataFrame":
    """Mean, 95th and 99th percentile and maximum of the error, a row for each region and seed.

    Args:
        waypoints: What ``track_paths`` returned.
        cube: What ``cube_errors`` returned.

    Returns:
        Columns region, seed, error_mean_mm, error_p95_mm, error_p99_mm, error_max_mm.
    """
    import pandas as pd

    everything = pd.concat(
        [
            waypoints[["path", "seed", "error_mm"]].rename(columns={"path": "region"}),
            cube[["seed", "error_mm"]].assign(region=CUBE),
        ]
    )
    grouped = everything.groupby(["region", "seed"], sort=False)["error_mm"]
    return pd.DataFrame(
        {
            "error_mean_mm": grouped.mean(),
            "error_p95_mm": grouped.quantile(0.95),
            "error_p99_mm": grouped.quantile(0.99),
            "error_max_mm": grouped.max(),
        }
    ).reset_index()
