"""What a recording shows of one grid: the network of one seed, on one path."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iksamples.errors import IksamplesError
from iksamples.robot.chain import Floats, SerialChain
from iksamples.samples.dataset import AXES, SampleSet
from iksamples.training.network import StackedMLP


class GridFiles(NamedTuple):
    """One grid's result files."""

    samples: Path
    snapshots: Path
    waypoints: Path


@dataclass(frozen=True, eq=False)
class ShownGrid:
    """One grid on one path, at the end of training and on the way there.

    Attributes:
        label: Name of the grid, such as ``grid5``.
        samples_mm: Its training points [mm], shape (n, 3).
        n_seeds: Networks trained on it.
        seed: The one that is shown.
        target_mm: The path [mm], shape (waypoints, 3).
        joints: What the network answers [rad or mm], shape (waypoints, joints).
        reached_mm: Where that takes the tool [mm], shape (waypoints, 3).
        error_mm: Distance between the two [mm], shape (waypoints,).
        epochs: Epochs at which weights were kept, shape (epochs,).
        learning_joints: What the network answered then [rad or mm],
            shape (epochs, waypoints, joints).
        learning_mm: Where that took the tool [mm], shape (epochs, waypoints, 3).
    """

    label: str
    samples_mm: Floats
    n_seeds: int
    seed: int
    target_mm: Floats
    joints: Floats
    reached_mm: Floats
    error_mm: Floats
    epochs: NDArray[np.int64]
    learning_joints: Floats
    learning_mm: Floats

    @property
    def n_samples(self) -> int:
        """Number of training points."""
        return len(self.samples_mm)

    @property
    def learning_error_mm(self) -> Floats:
        """Mean distance from the path at each of the epochs [mm], shape (epochs,)."""
        return np.linalg.norm(self.learning_mm - self.target_mm, axis=-1).mean(axis=-1)


def read_grid(chain: SerialChain, path_name: str, files: GridFiles) -> ShownGrid:
    """Reads what a recording shows of one grid.

    Args:
        chain: The study's arm.
        path_name: Which path.
        files: The grid's results.

    Raises:
        IksamplesError: The results know no such path.
    """
    samples = SampleSet.load(files.samples)
    table = pd.read_parquet(files.waypoints, filters=[("path", "==", path_name)])
    if table.empty:
        raise IksamplesError(f"{files.waypoints}: no path '{path_name}' was evaluated.")
    seed = median_seed(table)
    rows = table[table["seed"] == seed].sort_values("waypoint")
    target = rows[[f"target_{axis}_mm" for axis in AXES]].to_numpy(float)
    epochs, networks = networks_over_epochs(files.snapshots, seed)
    learning_joints = networks.predict(target)
    return ShownGrid(
        label=samples.label,
        samples_mm=samples.positions_mm,
        n_seeds=table["seed"].nunique(),
        seed=seed,
        target_mm=target,
        joints=rows[[f"q_{name}_rad" for name in chain.joint_names]].to_numpy(float),
        reached_mm=rows[[f"reached_{axis}_mm" for axis in AXES]].to_numpy(float),
        error_mm=rows["error_mm"].to_numpy(float),
        epochs=epochs,
        learning_joints=learning_joints,
        learning_mm=chain.forward_mm(learning_joints),
    )


def median_seed(waypoints: pd.DataFrame) -> int:
    """The seed whose mean error on a path is the median over the seeds.

    Of an even number of seeds it is the better of the middle two, so that it is always a network
    that was trained. Seeds without a finite error come last.

    Args:
        waypoints: Rows of one path with the columns ``seed`` and ``error_mm``.
    """
    errors = waypoints.groupby("seed")["error_mm"].agg(lambda error: error.mean(skipna=False))
    ranked = errors.sort_values(kind="stable", na_position="last")
    return int(ranked.index[(len(ranked) - 1) // 2])


def networks_over_epochs(path: str | Path, seed: int) -> tuple[NDArray[np.int64], StackedMLP]:
    """The network of one seed at every epoch that was kept.

    Args:
        path: Snapshots of a grid's training (safetensors).
        seed: Which seed.

    Returns:
        The epochs, shape (epochs,), and a stack with one network per epoch.
    """
    from safetensors import safe_open

    with safe_open(str(path), framework="numpy") as file:
        header = {key: json.loads(value) for key, value in file.metadata().items()}
        row = header["seeds"].index(seed)
        layers = range(sum(key.endswith(".weight") for key in file.keys()))  # noqa: SIM118
        weights, biases = (
            tuple(np.array(file.get_slice(f"layers.{i}.{part}")[:, row]) for i in layers)
            for part in ("weight", "bias")
        )
        epochs = file.get_tensor("epochs").astype(np.int64)
        offset_mm, scale_mm = file.get_tensor("offset_mm"), file.get_tensor("scale_mm")
    stack = StackedMLP(
        weights, biases, header["activation"], offset_mm, scale_mm, (seed,) * len(epochs)
    )
    return epochs, stack
