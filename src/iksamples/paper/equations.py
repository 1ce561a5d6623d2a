"""The paper's bounds as it prints them (arXiv 2605.23583), one function per lemma or equation.

They are kept to the letter, also where the letter is wrong: Lemma 1 leaves the training error out
and rests on an inequality that does not hold, Lemma 2 drops the first layer's weights, and Eq. 25
is a squared, dimensionless quantity that the paper's Table 1 compares with millimetres. Whether a
bound really bounds is measured elsewhere; nothing here is a guarantee.

Symbols: X is a position normalised to [0, 1], Q the joint values [rad], f the network, g the
forward kinematics, n the number of samples, w a weight of a layer's kernel (biases never enter).
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from iksamples.arm.chain import Floats


def lemma_1(gamma: ArrayLike, distance: ArrayLike) -> Floats:
    """Lemma 1, Eq. 6: e <= (gamma^2 + 1) |dX|^2.

    Args:
        gamma: Lipschitz constant of g(f(X)) (Eq. 5) [-].
        distance: Normalised distance |dX| to the nearest training point [-].

    Returns:
        The bound on the *squared* normalised error [-].
    """
    return (np.square(gamma) + 1.0) * np.square(distance)


def lemma_2(jacobian_norm: ArrayLike) -> Floats:
    """Lemma 2, Eq. 7 and 20: gamma = sqrt(3) |df/dX|_inf.

    Args:
        jacobian_norm: Infinity norm of the network's Jacobian (Eq. 16) [rad].
    """
    return np.sqrt(3.0) * np.asarray(jacobian_norm, float)


def equation_16(jacobian: ArrayLike) -> Floats:
    """Eq. 16: infinity norm of the inverse Jacobian, the largest absolute row sum.

    Args:
        jacobian: df/dX, shape (..., joints, axes).

    Returns:
        Shape (...).
    """
    return np.max(np.sum(np.abs(np.asarray(jacobian, float)), axis=-1), axis=-1)


def equation_18(output_kernel: ArrayLike) -> Floats:
    """Eq. 18: |dq_k/dx_i| <= w2_jk, with the largest signed weight standing for "j and k".

    Args:
        output_kernel: Weights of the output layer, shape (..., hidden, joints).

    Returns:
        The bound the paper claims, shape (...); not a bound, and possibly negative.
    """
    return np.max(np.asarray(output_kernel, float), axis=(-2, -1))


def equation_21(jacobian_norm: ArrayLike, distance: ArrayLike) -> Floats:
    """Eq. 21: e <= (3 |df/dX|_inf^2 + 1) |dX|^2, Lemma 1 with Lemma 2's gamma [-]."""
    return lemma_1(lemma_2(jacobian_norm), distance)


def equation_23(average_weight: ArrayLike) -> Floats:
    """Eq. 22 and 23: |df/dX|_inf <= 3 w-bar, every derivative replaced by the average weight."""
    return 3.0 * np.asarray(average_weight, float)


def equation_24(n_samples: ArrayLike) -> Floats:
    """Eq. 24: |dX| = 1 / (2 (n^(1/3) - 1)), half the edge of a grid cell [-]."""
    return 0.5 / (np.cbrt(n_samples) - 1.0)


def equation_25(average_weight: ArrayLike, n_samples: ArrayLike) -> Floats:
    """Eq. 25: e <= (27 w-bar^2 + 1) / (4 (n^(1/3) - 1)^2).

    Args:
        average_weight: w-bar [-].
        n_samples: n, a third power.

    Returns:
        The paper's estimate of the squared normalised error [-].
    """
    return equation_21(equation_23(average_weight), equation_24(n_samples))


def estimate_mm(average_weight: ArrayLike, n_samples: ArrayLike, scale_mm: float) -> Floats:
    """Eq. 25 "rescaled into the experimental domain", as the paper's Table 1 must have it [mm].

    The column is reproduced only if the squared, normalised estimate is multiplied by a length
    once, 60 mm; see ``average_weight_of`` for the w-bar that then follows.
    """
    return scale_mm * equation_25(average_weight, n_samples)


def average_weight_of(estimate_mm: ArrayLike, n_samples: ArrayLike, scale_mm: float) -> Floats:
    """Eq. 25 solved for w-bar: the average weight behind an estimate in millimetres.

    Returns:
        w-bar [-]; NaN where no real number gives the estimate.
    """
    squared = np.asarray(estimate_mm, float) / scale_mm / np.square(equation_24(n_samples))
    with np.errstate(invalid="ignore"):
        return np.sqrt((squared - 1.0) / 27.0)


def _pooled(average: Callable[[Floats], Floats]) -> Callable[[Sequence[ArrayLike]], Floats]:
    def over_all_kernels(kernels: Sequence[ArrayLike]) -> Floats:
        flat = [np.reshape(kernel, (np.shape(kernel)[0], -1)) for kernel in kernels]
        return average(np.concatenate(flat, axis=1).astype(float))

    return over_all_kernels


AVERAGES: dict[str, Callable[[Sequence[ArrayLike]], Floats]] = {
    "mean": _pooled(lambda w: np.mean(w, axis=1)),
    "mean_abs": _pooled(lambda w: np.mean(np.abs(w), axis=1)),
    "rms": _pooled(lambda w: np.sqrt(np.mean(np.square(w), axis=1))),
    "max_abs": _pooled(lambda w: np.max(np.abs(w), axis=1)),
}
"""Meanings of "the average weight" (Eq. 22): name -> function of the kernels of all layers, each of
shape (seeds, in, out), to shape (seeds,)."""
