"""Which network stands for a stack, and how it came to be what it is."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from iksamples.network import StackedMLP, read_tensors


if TYPE_CHECKING:
    import pandas as pd

MAX_EPOCHS = 60


def median_seed(waypoints: "pd.DataFrame") -> int:
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
        The epochs, at most 60 of them with the first and the last, shape (epochs,), and a stack
        with one network per epoch.
    """
    tensors, header = read_tensors(path)
    row = header["seeds"].index(seed)
    epochs = tensors["epochs"].astype(np.int64)
    kept = np.unique(np.linspace(0, len(epochs) - 1, MAX_EPOCHS).round().astype(int))
    layers = range(sum(key.endswith(".weight") for key in tensors))
    weights, biases = (
        tuple(tensors[f"layers.{i}.{part}"][:, row][kept] for i in layers)
        for part in ("weight", "bias")
    )
    stack = StackedMLP(
        weights,
        biases,
        header["activation"],
        tensors["offset_mm"],
        tensors["scale_mm"],
        (seed,) * len(kept),
    )
    return epochs[kept], stack
