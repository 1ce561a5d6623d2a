"""Initial weights, shuffles, the split of the samples: what every engine shares."""

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from iksamples.study import HeldOut
from iksamples.training.problem import (
    GOLDEN,
    initial_weights,
    mix,
    permutations,
    snapshot_epochs,
    split_grid,
)


def test_light_modules_stay_light():
    code = (
        "import sys; import iksamples.network, iksamples.training.problem,"
        " iksamples.training.run;"
        "print([m for m in ('torch', 'pytorch_lightning', 'numba', 'pandas') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_kernels_are_glorot_uniform_and_biases_zero():
    kernels, biases = initial_weights((3, 16, 5, 3), range(2000))
    assert [k.shape for k in kernels] == [(2000, 3, 16), (2000, 16, 5), (2000, 5, 3)]
    assert not any(bias.any() for bias in biases)
    for kernel in kernels:
        limit = np.sqrt(6 / sum(kernel.shape[1:]))
        assert stats.kstest(kernel.ravel(), stats.uniform(-limit, 2 * limit).cdf).pvalue > 0.001
        assert kernel.dtype == np.float32


def test_initial_weights_of_a_seed_do_not_depend_on_the_others():
    alone, _ = initial_weights((3, 16, 3), [7])
    among, _ = initial_weights((3, 16, 3), [9, 3, 7])
    for one, many in zip(alone, among, strict=True):
        np.testing.assert_array_equal(one[0], many[2])
    assert not np.array_equal(among[0][0], among[0][1])


def plain_permutation(seed: int, epoch: int, n: int) -> list[int]:
    """The documented shuffle in whole numbers of Python."""
    full = 2**64

    def scatter(x: int) -> int:
        x = (x ^ (x >> 30)) * 0xBF58476D1CE4E5B9 % full
        x = (x ^ (x >> 27)) * 0x94D049BB133111EB % full
        return x ^ (x >> 31)

    golden = 0x9E3779B97F4A7C15
    start = scatter((scatter((seed + golden) % full) + epoch) % full)
    order = list(range(n))
    for i in reversed(range(1, n)):
        j = (scatter((start + i * golden) % full) >> 32) * (i + 1) >> 32
        order[i], order[j] = order[j], order[i]
    return order


@given(seed=st.integers(0, 2**31), epoch=st.integers(0, 10**6), n=st.integers(1, 60))
def test_permutation_equals_its_definition(seed, epoch, n):
    expected = plain_permutation(seed, epoch, n)
    assert permutations([seed], [epoch], n)[0, 0].tolist() == expected
    assert sorted(expected) == list(range(n))


def test_mix_is_splitmix64():
    # First three numbers of the generator's widely published test vector, from state 1234567.
    with np.errstate(over="ignore"):
        states = np.uint64(1234567) + np.arange(1, 4, dtype=np.uint64) * GOLDEN
    expected = [6457827717110365317, 3203168211198807973, 9817491932198370423]
    assert mix(states).tolist() == expected


@pytest.mark.parametrize(("seeds", "epochs"), [(range(24_000), [3]), ([5], range(1, 24_001))])
def test_all_orders_are_equally_likely(seeds, epochs):
    order = permutations(seeds, epochs, 4).reshape(-1, 4)
    _, counts = np.unique(order @ [64, 16, 4, 1], return_counts=True)
    assert len(counts) == 24
    assert stats.chisquare(counts).pvalue > 0.001


def test_places_of_a_long_order_are_uniform_and_epochs_uncorrelated():
    order = permutations(range(20), range(1, 101), 125)
    counts = np.stack([np.bincount(order[..., i].ravel(), minlength=125) for i in (0, 60, 124)])
    assert stats.chisquare(counts, axis=1).pvalue.min() > 0.001
    here, there = order[:, :-1].reshape(-1, 125), order[:, 1:].reshape(-1, 125)
    correlation = [stats.pearsonr(a, b)[0] for a, b in zip(here, there, strict=True)]
    assert abs(np.mean(correlation)) < 4 / np.sqrt(125 * len(correlation))


@pytest.mark.parametrize(
    ("n", "shares", "expected"),
    [
        (8, (0.05, 0.05), (0, 0)),  # 0.4 of a sample is none
        (27, (0.05, 0.05), (1, 1)),
        (125, (0.05, 0.05), (6, 6)),
        (512, (0.05, 0.05), (26, 26)),
        (2, (0.5, 0.4), (1, 0)),  # one node must be left
        (3, (0.5, 0.4), (2, 0)),
    ],
)
def test_held_out_counts(n, shares, expected):
    settings = HeldOut(source="grid", validation_share=shares[0], test_share=shares[1])
    assert settings.counts(n) == expected
    parts = split_grid([4, 5, 6], n, settings)
    assert [part.shape for part in parts] == [
        (3, n - sum(expected)),
        (3, expected[0]),
        (3, expected[1]),
    ]
    for row in np.concatenate(parts, axis=1):
        assert sorted(row) == list(range(n))


def test_a_seed_loses_the_same_nodes_whatever_seeds_are_beside_it():
    settings = HeldOut(source="grid")
    alone, among = split_grid([3], 125, settings), split_grid([1, 2, 3], 125, settings)
    for one, many in zip(alone, among, strict=True):
        np.testing.assert_array_equal(one[0], many[2])
    assert not np.array_equal(among[1][0], among[1][1])


@given(epochs=st.integers(1, 3000), count=st.integers(2, 200))
def test_snapshot_epochs_span_the_training(epochs, count):
    chosen = snapshot_epochs(epochs, count)
    assert (chosen[0], chosen[-1]) == (0, epochs)
    assert (np.diff(chosen) > 0).all()
    assert len(chosen) <= max(count, 2)
    if epochs >= 10 * count:
        assert len(chosen) > 0.9 * count
