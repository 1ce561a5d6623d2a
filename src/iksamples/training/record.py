"""What a training leaves behind, as plain arrays: nothing here needs torch."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


Singles = NDArray[np.float32]
Integers = NDArray[np.int64]

METRICS = (
    "train_loss_rad2",
    "validation_loss_rad2",
    "weight_mean",
    "weight_mean_abs",
    "weight_max_abs",
)
"""Rows of the history."""

# Where the seeds' axis is in each array; the same for all seeds where it is not named.
_SEED_AXIS = {
    "seeds": 0,
    "parameters": 0,
    "history": 2,
    "snapshots": 1,
    "best_epoch": 0,
    "stopped": 0,
}


@dataclass(frozen=True, eq=False)
class Record:
    """Trained seeds of one problem.

    Attributes:
        seeds: Shape (seeds,).
        parameters: Final parameters, layer by layer kernel (row by row) and bias, shape
            (seeds, parameters).
        history: Rows as in ``METRICS``, shape (5, epochs, seeds), NaN where not run.
        snapshot_epochs: Shape (snapshots,).
        snapshots: Shape (snapshots, seeds, parameters).
        best_epoch: Epoch of the best validation loss, 0 if there was none, shape (seeds,).
        stopped: Epoch after which early stopping acted, 0 if it did not, shape (seeds,).
    """

    seeds: Integers
    parameters: Singles
    history: Singles
    snapshot_epochs: Integers
    snapshots: Singles
    best_epoch: Integers
    stopped: Integers

    def select(self, seeds: Sequence[int]) -> "Record":
        """The given seeds, in that order."""
        row = {int(seed): i for i, seed in enumerate(self.seeds)}
        index = [row[seed] for seed in seeds]
        return Record(
            **{
                name: np.take(array, index, axis=_SEED_AXIS[name]) if name in _SEED_AXIS else array
                for name, array in self._arrays().items()
            }
        )

    @staticmethod
    def join(records: Sequence["Record"]) -> "Record":
        """Records of the same problem, one after another."""
        parts = [record._arrays() for record in records]
        return Record(
            **{
                name: np.concatenate([part[name] for part in parts], axis=_SEED_AXIS[name])
                if name in _SEED_AXIS
                else array
                for name, array in parts[0].items()
            }
        )

    def save(self, path: Path) -> None:
        """Writes a safetensors file."""
        from safetensors.numpy import save_file

        save_file(
            {name: np.ascontiguousarray(array) for name, array in self._arrays().items()}, path
        )

    @classmethod
    def load(cls, path: Path) -> "Record":
        """Reads what ``save`` wrote."""
        from safetensors.numpy import load_file

        return cls(**load_file(path))

    def _arrays(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in fields(self)}


def unstack(
    flat: Singles, sizes: Sequence[int], output_scale: NDArray[np.float64]
) -> tuple[tuple[Singles, ...], tuple[Singles, ...]]:
    """Flat parameters as kernels and biases of networks that answer in the joints' own units.

    Args:
        flat: Shape (..., parameters).
        sizes: Neurons of each layer.
        output_scale: What the outputs were divided by in training, powers of two, shape (out,):
            the last layer is multiplied by it, which is exact.

    Returns:
        Kernels, one per layer, shape (..., in, out), and biases, shape (..., out).
    """
    kernels, biases, at = [], [], 0
    for fan_in, fan_out in pairwise(sizes):
        kernel = flat[..., at : at + fan_in * fan_out]
        kernels.append(kernel.reshape(*flat.shape[:-1], fan_in, fan_out))
        at += fan_in * fan_out
        biases.append(flat[..., at : at + fan_out])
        at += fan_out
    scale = output_scale.astype(np.float32)
    kernels[-1], biases[-1] = kernels[-1] * scale, biases[-1] * scale
    return tuple(kernels), tuple(biases)


def stack(kernels: Sequence[Singles], biases: Sequence[Singles]) -> Singles:
    """Kernels (seeds, in, out) and biases (seeds, out) as flat parameters, the reverse."""
    n = len(kernels[0])
    parts = [
        part.reshape(n, -1)
        for kernel, bias in zip(kernels, biases, strict=True)
        for part in (kernel, bias)
    ]
    return np.concatenate(parts, axis=1)
