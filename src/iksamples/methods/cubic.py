"""A tensor product of cubic splines through the samples of a grid."""

import numpy as np

from iksamples.methods.predictor import Predictor, Single
from iksamples.methods.tensor import tensor_grid
from iksamples.samples.dataset import SampleSet


def fit(samples: SampleSet) -> Predictor:
    """Interpolates with a cubic spline along each axis, not-a-knot at the ends.

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
