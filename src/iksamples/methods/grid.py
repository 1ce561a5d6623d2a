"""Methods that take a sample at every crossing of a grid: tables, splines, one polynomial."""

from dataclasses import dataclass

import numpy as np

from iksamples.arm.chain import Floats
from iksamples.methods.predictor import NotApplicableError, Single
from iksamples.samples.dataset import SampleSet


MOST_INPUTS = 4
"""Inputs of a grid that is worth its samples: with five, two points per axis are 32 of them."""
_SAME = 1e-9
"""Coordinates nearer than this share of the samples' extent are one coordinate."""


@dataclass(frozen=True, eq=False)
class TensorGrid:
    """Samples at every crossing of some coordinates, however they are spaced.

    Attributes:
        axes: The coordinates along each axis, increasing [mm or rad].
        joints: Joint values at the crossings [rad or mm], shape (m_1, ..., m_d, joints).
    """

    axes: tuple[Floats, ...]
    joints: Floats


def tensor_grid(samples: SampleSet, kind: str) -> TensorGrid:
    """Sorts samples, in whatever order, into the grid they lie on.

    Args:
        samples: The samples.
        kind: The method that asks, for the message.

    Raises:
        NotApplicableError: There are too many inputs, or the samples are no full grid: some are
            masked, or they are scattered.
    """
    d = samples.x.shape[1]
    if d > MOST_INPUTS:
        raise NotApplicableError(
            f"{kind}: interpolates in 2 to {MOST_INPUTS} inputs, and there are {d}. Use rbf or "
            "gaussian-process."
        )
    axes, places = [], []
    for x in samples.x.T:
        values = np.unique(x)
        axis = values[np.diff(values, prepend=-np.inf) > _SAME * np.ptp(x)]
        axes.append(axis)
        places.append(np.searchsorted(axis, x, side="right") - 1)
    shape = tuple(len(axis) for axis in axes)
    n = samples.n_samples
    # As many samples as crossings, and no two at the same one: then each has its own.
    full = np.prod(shape, dtype=float) == n and len(np.unique(places, axis=1).T) == n
    if not full:
        crossings = " x ".join(str(m) for m in shape)
        why = (
            f"{samples.n_masked} grid points are masked"
            if samples.n_masked
            else f"{n} samples on {crossings} coordinates"
        )
        raise NotApplicableError(
            f"{kind}: needs a sample at every crossing of a grid, and {samples.label} is no full "
            f"grid ({why}). Use rbf or gaussian-process on these samples, or a grid in a workspace "
            "that the arm can reach all of."
        )
    joints = np.empty((*shape, samples.joints.shape[1]))
    joints[tuple(places)] = samples.joints
    return TensorGrid(tuple(axes), joints)


def multilinear(samples: SampleSet) -> Single:
    """A look-up table: linear along each axis in turn, in the cell that a position lies in.

    What a controller without a library would do. A joint value is off by at most h^2 / 8 times the
    sum over the axes of its largest second derivative (de Boor, *A Practical Guide to Splines*,
    ch. III and XVII), so halving the spacing h quarters the error. Outside the grid the outermost
    cells go on. ``certify.table`` certifies it.

    Raises:
        NotApplicableError: The samples are no full grid.
    """
    from scipy.interpolate import RegularGridInterpolator

    grid = tensor_grid(samples, "multilinear")
    return Single(
        RegularGridInterpolator(grid.axes, grid.joints, bounds_error=False, fill_value=None)
    )


def cubic(samples: SampleSet) -> Single:
    """A tensor product of cubic splines, not-a-knot at the ends.

    The error of a smooth arm falls as h^4 (de Boor, *A Practical Guide to Splines*, ch. IV and
    XVII). Cubic takes four points; along an axis of three the spline is one parabola, along an axis
    of two a line, so that on a grid of eight samples this is the multilinear table. Outside the
    grid the outermost pieces go on.

    Raises:
        NotApplicableError: The samples are no full grid.
    """
    from scipy.interpolate import NdBSpline, make_interp_spline

    grid = tensor_grid(samples, "cubic")
    # Axis by axis, each exactly: SciPy's own tensor splines solve for all axes at once, and
    # iteratively.
    knots, degrees, coefficients = [], [], grid.joints
    for i, axis in enumerate(grid.axes):
        degree = min(3, len(axis) - 1)
        spline = make_interp_spline(axis, coefficients, k=degree, axis=i)
        # SciPy keeps the interpolated axis of the coefficients in front.
        coefficients = np.moveaxis(spline.c, 0, i)
        knots.append(spline.t)
        degrees.append(degree)
    return Single(NdBSpline(tuple(knots), coefficients, tuple(degrees), extrapolate=True))


def polynomial(samples: SampleSet) -> Single:
    """Interpolates with the polynomial of degree m - 1 along each axis of m points.

    Evaluated by the barycentric formula (Berrut and Trefethen, "Barycentric Lagrange
    interpolation", *SIAM Review* 46, 2004). On Chebyshev nodes this is Chebyshev interpolation,
    whose error falls geometrically with m where the arm is away from its singular poses. On evenly
    spaced nodes beware of Runge's phenomenon: with m the polynomial comes to swing between the
    outermost nodes, and the factor by which it magnifies the noise of recorded samples grows like
    2^m per axis.

    Raises:
        NotApplicableError: The samples are no full grid.
    """
    from scipy.interpolate import BarycentricInterpolator

    grid = tensor_grid(samples, "polynomial")
    # Values of the Lagrange polynomials: each is 1 at its own node. The generator is SciPy's, to
    # order the nodes before it multiplies their distances.
    bases = [
        BarycentricInterpolator(axis, np.eye(len(axis)), rng=np.random.default_rng(0))
        for axis in grid.axes
    ]

    def answer(x: Floats) -> Floats:
        values = np.tensordot(bases[0](x[:, 0]), grid.joints, axes=1)
        for i in range(1, len(bases)):
            values = np.einsum("pm,pm...->p...", bases[i](x[:, i]), values)
        return values

    return Single(answer)
