"""Do the paper's bounds bound? Each of them beside the errors that were measured, seed by seed."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from iksamples.arm.chain import Floats
from iksamples.network import ACTIVATIONS, StackedMLP
from iksamples.paper import equations as paper
from iksamples.samples.dataset import SampleSet
from iksamples.samples.record import region_points
from iksamples.study import Study


if TYPE_CHECKING:
    import pandas as pd

_STEP = 1e-6


def scale_mm(study: Study) -> float:
    """The length that turns the paper's normalised estimate into millimetres."""
    sides = np.subtract(study.workspace.upper_mm, study.workspace.lower_mm)
    return float(study.bounds.scale_mm or np.max(sides))


def audit(
    study: Study, samples: SampleSet, network: StackedMLP, cube: "pd.DataFrame"
) -> "pd.DataFrame":
    """The paper's bounds for every trained network, and how often each is exceeded.

    Args:
        study: The study.
        samples: What the networks were trained on.
        network: The trained networks.
        cube: Errors over the whole workspace (``evaluation.errors.cube_errors``).

    Returns:
        One row per seed: ``wbar_<average>`` [-], ``estimate_<average>_mm`` (Eq. 25),
        ``above_<average>`` (share of the workspace's points whose error exceeds it),
        ``output_weight_max`` (Eq. 18), ``jacobian_norm_rad`` (Eq. 16, largest over the points),
        ``gamma`` (Lemma 2 with it), ``lemma_1_above_squared`` and ``lemma_1_above_mm`` (share of
        points that exceed Lemma 1, read as a bound on the squared normalised error, or multiplied
        by the scale as the paper's table does).
    """
    import pandas as pd
    from scipy.spatial import KDTree

    scale = scale_mm(study)
    n = samples.points_per_axis ** samples.x.shape[1]
    points = region_points(samples.region, study.evaluation.cube_points)
    error_mm = cube.pivot(index="seed", columns="point", values="error_mm")
    errors: Floats = error_mm.loc[list(network.seeds)].to_numpy(float)
    distance, _ = KDTree(samples.normalise(samples.x)).query(samples.normalise(points))

    columns: dict[str, NDArray] = {"seed": np.asarray(network.seeds)}
    for name, average in paper.AVERAGES.items():
        wbar = average(network.weights)
        estimate = paper.estimate_mm(wbar, n, scale)
        columns[f"wbar_{name}"] = wbar
        columns[f"estimate_{name}_mm"] = estimate
        columns[f"above_{name}"] = np.mean(errors > estimate[:, None], axis=1)
    norms = np.max(paper.equation_16(input_jacobian(network, points)), axis=1)
    gamma = paper.lemma_2(norms)
    bound = paper.lemma_1(gamma[:, None], distance)
    columns["output_weight_max"] = paper.equation_18(network.weights[-1])
    columns["jacobian_norm_rad"] = norms
    columns["gamma"] = gamma
    columns["lemma_1_above_squared"] = np.mean(np.square(errors / scale) > bound, axis=1)
    columns["lemma_1_above_mm"] = np.mean(errors > scale * bound, axis=1)
    return pd.DataFrame(columns)


def input_jacobian(network: StackedMLP, positions_mm: Floats) -> Floats:
    """Derivative of the joint values by the normalised inputs, df/dX (paper, Eq. 15).

    Args:
        network: Stacked networks.
        positions_mm: Positions [mm], shape (points, in).

    Returns:
        Shape (seeds, points, joints, in) [rad].
    """
    phi = ACTIVATIONS[network.activation]
    hidden = (positions_mm - network.offset_mm) / network.scale_mm
    slope = np.eye(hidden.shape[-1])  # d hidden / d input, shape (seeds, points, in, width)
    for depth, (weight, bias) in enumerate(zip(network.weights, network.biases, strict=True)):
        hidden = hidden @ weight.astype(float) + bias.astype(float)[:, None, :]
        slope = slope @ weight.astype(float)[:, None]
        if depth < len(network.weights) - 1:
            # A central difference serves every activation alike, exact away from a kink.
            rate = (phi(hidden + _STEP) - phi(hidden - _STEP)) / (2 * _STEP)
            slope = slope * rate[:, :, None, :]
            hidden = phi(hidden)
    return np.swapaxes(slope, -1, -2)
