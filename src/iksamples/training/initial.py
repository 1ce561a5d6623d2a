"""Initial weights: the same for every engine, and for a seed whatever other seeds are trained."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray


Weights = NDArray[np.float32]


def initial_weights(
    sizes: Sequence[int], seeds: Sequence[int]
) -> tuple[tuple[Weights, ...], tuple[Weights, ...]]:
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
