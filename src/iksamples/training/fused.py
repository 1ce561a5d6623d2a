"""The fused engine: hands groups of seeds to the compiled training loop of ``kernel``.

Seeds are cut into groups of ``LANES``; the last group is filled up with copies of the last seed,
whose results are dropped. Groups are independent, so they run on as many threads as torch may use
without any effect on the numbers.
"""

import hashlib
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from iksamples.training import kernel, lanes
from iksamples.training.problem import Problem, learning_rates
from iksamples.training.reference import BETA_1, BETA_2, EPSILON, Progress, StackedAdam


Array = NDArray[Any]


class Data(NamedTuple):
    """What a group of seeds learns from, a lane for each seed.

    Attributes:
        inputs: Shape (points, in).
        targets: Shape (points, out).
        train_rows: Rows each lane learns from, shape (lanes, n), int32.
        validation_rows: Rows of its validation loss, shape (lanes, n_validation), int32.
    """

    inputs: Array
    targets: Array
    train_rows: Array
    validation_rows: Array


class Schedule(NamedTuple):
    """The steps of a block of epochs.

    Attributes:
        batch_size: Samples per step.
        first_epoch: First epoch of the block, counted from 1.
        rates: Adam's step size, bias correction included, for each step of the block.
        epsilons: Adam's epsilon, likewise.
    """

    batch_size: int
    first_epoch: int
    rates: Array
    epsilons: Array


class Group(NamedTuple):
    """A group of seeds; all but the seeds is changed in place.

    Flat arrays hold one vector of lanes per row: parameter p of the seed in lane k is
    ``w[p * lanes + k]``.

    Attributes:
        seeds: Shape (lanes,), uint64.
        w: Parameters, flat.
        m: Mean of the gradients, flat.
        v: Mean of their squares, flat.
        kept: Parameters put aside, flat.
        best_loss: Shape (lanes,).
        counters: Best epoch, epochs since it, epochs since then or since the rate was halved, and
            epoch of the stop, shape (4, lanes), int64.
        factor: What the learning rate is multiplied with, shape (lanes,).
    """

    seeds: Array
    w: Array
    m: Array
    v: Array
    kept: Array
    best_loss: Array
    counters: Array
    factor: Array


class Filled(NamedTuple):
    """What a block of epochs leaves behind.

    Attributes:
        history: Rows (epoch of the block, metric), flat.
        slots: Where to put the snapshot of each epoch of the block, -1 for nowhere.
        snapshots: Rows (slot, parameter), flat.
    """

    history: Array
    slots: Array
    snapshots: Array


class Stopping(NamedTuple):
    """What a seed's validation loss decides.

    Attributes:
        patience: Epochs without improvement that stop a seed; 0: never.
        restore_best: Put aside the parameters of the best epoch, not those of the stop.
        min_delta: Smallest improvement that counts.
        plateau: Epochs without improvement that halve the learning rate; 0: never.
    """

    patience: int
    restore_best: bool
    min_delta: float
    plateau: int


LANES = 16
"""Seeds per group: one AVX-512 register of float32, two of AVX2."""


class FusedEngine:
    """Trains blocks of epochs of ReLU or tanh networks with Adam on the CPU."""

    dtype = torch.float32
    pace = 5e8

    def __init__(self, problem: Problem) -> None:
        """Takes the problem whose seeds it trains."""
        self.problem = problem
        n = problem.n_seeds
        # Row of the stack that each lane of each group takes.
        self.rows = np.minimum(np.arange(-(-n // LANES) * LANES), n - 1)
        self.height = tile_height(problem.training.batch_size)

    def run(
        self, flat: Tensor, adam: StackedAdam, progress: Progress, first: int, n_epochs: int
    ) -> None:
        """Trains from epoch ``first`` for ``n_epochs`` epochs; see ``ReferenceEngine.run``."""
        problem, settings = self.problem, self.problem.training
        moments = adam.state[adam.flat]
        stacked = [flat, moments["mean"], moments["square"], progress.kept]
        w, m, v, kept = (self._pack(tensor.numpy()) for tensor in stacked)
        n_groups, width = w.shape

        epochs = np.arange(first, first + n_epochs)
        chosen = np.nonzero(np.isin(progress.snapshot_epochs.numpy(), epochs))[0]
        slots = np.full(n_epochs, -1)
        slots[progress.snapshot_epochs.numpy()[chosen] - first] = np.arange(len(chosen))
        snapshots = np.zeros((n_groups, len(chosen), width), w.dtype)
        history = np.full((n_groups, n_epochs, 5, LANES), np.nan, w.dtype)
        rates, epsilons = step_sizes(problem, epochs, w.dtype)

        def spread(values: Any) -> Any:
            """Values per seed as values per group and lane."""
            taken = np.asarray(values)[self.rows]
            return taken.reshape(n_groups, LANES, *taken.shape[1:])

        seeds = spread(np.array(problem.seeds, np.uint64))
        train_rows, validation_rows = spread(problem.train_rows), spread(problem.validation_rows)
        best_loss, factor = spread(progress.best_loss), spread(progress.factor)
        names = ("best_epoch", "waited", "stalled", "stopped")
        counters = np.stack([spread(getattr(progress, name)) for name in names], axis=1)

        def handed(group: int) -> tuple[Any, ...]:
            return (
                Data(
                    problem.inputs.astype(w.dtype, copy=False),
                    problem.targets.astype(w.dtype, copy=False),
                    train_rows[group],
                    validation_rows[group],
                ),
                np.array(problem.sizes),
                kernel.ACTIVATIONS[problem.activation],
                Schedule(settings.batch_size, first, rates, epsilons),
                Group(
                    seeds[group],
                    *(part[group] for part in (w, m, v, kept, best_loss, counters, factor)),
                ),
                Filled(history[group].reshape(-1), slots, snapshots[group].reshape(-1)),
                Stopping(
                    progress.patience,
                    progress.restore_best,
                    w.dtype.type(progress.min_delta),
                    progress.plateau,
                ),
                (0,) * LANES,
                (0,) * self.height,
            )

        train = compiled(*handed(0))
        threads = min(n_groups, torch.get_num_threads())
        if threads == 1:
            for group in range(n_groups):
                train(*handed(group))
        else:
            with ThreadPoolExecutor(threads) as pool:
                list(pool.map(lambda group: train(*handed(group)), range(n_groups)))

        for tensor, packed in zip(stacked, (w, m, v, kept), strict=True):
            tensor.copy_(torch.from_numpy(self._unpack(packed)))
        n, taken = problem.n_seeds, slice(first - 1, first - 1 + n_epochs)
        for name, values in zip(names, np.moveaxis(counters, 1, 0), strict=True):
            getattr(progress, name).copy_(torch.from_numpy(values.reshape(-1)[:n]))
        progress.best_loss.copy_(torch.from_numpy(best_loss.reshape(-1)[:n]))
        progress.factor.copy_(torch.from_numpy(factor.reshape(-1)[:n]))
        metrics = history.transpose(2, 1, 0, 3).reshape(5, n_epochs, -1)
        progress.history[:, taken] = torch.from_numpy(metrics[:, :, :n])
        for slot, row in enumerate(chosen):
            progress.snapshots[row] = torch.from_numpy(self._unpack(snapshots[:, slot]))

    def _pack(self, stacked: NDArray[Any]) -> NDArray[Any]:
        """(seeds, parameters) as (groups, parameters * LANES), each group on a cache line."""
        groups = stacked[self.rows].reshape(-1, LANES, stacked.shape[1]).transpose(0, 2, 1)
        raw = np.empty(groups.size * groups.itemsize + 64, np.uint8)
        start = -raw.ctypes.data % 64
        packed = raw[start : start + groups.size * groups.itemsize].view(groups.dtype)
        packed = packed.reshape(len(groups), -1)
        packed[:] = groups.reshape(len(groups), -1)
        return packed

    def _unpack(self, packed: NDArray[Any]) -> NDArray[Any]:
        """The reverse, without the copies that fill up the last group."""
        lanes_last = packed.reshape(len(packed), -1, LANES).transpose(0, 2, 1)
        return lanes_last.reshape(-1, lanes_last.shape[2])[: self.problem.n_seeds]


def step_sizes(
    problem: Problem, epochs: NDArray[np.int64], dtype: Any
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Adam's step size and epsilon of each step of some epochs, with the bias corrections in them.

    ``lr m_hat / (sqrt(v_hat) + eps)`` is ``(lr s / c) m / (sqrt(v) + eps s)`` with
    ``c = 1 - beta_1^t`` and ``s = sqrt(1 - beta_2^t)`` (Kingma and Ba, 2015, end of section 2).
    """
    steps = problem.steps_per_epoch
    t = np.arange((epochs[0] - 1) * steps + 1, epochs[-1] * steps + 1, dtype=float)
    root = np.sqrt(1 - BETA_2**t)
    rates = np.repeat(learning_rates(problem.training)[epochs - 1], steps)
    return (rates * root / (1 - BETA_1**t)).astype(dtype), (EPSILON * root).astype(dtype)


def tile_height(batch_size: int) -> int:
    """Samples in a tile: as many accumulators as the registers hold, fewer for tiny batches.

    No result depends on it: samples are added one after another whatever the height.
    """
    from llvmlite import binding

    wide = binding.get_host_cpu_features().get("avx512f", False)
    return 1 if batch_size <= 2 else 8 if wide else 4


def compiled(*values: Any) -> Callable[..., None]:
    """The compiled training loop for arguments of these types."""
    import numba

    signature = tuple(numba.typeof(value) for value in values)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", numba.core.errors.NumbaWarning)
        try:
            train = _dispatcher(cached=True)
            train.compile(signature)
        except Exception:
            # The cache on disk may be read-only, full or damaged, none of which matters: compile
            # again without it. What is wrong with the code itself will be raised here as well.
            train = _dispatcher(cached=False)
            train.compile(signature)
    return train


@cache
def _dispatcher(cached: bool) -> Any:
    import numba

    # numba's cache watches only the file of the function that it keeps; so its name carries the
    # content of all.
    sources = (kernel.__file__, lanes.__file__, __file__)
    content = b"".join(Path(file).read_bytes() for file in sources)
    loop = kernel.train_group
    loop.__qualname__ = f"train_group_{hashlib.sha256(content).hexdigest()[:8]}"
    return numba.njit(nogil=True, cache=cached)(loop)
