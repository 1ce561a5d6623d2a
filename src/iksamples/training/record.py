"""What a training leaves behind: plain arrays, and the four files that every later step reads."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iksamples.files import kept_file
from iksamples.network import StackedMLP, layer_tensors, write_tensors
from iksamples.samples.dataset import SampleSet
from iksamples.training.problem import Problem


Singles = NDArray[np.float32]
Integers = NDArray[np.int64]

METRICS = (
    "train_loss",
    "validation_loss",
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
        from safetensors.numpy import save

        arrays = {name: np.ascontiguousarray(array) for name, array in self._arrays().items()}
        path.write_bytes(save(arrays))  # see write_tensors

    @classmethod
    def load(cls, path: Path) -> "Record":
        """Reads what ``save`` wrote."""
        from safetensors.numpy import load_file

        return cls(**load_file(path))

    def _arrays(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in fields(self)}


def layers(flat: Any, sizes: Sequence[int]) -> Iterator[tuple[Any, Any]]:
    """Views of flat parameters as kernels and biases, layer by layer.

    Args:
        flat: An array or a tensor, shape (..., parameters): kernel (row by row), bias, next kernel,
            and so on.
        sizes: Neurons of each layer.

    Yields:
        Kernel, shape (..., in, out), and bias, shape (..., out).
    """
    at = 0
    for fan_in, fan_out in pairwise(sizes):
        kernel = flat[..., at : at + fan_in * fan_out]
        at += fan_in * fan_out
        yield kernel.reshape(*flat.shape[:-1], fan_in, fan_out), flat[..., at : at + fan_out]
        at += fan_out


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
    kernels, biases = zip(*layers(flat, sizes), strict=True)
    scale = output_scale.astype(np.float32)
    return (*kernels[:-1], kernels[-1] * scale), (*biases[:-1], biases[-1] * scale)


def stack(kernels: Sequence[Singles], biases: Sequence[Singles]) -> Singles:
    """Kernels (seeds, in, out) and biases (seeds, out) as flat parameters, the reverse."""
    n = len(kernels[0])
    parts = [
        part.reshape(n, -1)
        for kernel, bias in zip(kernels, biases, strict=True)
        for part in (kernel, bias)
    ]
    return np.concatenate(parts, axis=1)


_SEEDS_AT_ONCE = 64


def write_files(folder: Path, problem: Problem, samples: SampleSet, record: Record) -> None:
    """Writes weights, snapshots, history and members of trained seeds, each file whole or not.

    Args:
        folder: Made if it is not there.
        problem: What was trained.
        samples: The samples it was posed on.
        record: The trained seeds, in the problem's order.
    """
    network = final_network(problem, samples, record)
    with kept_file(folder / "weights.safetensors") as file:
        network.save(file)
    with kept_file(folder / "snapshots.safetensors") as file:
        _save_snapshots(file, problem, network, record)
    with kept_file(folder / "history.parquet") as file:
        _save_table(file, _history(record))
    with kept_file(folder / "members.parquet") as file:
        _save_table(file, _members(problem, samples, record, network))


def final_network(problem: Problem, samples: SampleSet, record: Record) -> StackedMLP:
    """The networks a training ended with."""
    return StackedMLP(
        *unstack(record.parameters, problem.sizes, problem.output_scale),
        problem.activation,
        samples.offset,
        samples.scale,
        problem.seeds,
    )


def _save_snapshots(path: Path, problem: Problem, network: StackedMLP, record: Record) -> None:
    tensors = {
        "epochs": record.snapshot_epochs,
        "offset": network.offset,
        "scale": network.scale,
        **layer_tensors(*unstack(record.snapshots, problem.sizes, problem.output_scale)),
    }
    write_tensors(path, tensors, {"activation": network.activation, "seeds": list(network.seeds)})


def _history(record: Record) -> dict[str, np.ndarray]:
    """A row per seed and epoch that was run."""
    epochs = record.history.shape[1]
    run = epochs_run(record)
    was_run = np.arange(1, epochs + 1) <= run[:, None]
    seed, epoch = np.nonzero(was_run)
    columns: dict[str, np.ndarray] = {"seed": record.seeds[seed], "epoch": epoch + 1}
    return columns | {
        name: values.T[was_run] for name, values in zip(METRICS, record.history, strict=True)
    }


def epochs_run(record: Record) -> np.ndarray:
    """Epochs each seed was trained for."""
    return np.where(record.stopped > 0, record.stopped, record.history.shape[1])


def _members(
    problem: Problem, samples: SampleSet, record: Record, network: StackedMLP
) -> dict[str, np.ndarray]:
    """A row per seed; the losses are those of the final weights over all points of a kind."""
    n, run = problem.n_seeds, epochs_run(record)
    losses = _losses(problem, samples, network)
    steps = np.arange(record.history.shape[1]) < run[:, None]
    train_history = np.where(steps, record.history[0].T, 0)
    finite = (
        np.isfinite(record.parameters).all(axis=1)
        & np.isfinite(train_history).all(axis=1)
        & np.isfinite(losses["train_loss"])
    )
    return {
        "seed": record.seeds,
        "n_trained": np.full(n, problem.n_train),
        "n_validation": np.full(n, problem.validation_rows.shape[1]),
        "n_test": np.full(n, problem.test_rows.shape[1]),
        "epochs_run": run,
        "best_epoch": np.where(record.best_epoch > 0, record.best_epoch, run),
        "steps": run * problem.steps_per_epoch,
        "diverged": ~finite,
        **losses,
    }


def _losses(problem: Problem, samples: SampleSet, network: StackedMLP) -> dict[str, np.ndarray]:
    """Mean squared error over each seed's points of each kind [rad^2]; NaN without points.

    A prismatic joint's error counts over its output scale, as in training.
    """
    x, joints = samples.inputs, samples.recorded(problem.seeds)
    one_for_all = len(joints) == 1
    kinds = {
        "train": problem.train_rows,
        "validation": problem.validation_rows,
        "test": problem.test_rows,
    }
    losses = {f"{kind}_loss": np.full(problem.n_seeds, np.nan) for kind in kinds}
    for first in range(0, problem.n_seeds, _SEEDS_AT_ONCE):
        some = np.arange(first, min(first + _SEEDS_AT_ONCE, problem.n_seeds))
        with np.errstate(all="ignore"):  # a diverged seed is a row with NaN, not an error
            wanted = joints if one_for_all else joints[some]
            error = (network.select(some).predict(x) - wanted) / problem.output_scale
            square = np.mean(error**2, axis=-1)
            for kind, rows in kinds.items():
                if rows.shape[1]:
                    own = rows[some].astype(np.intp) % len(x)
                    chosen = np.take_along_axis(square, own, axis=1)
                    losses[f"{kind}_loss"][some] = chosen.mean(axis=1)
    return losses


def _save_table(path: Path, columns: dict[str, np.ndarray]) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    def column(values: np.ndarray) -> pa.Array:
        # From the bytes, since pa.array would import pandas, which costs more than the training.
        kind = pa.from_numpy_dtype(values.dtype)
        packed = np.packbits(values, bitorder="little") if values.dtype == bool else values
        buffer = pa.py_buffer(np.ascontiguousarray(packed))
        return pa.Array.from_buffers(kind, len(values), [None, buffer])

    table = pa.table({name: column(values) for name, values in columns.items()})
    parquet.write_table(table, path)
