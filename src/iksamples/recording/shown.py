"""What a recording shows of one grid: the network of one seed, on one path."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from iksamples.arm.chain import Floats
from iksamples.errors import IksamplesError
from iksamples.evaluation.errors import Tracking, send
from iksamples.evaluation.shown import median_seed, networks_over_epochs
from iksamples.results import Cell
from iksamples.task import Task


@dataclass(frozen=True, eq=False)
class ShownGrid:
    """One grid on one path, at the end of training and on the way there.

    Attributes:
        label: Name of the grid, such as ``grid5``.
        samples_mm: Its training points [mm], shape (n, 3).
        n_seeds: Networks trained on it.
        seed: The one that is shown.
        target_mm: The path [mm], shape (waypoints, 3).
        breaks: Waypoints before which the pen is lifted.
        joints: What the network answers [rad or mm], shape (waypoints, joints).
        reached_mm: Where that takes the tool [mm], shape (waypoints, 3).
        error_mm: Distance between the two [mm], shape (waypoints,).
        epochs: Epochs at which weights were kept, shape (epochs,).
        learning: What the network answered then, with the epochs in place of the seeds.
    """

    label: str
    samples_mm: Floats
    n_seeds: int
    seed: int
    target_mm: Floats
    breaks: NDArray[np.int64]
    joints: Floats
    reached_mm: Floats
    error_mm: Floats
    epochs: NDArray[np.int64]
    learning: Tracking

    @property
    def n_samples(self) -> int:
        """Number of training points."""
        return len(self.samples_mm)

    @property
    def finite(self) -> bool:
        """Whether the network's answers are numbers throughout."""
        return bool(np.all(np.isfinite(self.joints)) and np.all(np.isfinite(self.learning.joints)))


def read_grid(task: Task, path_name: str, cell: Cell) -> ShownGrid:
    """Reads what a recording shows of one grid.

    Args:
        task: The study's task.
        path_name: Which path.
        cell: The grid's results.

    Raises:
        IksamplesError: The results know no such path.
    """
    table = cell.table("waypoints")
    table = table[table["path"] == path_name]
    if table.empty:
        raise IksamplesError(f"{cell.folder}: path '{path_name}' was not evaluated.")
    seed = median_seed(table)
    rows = table[table["seed"] == seed].sort_values("waypoint")
    target = rows[task.x.columns("target_")].to_numpy(float)
    pen_up = rows["pen_up"].to_numpy(bool)
    epochs, networks = networks_over_epochs(cell.folder / "snapshots.safetensors", seed)
    return ShownGrid(
        label=cell.label,
        samples_mm=task.positions_mm(cell.samples.x),
        n_seeds=table["seed"].nunique(),
        seed=seed,
        target_mm=task.positions_mm(target),
        breaks=np.flatnonzero(pen_up),
        joints=rows[task.q.columns("q_")].to_numpy(float),
        reached_mm=rows[[f"reached_{axis}_mm" for axis in "xyz"]].to_numpy(float),
        error_mm=rows["error_mm"].to_numpy(float),
        epochs=epochs,
        learning=send(networks, task, target),
    )
