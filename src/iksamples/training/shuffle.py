"""The order in which a seed sees its samples: one permutation per (seed, epoch), by counter.

Every engine uses this order. A permutation needs no state from the epoch before, so a seed's order
does not depend on the other seeds, and a resumed run goes on as if it had never stopped.

The random numbers are those of SplitMix64 (Steele, Lea and Flood, 2014) from a start that is hashed
from the seed and the epoch; they drive the Fisher-Yates shuffle (Knuth, vol. 2, algorithm P), and a
number is brought below a bound by multiplying and shifting (Lemire, 2019, without the rejection:
with 32 random bits the bias is below ``n / 2**32``).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


GOLDEN = np.uint64(0x9E3779B97F4A7C15)
MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
MIX_2 = np.uint64(0x94D049BB133111EB)

HELD_OUT_EPOCH = 0
"""Epochs of training count from 1; the permutation of epoch 0 chooses held-out samples."""


def permutations(seeds: Sequence[int], epochs: Sequence[int], n: int) -> NDArray[np.int32]:
    """The permutations of ``range(n)`` that the seeds use in the epochs.

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
