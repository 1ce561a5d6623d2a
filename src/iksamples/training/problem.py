"""What is to be trained: the numbers every engine works on, and which seed learns from which."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from iksamples.samples.dataset import SampleSet
from iksamples.study import HeldOut, Study, Training


Singles = NDArray[np.float32]
Index = NDArray[np.int32]


def initial_weights(
    sizes: Sequence[int], seeds: Sequence[int]
) -> tuple[tuple[Singles, ...], tuple[Singles, ...]]:
    """Glorot-uniform kernels and zero biases, as Keras' ``Dense`` starts.

    A kernel of ``fan_in`` rows and ``fan_out`` columns is uniform between plus and minus
    ``sqrt(6 / (fan_in + fan_out))`` (Glorot and Bengio, 2010, Eq. 16). The numbers of one layer of
    one seed come from a counter-based generator keyed by (seed, layer), so they depend on nothing
    else.

    Args:
        sizes: Neurons of each layer, from the inputs to the outputs.
        seeds: One seed per network, non-negative.

    Returns:
        Kernels, one per layer, shape (seeds, in, out), and biases, shape (seeds, out).
    """
    kernels, biases = [], []
    for layer, (fan_in, fan_out) in enumerate(pairwise(sizes)):
        limit = np.float32(np.sqrt(6.0 / (fan_in + fan_out)))
        kernel = np.empty((len(seeds), fan_in, fan_out), np.float32)
        for row, seed in enumerate(seeds):
            generator = np.random.Generator(
                np.random.Philox(key=np.array([seed, layer], np.uint64))
            )
            kernel[row] = generator.random((fan_in, fan_out), np.float32)
        kernels.append((2 * kernel - 1) * limit)
        biases.append(np.zeros((len(seeds), fan_out), np.float32))
    return tuple(kernels), tuple(biases)


GOLDEN = np.uint64(0x9E3779B97F4A7C15)
MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
MIX_2 = np.uint64(0x94D049BB133111EB)

HELD_OUT_EPOCH = 0
"""Epochs of training count from 1; the permutation of epoch 0 chooses held-out samples."""


def permutations(seeds: Sequence[int], epochs: Sequence[int], n: int) -> NDArray[np.int32]:
    """The permutations of ``range(n)`` that the seeds use in the epochs, whatever the engine.

    A permutation needs no state from the epoch before, so a seed's order does not depend on the
    other seeds, and a resumed run goes on as if it had never stopped. The random numbers are those
    of SplitMix64 (Steele, Lea and Flood, 2014) from a start that is hashed from the seed and the
    epoch; they drive the Fisher-Yates shuffle (Knuth, vol. 2, algorithm P), and a number is brought
    below a bound by multiplying and shifting (Lemire, 2019, without the rejection: with 32 random
    bits the bias is below ``n / 2**32``).

    Args:
        seeds: Non-negative seeds.
        epochs: Epochs, counted from 1.
        n: Number of samples, below 2**31.

    Returns:
        Shape (seeds, epochs, n): the order of the samples.
    """
    seed = np.asarray(seeds, np.uint64)[:, None]
    epoch = np.asarray(epochs, np.uint64)[None, :]
    with np.errstate(over="ignore"):  # arithmetic modulo 2**64 is meant
        start = mix(mix(seed + GOLDEN) + epoch)
        order = np.empty((n, *start.shape), np.int32)
        order[:] = np.arange(n, dtype=np.int32)[:, None, None]
        rows, columns = np.indices(start.shape)
        for i in range(n - 1, 0, -1):
            bits = mix(start + np.uint64(i) * GOLDEN) >> np.uint64(32)
            j = ((bits * np.uint64(i + 1)) >> np.uint64(32)).astype(np.intp)
            chosen = order[j, rows, columns]
            order[j, rows, columns] = order[i]
            order[i] = chosen
    return np.ascontiguousarray(np.moveaxis(order, 0, -1))


def mix(x: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """SplitMix64's output function: a bijection of 64-bit numbers that scatters them."""
    x = (x ^ (x >> np.uint64(30))) * MIX_1
    x = (x ^ (x >> np.uint64(27))) * MIX_2
    return x ^ (x >> np.uint64(31))


@dataclass(frozen=True, eq=False)
class Problem:
    """Networks of one shape, one per seed, and the points they learn from.

    All points are in one table; a seed's training, validation and test points are rows of it.

    Attributes:
        seeds: One seed per network.
        sizes: Neurons of each layer, from the inputs to the outputs.
        activation: Activation of the hidden layers.
        inputs: Normalised inputs, shape (points, in).
        targets: Joint values over ``output_scale``, shape (points, out).
        output_scale: What joint values are divided by [1 or mm], powers of two, shape (out,).
        train_rows: Rows a seed learns from, shape (seeds, n_train).
        validation_rows: Rows of its validation loss, shape (seeds, n_validation).
        test_rows: Rows of its test loss, shape (seeds, n_test).
        training: The study's training settings.
    """

    seeds: tuple[int, ...]
    sizes: tuple[int, ...]
    activation: str
    inputs: Singles
    targets: Singles
    output_scale: NDArray[np.float64]
    train_rows: Index
    validation_rows: Index
    test_rows: Index
    training: Training

    @property
    def n_seeds(self) -> int:
        """Number of networks."""
        return len(self.seeds)

    @property
    def n_train(self) -> int:
        """Number of samples that each network learns from."""
        return self.train_rows.shape[1]

    @property
    def n_parameters(self) -> int:
        """Weights and biases of one network."""
        return sum((fan_in + 1) * fan_out for fan_in, fan_out in pairwise(self.sizes))

    @property
    def steps_per_epoch(self) -> int:
        """Optimiser steps of an epoch."""
        return self.training.steps_per_epoch(self.n_train)


def pose_problem(study: Study, samples: SampleSet, seeds: Sequence[int]) -> Problem:
    """The problem that a study sets for some seeds on one set of samples."""
    n, n_validation, n_test = (
        len(part) for part in (samples.x, samples.validation_x, samples.test_x)
    )
    joints = samples.recorded(seeds)
    x = np.tile(samples.inputs, (len(joints), 1))
    if study.training.held_out.source == "grid":
        train, validation, test = split_grid(seeds, n, study.training.held_out)
    else:
        rows = np.arange(n + n_validation + n_test, dtype=np.int32)
        stacked = np.broadcast_to(rows, (len(seeds), len(rows)))
        train, validation, test = np.split(stacked, [n, n + n_validation], axis=1)
    if samples.arms:
        # A seed's rows are those that its own arm has recorded.
        own = np.arange(len(seeds), dtype=np.int32)[:, None] * joints.shape[1]
        train, validation, test = train + own, validation + own, test + own
    joints = joints.reshape(len(x), -1)
    return Problem(
        tuple(seeds),
        (x.shape[1], *study.network.hidden, joints.shape[1]),
        study.network.activation,
        samples.normalise(x).astype(np.float32),
        (joints / samples.output_scale).astype(np.float32),
        samples.output_scale,
        train,
        validation,
        test,
        study.training,
    )


def split_grid(seeds: Sequence[int], n: int, held_out: HeldOut) -> tuple[Index, Index, Index]:
    """Takes validation and test points from the grid's nodes, for each seed by itself.

    Returns:
        Rows to train on, to validate on and to test on, each in ascending order, shape (seeds, ..).
    """
    order = permutations(seeds, [HELD_OUT_EPOCH], n)[:, 0]
    n_validation, n_test = held_out.counts(n)
    validation, test, train = np.split(order, [n_validation, n_validation + n_test], axis=1)
    return np.sort(train), np.sort(validation), np.sort(test)


def learning_rates(training: Training) -> NDArray[np.float64]:
    """Learning rate of each epoch, before what a seed's own plateau makes of it."""
    if training.schedule == "cosine":
        phase = np.arange(training.epochs) / training.epochs
        return training.learning_rate * 0.5 * (1 + np.cos(np.pi * phase))
    return np.full(training.epochs, training.learning_rate)


def snapshot_epochs(epochs: int, count: int) -> NDArray[np.int64]:
    """Epochs whose weights are kept: 0 (before training), then evenly on a log scale, to the last.

    Args:
        epochs: Last epoch.
        count: How many are wanted, at least 2; fewer are given when there are not enough epochs.

    Returns:
        Ascending epochs.
    """
    if epochs < count:
        return np.arange(epochs + 1)
    chosen = np.array([epochs])
    # Early epochs coincide after rounding, so more points are laid than are wanted.
    for laid in range(count - 1, 50 * count):
        spread = np.unique(np.rint(np.geomspace(1, epochs, laid)).astype(np.int64))
        if len(spread) > count - 1:
            break
        chosen = spread
    return np.concatenate([[0], chosen[:-1], [epochs]])
