"""A look-up table: multilinear interpolation between the samples of a grid."""

from iksamples.methods.predictor import Predictor, Single
from iksamples.methods.tensor import tensor_grid
from iksamples.samples.dataset import SampleSet


def fit(samples: SampleSet) -> Predictor:
    """Interpolates linearly along each axis in turn, in the cell that a position lies in.

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
