"""One polynomial through all samples of a grid."""

import numpy as np

from iksamples.arm.chain import Floats
from iksamples.methods.predictor import Predictor, Single
from iksamples.methods.tensor import tensor_grid
from iksamples.samples.dataset import SampleSet


def fit(samples: SampleSet) -> Predictor:
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
