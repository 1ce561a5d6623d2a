"""Where samples are placed in the workspace."""

import numpy as np
from numpy.typing import ArrayLike

from iksamples.arm.chain import Floats


def full_grid(lower_mm: ArrayLike, upper_mm: ArrayLike, points_per_axis: int) -> Floats:
    """Evenly spaced grid that includes the box's corners (paper, sec. 4).

    Args:
        lower_mm: Lower corner [mm], shape (axes,).
        upper_mm: Upper corner [mm], shape (axes,).
        points_per_axis: m, at least 2.

    Returns:
        Points [mm], shape (m ** axes, axes), last axis fastest.
    """
    sides = [
        np.linspace(low, high, points_per_axis)
        for low, high in zip(np.asarray(lower_mm), np.asarray(upper_mm), strict=True)
    ]
    return np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, len(sides))


def chebyshev_grid(lower_mm: ArrayLike, upper_mm: ArrayLike, points_per_axis: int) -> Floats:
    """Tensor grid of Chebyshev nodes of the first kind [mm], shape (m ** axes, axes).

    The nodes at which polynomial interpolation is within a small factor of the best possible
    (Trefethen, *Approximation Theory and Approximation Practice*, ch. 2 and 15); none lies on the
    box's boundary.
    """
    lower, upper = np.asarray(lower_mm, float), np.asarray(upper_mm, float)
    angle = (2 * np.arange(points_per_axis) + 1) * np.pi / (2 * points_per_axis)
    node = (1 - np.cos(angle)) / 2
    sides = [low + (high - low) * node for low, high in zip(lower, upper, strict=True)]
    return np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, len(sides))


def uniform(
    lower_mm: ArrayLike, upper_mm: ArrayLike, n: int, generator: np.random.Generator
) -> Floats:
    """Points drawn uniformly from a box [mm], shape (n, axes)."""
    return _in_box(lower_mm, upper_mm, generator.random((n, np.size(lower_mm))))


def latin_hypercube(
    lower_mm: ArrayLike, upper_mm: ArrayLike, n: int, generator: np.random.Generator
) -> Floats:
    """Latin hypercube: one point in each of n slices along every axis [mm], shape (n, axes)."""
    from scipy.stats import qmc

    return _in_box(
        lower_mm, upper_mm, qmc.LatinHypercube(np.size(lower_mm), rng=generator).random(n)
    )


def sobol(
    lower_mm: ArrayLike, upper_mm: ArrayLike, n: int, generator: np.random.Generator
) -> Floats:
    """Scrambled Sobol points in a box [mm], shape (n, axes) (Owen 1998, by SciPy)."""
    from scipy.stats import qmc

    engine = qmc.Sobol(np.size(lower_mm), rng=generator)
    # Drawn as a whole power of two, which is what the sequence is balanced for.
    return _in_box(lower_mm, upper_mm, engine.random_base2(int(np.ceil(np.log2(n))))[:n])


def _in_box(lower_mm: ArrayLike, upper_mm: ArrayLike, unit: Floats) -> Floats:
    """Points of the unit cube carried to a box."""
    lower, upper = np.asarray(lower_mm, float), np.asarray(upper_mm, float)
    return lower + (upper - lower) * unit


def grid_spacing_mm(lower_mm: ArrayLike, upper_mm: ArrayLike, points_per_axis: int) -> float:
    """Longest distance between neighbours of a full grid along one axis, d [mm]."""
    sides = np.asarray(upper_mm, float) - np.asarray(lower_mm, float)
    return float(np.max(sides) / (points_per_axis - 1))


def grid_fill_distance_mm(lower_mm: ArrayLike, upper_mm: ArrayLike, points_per_axis: int) -> float:
    """Fill distance of a full grid [mm]: from a cell's centre to its corners.

    Half a cell's diagonal, sqrt(3) / 2 * d on a cube, where the paper's Eq. 24 takes d / 2.
    """
    sides = np.asarray(upper_mm, float) - np.asarray(lower_mm, float)
    return float(np.linalg.norm(sides / (points_per_axis - 1)) / 2)


def fill_distance_mm(samples_mm: ArrayLike, region_mm: ArrayLike) -> float:
    """Largest distance from a point of a region to its nearest sample [mm].

    Args:
        samples_mm: Samples [mm], shape (n, axes).
        region_mm: Points that stand for the region [mm], shape (points, axes). The answer is a
            lower estimate, off by at most the fill distance of these points themselves.
    """
    from scipy.spatial import KDTree

    distance, _ = KDTree(np.asarray(samples_mm)).query(np.asarray(region_mm))
    return float(np.max(distance))
