"""The four files a training leaves in its folder; every later step reads these."""

from pathlib import Path

import numpy as np

from iksamples.files import kept_file
from iksamples.network import StackedMLP, write_tensors
from iksamples.samples.dataset import SampleSet
from iksamples.training.problem import Problem
from iksamples.training.record import METRICS, Record, unstack


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
    kernels, biases = unstack(record.snapshots, problem.sizes, problem.output_scale)
    tensors: dict[str, np.ndarray] = {
        "epochs": record.snapshot_epochs,
        "offset_mm": network.offset_mm,
        "scale_mm": network.scale_mm,
    }
    for depth, (kernel, bias) in enumerate(zip(kernels, biases, strict=True)):
        tensors[f"layers.{depth}.weight"] = np.ascontiguousarray(kernel)
        tensors[f"layers.{depth}.bias"] = np.ascontiguousarray(bias)
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
        & np.isfinite(losses["train_loss_rad2"])
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
    losses = {f"{kind}_loss_rad2": np.full(problem.n_seeds, np.nan) for kind in kinds}
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
                    losses[f"{kind}_loss_rad2"][some] = chosen.mean(axis=1)
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
