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


def sockets(folder, places=4, postures=12, scatter_mm=0.05, seed=0):
    """A drawing, the arm itself, and a folder of postures with its tool in two sockets of places.

    Newton's method brings the arm's tool to each socket from random postures.
    """
    from iksamples.arm.load import load_arm

    drawing = load_arm("config/robots/panda.urdf")
    rng = np.random.default_rng(seed)
    arm = deviated(drawing, rng.normal(size=(8, 6)) * np.repeat([1, 0.01], 3))
    home = np.array([0, -0.5, 0, -2.2, 0, 1.8, 0.8])
    for place in range(places):
        base = rng.normal(size=3) * 0.25
        q = home + np.concatenate([base, np.zeros(4)])
        first = arm.forward_mm(q)
        way = rng.normal(size=3)
        for socket, point in enumerate((first, first + 50 * way / np.linalg.norm(way))):
            found = q + 0.35 * rng.normal(size=(postures, 7))
            goal = point + scatter_mm * rng.normal(size=(postures, 3))
            for _ in range(50):
                off = goal - arm.forward_mm(found)
                step = (np.linalg.pinv(arm.jacobian_mm(found)) @ off[..., None])[..., 0]
                found += np.clip(step, -0.3, 0.3)
            (folder / f"place{place}").mkdir(parents=True, exist_ok=True)
            np.savetxt(folder / f"place{place}" / f"hole_{socket}.csv", found, delimiter=",")
    return drawing, arm


def table_of(urdf, n, noise_mm=0.0, seed=0):
    """Records of an arm that is not its drawing, in m and deg, with the tool's quaternion.

    Returns them, and how far the drawing is off where each was recorded [mm].
    """
    from scipy.spatial.transform import Rotation

    from iksamples.arm.load import load_arm

    drawing, rng = load_arm(urdf), np.random.default_rng(seed)
    rows = drawing.n_joints + 1, 6
    arm = deviated(drawing, rng.normal(size=rows) * np.repeat([1, 0.01], 3))
    home = np.resize([0, -1.2, 1.5, -1.9, -1.57, 0], drawing.n_joints)
    q = home + rng.uniform(-0.3, 0.3, (n, drawing.n_joints))
    position, rotation = arm.pose(q)
    measured = position + noise_mm * rng.normal(size=(n, 3))
    table = pd.DataFrame(measured / 1000, columns=["x_m", "y_m", "z_m"])
    table[[f"{name}_deg" for name in drawing.joint_names]] = np.degrees(q)
    table[["qx", "qy", "qz", "qw"]] = Rotation.from_matrix(rotation).as_quat()
    return table, np.linalg.norm(drawing.forward_mm(q) - measured, axis=1)
