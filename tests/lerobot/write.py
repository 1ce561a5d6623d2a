"""Writes a small data set of an SO-101 with the LeRobot library itself, as one records.

    python tests/lerobot/write.py tests/lerobot/v2.1    # lerobot 0.3.3
    python tests/lerobot/write.py tests/lerobot/v3.0    # lerobot 0.4.1

Only for whoever wants them made anew; the library is no dependency of the tests.
"""

import sys
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset


JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
MOTORS = {
    "dtype": "float32",
    "shape": (6,),
    "names": [f"{one}.pos" for one in (*JOINTS, "gripper")],
}
CAMERA = {"dtype": "video", "shape": (48, 64, 3), "names": ["height", "width", "channels"]}
EPISODES, FRAMES, TASK = 3, 30, "Pick up the cube"


def main(folder):
    data = LeRobotDataset.create(
        "iksamples/so101",
        fps=30,
        features={
            "action": MOTORS,
            "observation.state": MOTORS,
            "observation.images.front": CAMERA,
        },
        root=folder,
        robot_type="so101_follower",
    )
    old = folder.name == "v2.1"
    for episode in range(EPISODES):
        for frame in range(FRAMES):
            # Degrees, and per cent of the gripper's opening.
            phase = 0.2 * frame + 0.77 * episode + np.arange(6)
            state = (40 * np.sin(phase) + 50 * (np.arange(6) == 5)).astype(np.float32)
            one = {
                "action": state,
                "observation.state": state,
                "observation.images.front": np.full((48, 64, 3), 128, np.uint8),
            }
            data.add_frame(one, task=TASK) if old else data.add_frame(one | {"task": TASK})
        data.save_episode()
    if not old:
        data.finalize()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
