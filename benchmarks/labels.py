"""What labels cost: 10 000 poses of each arm, and the same in singular value decompositions.

``python benchmarks/labels.py`` prints a table; the last column does not depend on the machine much.
"""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from iksamples.study import read_study
from iksamples.task import study_task


N = 10_000
STUDIES = ("planar2r", "scara", "so101", "ur5e-down", "ur5e-pose", "panda-down", "iiwa")


def best_of(function: Callable[[], object], repeats: int = 3) -> float:
    """Shortest of a few times [s]."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def main() -> None:
    """Times every study's labels."""
    rng = np.random.default_rng(0)
    matrices = rng.normal(size=(N, 6, 7))
    decomposition = best_of(lambda: np.linalg.svd(matrices))
    print(f"| study | joints | {N} labels [s] | times {N} SVDs of 6 x 7 |\n|---|---|---|---|")
    for name in STUDIES:
        task = study_task(read_study(Path("config/studies") / f"{name}.yaml"))
        x = rng.uniform(task.x.lower, task.x.upper, (N, len(task.x)))
        seconds = best_of(lambda task=task, x=x: task.reach(x))
        print(f"| {name} | {len(task.q)} | {seconds:.2f} | {seconds / decomposition:.0f} |")


if __name__ == "__main__":
    main()
