"""Where samples are placed in the workspace."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iksamples.arm.chain import Floats


_BITS = 30
_POLYNOMIALS = (
    (1, 0, (1,)),
    (2, 1, (1, 3)),
    (3, 1, (1, 3, 1)),
    (3, 2, (1, 1, 1)),
    (4, 1, (1, 1, 3, 3)),
)
"""Degree, inner factors and first direction numbers of the second to the sixth coordinate."""


def full_grid(lower: ArrayLike, upper: ArrayLike, shape: int | Sequence[int]) -> Floats:
    """Evenly spaced grid that includes the box's corners (paper, sec. 4).

    Args:
        lower: Lower corner, shape (d,).
        upper: Upper corner, shape (d,).
        shape: Points along each axis, or along every one, at least 2.

    Returns:
        Points, shape (product of the shape, d), last axis fastest.
    """
    return _crossings(lower, upper, shape, np.linspace)


def chebyshev_grid(lower: ArrayLike, upper: ArrayLike, shape: int | Sequence[int]) -> Floats:
    """Tensor grid of Chebyshev nodes of the first kind, arguments and shape as ``full_grid``.

    The nodes at which polynomial interpolation is within a small factor of the best possible
    (Trefethen, *Approximation Theory and Approximation Practice*, ch. 2 and 15); none lies on the
    box's boundary.
    """

    def nodes(low: float, high: float, m: int) -> Floats:
        angle = (2 * np.arange(m) + 1) * np.pi / (2 * m)
        return low + (high - low) * ((1 - np.cos(angle)) / 2)

    return _crossings(lower, upper, shape, nodes)


def uniform(lower: ArrayLike, upper: ArrayLike, n: int, generator: np.random.Generator) -> Floats:
    """Points drawn uniformly from a box, shape (n, d)."""
    return _in_box(lower, upper, generator.random((n, np.size(lower))))


def latin_hypercube(
    lower: ArrayLike, upper: ArrayLike, n: int, generator: np.random.Generator
) -> Floats:
    """Latin hypercube: one point in each of n slices along every axis, shape (n, d)."""
    from scipy.stats import qmc

    return _in_box(lower, upper, qmc.LatinHypercube(np.size(lower), rng=generator).random(n))


def sobol(lower: ArrayLike, upper: ArrayLike, n: int, generator: np.random.Generator) -> Floats:
    """Scrambled Sobol points in a box of up to six edges, shape (n, d) (Owen 1998).

    Direction numbers by Joe and Kuo (2008), scrambling by Matousek (1998). The points are those of
    SciPy, whose ``scipy.stats`` takes longer to import than most steps need for all their work.
    """
    d, places = np.size(lower), 2 ** np.arange(_BITS)[::-1]
    stream = generator.spawn(1)[0]
    shift = stream.integers(2, size=(d, _BITS), dtype=np.uint32) @ places[::-1]
    mix = np.tril(stream.integers(2, size=(d, _BITS, _BITS), dtype=np.uint32), -1) + np.eye(_BITS)
    bits = _directions(d)[:, :, None] // places % 2
    mixed = (bits @ mix.swapaxes(1, 2) % 2 @ places).astype(int)
    # Neighbours differ by the direction of the last bit of their number (Antonov, Saleev 1979).
    number = np.arange(1, n)
    steps = mixed.T[np.log2(number & -number).astype(int)]
    whole = np.bitwise_xor.accumulate(np.concatenate([shift[None].astype(int), steps]))
    return _in_box(lower, upper, whole / 2**_BITS)


def _directions(d: int) -> NDArray[np.int64]:
    """The direction numbers of a Sobol sequence as integers of 30 bits, shape (d, 30)."""
    rows = [[1] * _BITS]
    for degree, inner, first in _POLYNOMIALS[: d - 1]:
        row = list(first)
        for j in range(degree, _BITS):
            new = row[j - degree] ^ (row[j - degree] << degree)
            for k in range(1, degree):
                new ^= (inner >> (degree - 1 - k) & 1) * (row[j - k] << k)
            row.append(new)
        rows.append(row)
    return np.array(rows) << np.arange(_BITS)[::-1]


def _in_box(lower: ArrayLike, upper: ArrayLike, unit: Floats) -> Floats:
    """Points of the unit cube carried to a box."""
    lower, upper = np.asarray(lower, float), np.asarray(upper, float)
    return lower + (upper - lower) * unit


def grid_spacing(lower: ArrayLike, upper: ArrayLike, shape: int | Sequence[int]) -> Floats:
    """Distances between neighbours of a full grid along each axis, shape (d,)."""
    return (np.asarray(upper, float) - np.asarray(lower, float)) / (np.asarray(shape) - 1)


def fill_distance(samples: ArrayLike, region: ArrayLike) -> float:
    """Largest distance from a point of a region to its nearest sample.

    Of a full grid on a box it is half a cell's diagonal, sqrt(3) / 2 * d on a cube, where the
    paper's Eq. 24 takes d / 2.

    Args:
        samples: Samples, shape (n, d).
        region: Points that stand for the region, shape (points, d). The answer is a lower
            estimate, off by at most the fill distance of these points themselves.
    """
    from scipy.spatial import KDTree

    distance, _ = KDTree(np.asarray(samples)).query(np.asarray(region))
    return float(np.max(distance))


def _crossings(
    lower: ArrayLike,
    upper: ArrayLike,
    shape: int | Sequence[int],
    nodes: Callable[[float, float, int], Floats],
) -> Floats:
    """The crossings of some nodes along each axis of a box, shape (points, d)."""
    limits = zip(np.asarray(lower, float), np.asarray(upper, float), strict=True)
    counts = np.broadcast_to(shape, np.shape(lower))
    sides = [nodes(low, high, m) for (low, high), m in zip(limits, counts, strict=True)]
    return np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, len(sides))
