"""The paper's bounds as it prints them (arXiv 2605.23583), and whether they bound what is measured.

One function per lemma or equation. They are kept to the letter, also where the letter is wrong:
Lemma 1 leaves the training error out and rests on an inequality that does not hold, Lemma 2 drops
the first layer's weights, and Eq. 25 is a squared, dimensionless quantity that the paper's Table 1
compares with millimetres. None of them is a guarantee. Table 1 itself is here, too.

Symbols: X is a position normalised to [0, 1], Q the joint values [rad], f the network, g the
forward kinematics, n the number of samples, w a weight of a layer's kernel (biases never enter).
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from iksamples.arm.chain import Floats
from iksamples.network import ACTIVATIONS, StackedMLP
from iksamples.samples.dataset import SampleSet
from iksamples.samples.record import region_points
from iksamples.stats import Interval
from iksamples.study import Study


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


_STEP = 1e-6


def scale_mm(study: Study) -> float:
    """The length that turns the paper's normalised estimate into millimetres."""
    sides = np.subtract(study.workspace.upper_mm, study.workspace.lower_mm)
    return float(study.bounds.scale_mm or np.max(sides))


def audit(
    study: Study, samples: SampleSet, network: StackedMLP, cube: pd.DataFrame
) -> pd.DataFrame:
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
    from scipy.spatial import KDTree

    scale = scale_mm(study)
    n = samples.points_per_axis ** samples.x.shape[1]
    points = region_points(samples.region, study.evaluation.cube_points)
    error_mm = cube.pivot(index="seed", columns="point", values="error_mm")
    errors: Floats = error_mm.loc[list(network.seeds)].to_numpy(float)
    distance, _ = KDTree(samples.normalise(samples.x)).query(samples.normalise(points))

    columns: dict[str, NDArray] = {"seed": np.asarray(network.seeds)}
    for name, average in AVERAGES.items():
        wbar = average(network.weights)
        estimate = estimate_mm(wbar, n, scale)
        columns[f"wbar_{name}"] = wbar
        columns[f"estimate_{name}_mm"] = estimate
        columns[f"above_{name}"] = np.mean(errors > estimate[:, None], axis=1)
    norms = np.max(equation_16(input_jacobian(network, points)), axis=1)
    gamma = lemma_2(norms)
    bound = lemma_1(gamma[:, None], distance)
    columns["output_weight_max"] = equation_18(network.weights[-1])
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
    hidden = (positions_mm - network.offset) / network.scale
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


AVERAGE_NAMES = {
    "mean": "mean of w",
    "mean_abs": "mean of |w|",
    "rms": "rms of w",
    "max_abs": "largest |w|",
}
"""Meanings of the paper's average weight, in words."""


@dataclass(frozen=True, eq=False)
class GridEvidence:
    """What was found for the networks of one grid; arrays have one value per seed.

    Attributes:
        m: Points per axis.
        n: Samples.
        spacing_mm: Distance d between neighbours [mm].
        fill_mm: Largest distance from a point of the workspace to its nearest sample [mm].
        error_mm: Mean error along the paper's kind of path [mm].
        estimate_mm: Eq. 25 for each meaning of the average weight [mm].
        average_weight: The average weights themselves [-].
        above: Share of the workspace whose error exceeds Eq. 25, for each meaning.
        lemma_1_squared: Share that exceeds Lemma 1, read as a bound on the squared error.
        lemma_1_mm: The same, multiplied by a length once as the paper's table does.
        output_weight: Largest |w| of the output layer [rad]; Eq. 18 leaves out the bars, which
            would make its bound smaller, or negative.
        slope: Largest |dq/dx| found [rad].
        at_samples_mm: Largest error at a trained point [mm].
        at_samples_mean_mm: Mean error over the trained points [mm].
        sup_mm: Certified upper bound of the error over the workspace [mm]; NaN: not certified.
        argmax: Where the largest known error is, in spacings from the grid's lower corner, shape
            (seeds, 3).
    """

    m: int
    n: int
    spacing_mm: float
    fill_mm: float
    error_mm: Floats
    estimate_mm: Mapping[str, Floats]
    average_weight: Mapping[str, Floats]
    above: Mapping[str, Floats]
    lemma_1_squared: Floats
    lemma_1_mm: Floats
    output_weight: Floats
    slope: Floats
    at_samples_mm: Floats
    at_samples_mean_mm: Floats
    sup_mm: Floats
    argmax: Floats


@dataclass(frozen=True, eq=False)
class Evidence:
    """Everything the claims are held against.

    Attributes:
        grids: One entry per grid, fewest samples first.
        chosen: Which average weight the study takes for the paper's.
        names: What the averages are called.
        row_sums_mm: Largest absolute row sum of dg/dQ [mm/rad] at points of the workspace.
        row_sums_by_range: The same with joints divided by their range and positions by the side of
            the workspace [-].
        scale_mm: The length that normalises positions [mm].
        fall: By which share the error falls from ``fall_n[0]`` to ``fall_n[1]`` samples; None: the
            study has only one grid.
        fall_n: Those numbers of samples.
        paper_n: n of the paper's Table 1.
        paper_error_mm: Its errors [mm].
        paper_estimate_mm: Its estimates [mm].
        paper_scale_mm: Side of the cube behind its spacings [mm].
        floors_mm: Floor a of e = a + b / (m - 1)^2 for "the paper’s column" and "here" [mm].
        tails_mm: Their b [mm].
        misfits: By which share the fitted law is off its data at most.
    """

    grids: Sequence[GridEvidence]
    chosen: str
    names: Mapping[str, str]
    row_sums_mm: Floats
    row_sums_by_range: Floats
    scale_mm: float
    fall: Interval | None
    fall_n: tuple[int, int]
    paper_n: Floats
    paper_error_mm: Floats
    paper_estimate_mm: Floats
    paper_scale_mm: float
    floors_mm: Mapping[str, Interval]
    tails_mm: Mapping[str, float]
    misfits: Mapping[str, float]


def paper_table() -> pd.DataFrame:
    """The paper's Table 1, indexed by samples_per_axis."""
    with files("iksamples.paper").joinpath("table1.csv").open() as file:
        table = pd.read_csv(file)
    return table.set_index("samples_per_axis").rename(
        columns={
            "error_measured_mm": "paper_error_mm",
            "error_measured_sd_mm": "paper_error_sd_mm",
            "error_estimated_mm": "paper_estimate_mm",
            "error_over_spacing": "paper_error_over_spacing",
        }
    )


def kept_reading() -> dict[str, Any]:
    """The reading that comes nearest to the paper's Table 1, as ``readings.best_reading`` left it.

    Returns:
        ``options`` (the option of each question), ``contradicts`` (the questions answered against
        the paper's words), ``first_seed``, and ``rows`` with the columns ``readings.ROWS``.
    """
    found: dict[str, Any] = json.loads(
        files("iksamples.paper").joinpath("reading.json").read_text()
    )
    return found


def reading_table() -> pd.DataFrame:
    """The rows of that reading, indexed by samples_per_axis."""
    rows = pd.DataFrame(kept_reading()["rows"])
    rows.index = pd.Index(np.cbrt(rows["n_samples"]).round().astype(int), name="samples_per_axis")
    names = {"error_mean_mm": "reading_error_mm", "error_sd_mm": "reading_error_sd_mm"}
    return rows[list(names)].rename(columns=names)
