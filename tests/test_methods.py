"""Methods other than the network: what they answer."""

import math
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from iksamples.errors import IksamplesError
from iksamples.evaluation.errors import cube_errors, send, summarise, track_paths
from iksamples.methods import predictor as predictor_module
from iksamples.methods import scattered
from iksamples.methods.grid import tensor_grid
from iksamples.methods.predictor import NotApplicableError, Single, attempt
from iksamples.methods.registry import KINDS, fit, fit_each
from iksamples.samples.record import grid_samples, region_points
from iksamples.study import MethodKind, parse_study
from iksamples.task import study_task


ON_GRIDS = ["multilinear", "cubic", "polynomial"]
EVERYWHERE = ["rbf", "gaussian-process"]
THROUGH_SAMPLES = [*ON_GRIDS, *EVERYWHERE]


def with_points(samples, positions_mm, joints, label="mine"):
    """A set of other samples, with its own normalisation."""
    low, high = positions_mm.min(axis=0), positions_mm.max(axis=0)
    return replace(
        samples,
        label=label,
        x=positions_mm,
        joints=joints,
        offset=low,
        scale=high - low,
    )


def on_axes(study, task, *axes_mm, function=None):
    """Samples at all crossings; joint values of a function, or of the arm."""
    positions = np.stack(np.meshgrid(*axes_mm, indexing="ij"), axis=-1).reshape(-1, 3)
    joints = function(positions) if function else task.reach(positions).joints
    return with_points(grid_samples(study, task, 2), positions, joints)


def uniform(study, rng, n):
    return rng.uniform(study.workspace.lower_mm, study.workspace.upper_mm, (n, 3))


def errors_mm(task, predictor, points_mm):
    return send(predictor, task, points_mm).error_mm[0]


@pytest.fixture
def region(study, task):
    return region_points(task.region, 8192)


# --- the interface ---------------------------------------------------------------------------


def test_every_kind_of_the_study_file_is_trained_or_fitted():
    assert set(KINDS) == set(get_args(MethodKind))


def test_a_kind_that_is_not_there_is_named(study, task):
    with pytest.raises(IksamplesError, match="no method 'network' to fit; there are multilinear"):
        fit("network", task, grid_samples(study, task, 2))


@pytest.mark.parametrize("kind", [kind for kind, one in KINDS.items() if one.fit])
def test_one_member_the_same_every_time_and_however_many_points(
    kind, study, task, rng, monkeypatch
):
    monkeypatch.setattr(predictor_module, "_BLOCK", 16)  # points that are answered at once
    samples = grid_samples(study, task, 4)
    points = uniform(study, rng, 50)
    first, again = fit(kind, task, samples), fit(kind, task, samples)
    answers = first.predict(points)
    assert answers.shape == (1, 50, 3)
    assert first.seeds == (0,)
    np.testing.assert_array_equal(again.predict(points), answers)
    some = [0, 15, 16, 49]
    np.testing.assert_allclose(again.predict(points[some])[0], answers[0, some], atol=1e-9)


@pytest.mark.parametrize("kind", THROUGH_SAMPLES)
@pytest.mark.parametrize("m", [2, 3, 5])
def test_samples_are_hit_exactly_in_whatever_order_they_come(kind, m, study, task, rng):
    samples = grid_samples(study, task, m)
    order = rng.permutation(samples.n_samples)
    shuffled = replace(samples, x=samples.x[order], joints=samples.joints[order])
    answer = fit(kind, task, shuffled).predict(samples.x)[0]
    # A Gaussian process has a jitter of 1e-10 of the variance on its diagonal.
    tolerance = 1e-6 if kind == "gaussian-process" else 1e-12
    np.testing.assert_allclose(answer, samples.joints, rtol=0, atol=tolerance)


@pytest.mark.parametrize("kind", THROUGH_SAMPLES)
def test_joint_values_shift_and_scale_with_the_samples(kind, study, task, rng):
    samples = grid_samples(study, task, 3)
    other = replace(samples, joints=samples.joints * 50 - 7)  # as a prismatic joint's, in mm
    points = uniform(study, rng, 20)
    answer, plain = (fit(kind, task, s).predict(points) for s in (other, samples))
    np.testing.assert_allclose(answer, plain * 50 - 7, rtol=0, atol=1e-4)


# --- what is known about each ----------------------------------------------------------------


def test_the_drawings_inverse_is_exact_on_the_drawing(study, task, chain, region):
    predictor = fit("nominal", task, grid_samples(study, task, 2))
    assert errors_mm(task, predictor, region).max() < 1e-11


def test_table_makes_the_known_errors_and_falls_as_the_square_of_the_spacing(
    study, task, chain, region
):
    # Measured beforehand by an independent program over the same cube, m = 2..8.
    known = [10.29, 2.63, 1.17, 0.66, 0.42, 0.29, 0.215]
    mean = []
    for m in (*range(2, 9), 11, 16):
        predictor = fit("multilinear", task, grid_samples(study, task, m))
        mean.append(errors_mm(task, predictor, region).mean())
    np.testing.assert_allclose(mean[:7], known, rtol=0.015)
    # From 10 to 15 cells, the last two.
    assert np.log(mean[-2] / mean[-1]) / np.log(1.5) == pytest.approx(2, abs=0.02)


def test_polynomial_on_chebyshev_nodes_is_chebyshev_interpolation(study, task, chain, region):
    lower, upper = (np.array(getattr(study.workspace, f"{end}_mm")) for end in ("lower", "upper"))
    known = [4.30, 0.41, 0.080, 0.0145, 0.0028, 0.0006, 0.0002]
    mean = []
    for m in range(2, 9):
        nodes = np.polynomial.chebyshev.chebpts1(m)
        axes = lower[:, None] + (upper - lower)[:, None] * (nodes + 1) / 2
        samples = on_axes(study, task, *axes)
        predictor = fit("polynomial", task, samples)
        mean.append(errors_mm(task, predictor, region).mean())

        def scaled(x):
            return (2 * (x - lower) / (upper - lower) - 1).T

        degree = [m - 1] * 3
        vander = np.polynomial.chebyshev.chebvander3d(*scaled(samples.x), degree)
        factors = np.linalg.solve(vander, samples.joints).reshape(m, m, m, 3)
        expected = np.polynomial.chebyshev.chebval3d(*scaled(region), factors).T
        np.testing.assert_allclose(predictor.predict(region)[0], expected, atol=1e-11)
    np.testing.assert_allclose(mean[:5], known[:5], rtol=0.02)
    np.testing.assert_allclose(mean[5:], known[5:], atol=5e-5)  # known to one digit


@pytest.mark.parametrize(
    ("kind", "shape", "degrees"),
    [
        ("multilinear", (2, 3, 4), (1, 1, 1)),
        ("cubic", (2, 3, 6), (1, 2, 3)),
        ("cubic", (4, 5, 7), (3, 3, 3)),
        ("polynomial", (2, 3, 6), (1, 2, 5)),
    ],
)
def test_polynomials_within_the_degree_are_reproduced_on_uneven_grids_and_outside(
    kind, shape, degrees, study, task, rng
):
    factors = rng.normal(size=(*(n + 1 for n in degrees), 2))

    def function(x):
        return np.polynomial.polynomial.polyval3d(*(x / 50 - 1).T, factors).T

    axes = [np.sort(rng.choice(np.arange(10, 90), n, replace=False)) + rng.random() for n in shape]
    predictor = fit(kind, task, on_axes(study, task, *axes, function=function))
    points = rng.uniform(5, 95, (200, 3))
    expected = function(points)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(predictor.predict(points)[0], expected, atol=1e-8 * scale)


def test_cubic_is_a_not_a_knot_spline_along_each_axis(study, task, rng):
    samples = grid_samples(study, task, 6)
    axis = np.unique(samples.x[:, 0]), np.unique(samples.x[:, 2])
    answer = fit("cubic", task, samples)
    for point in uniform(study, rng, 5):
        values = samples.joints.reshape(6, 6, 6, 3)
        for x, nodes in zip(point, (axis[0], axis[0], axis[1]), strict=True):
            values = CubicSpline(nodes, values, bc_type="not-a-knot")(x)
        np.testing.assert_allclose(answer.predict(point[None])[0, 0], values, atol=1e-13)


def test_rbf_solves_the_saddle_point_system(study, task, chain, rng):
    points, new = uniform(study, rng, 40), uniform(study, rng, 5)
    samples = with_points(
        grid_samples(study, task, 2),
        points,
        task.reach(points).joints,
    )

    def kernel(a, b):
        return np.linalg.norm(a[:, None] - b[None], axis=-1) ** 3

    def tail(a):
        return np.column_stack([np.ones(len(a)), a])

    # In millimetres: the kernel does not care for the scale, but the axes' must be one.
    samples = replace(samples, scale=np.full(3, 60.0))
    system = np.block([[kernel(points, points), tail(points)], [tail(points).T, np.zeros((4, 4))]])
    weights = np.linalg.solve(system, np.vstack([samples.joints, np.zeros((4, 3))]))
    expected = np.column_stack([kernel(new, points), tail(new)]) @ weights
    answer = fit("rbf", study_task(study), samples).predict(new)[0]
    np.testing.assert_allclose(answer, expected, atol=1e-9)


def matern(a, b, length):
    """Matern kernel of smoothness 5/2 (Rasmussen and Williams, Eq. 4.17)."""
    r = np.sqrt(5) * np.linalg.norm(a[:, None] - b[None], axis=-1) / length
    return (1 + r + r**2 / 3) * np.exp(-r)


def test_gaussian_process_is_the_posterior_mean_at_the_likeliest_kernel(study, task, chain, rng):
    points, new = uniform(study, rng, 30), uniform(study, rng, 5)
    samples = with_points(
        grid_samples(study, task, 2),
        points,
        task.reach(points).joints,
    )
    kernel = scattered.regressor(samples).kernel_
    variance, length = kernel.k1.constant_value, kernel.k2.length_scale
    inputs = (points - points.min(axis=0)) / np.ptp(points, axis=0)
    centre, spread = samples.joints.mean(axis=0), samples.joints.std(axis=0)
    targets = (samples.joints - centre) / spread

    def covariance(variance, length):
        return variance * matern(inputs, inputs, length) + 1e-10 * np.eye(30)

    def likelihood(variance, length):
        matrix = covariance(variance, length)
        fitness = np.sum(targets * np.linalg.solve(matrix, targets))
        return -0.5 * fitness - 1.5 * np.linalg.slogdet(matrix)[1]

    best = likelihood(variance, length)
    for change in (0.8, 1.25):
        assert likelihood(variance * change, length) < best
        assert likelihood(variance, length * change) < best
    weights = np.linalg.solve(covariance(variance, length), targets)
    new_inputs = (new - points.min(axis=0)) / np.ptp(points, axis=0)
    expected = variance * matern(new_inputs, inputs, length) @ weights * spread + centre
    answer = fit("gaussian-process", study_task(study), samples).predict(new)[0]
    np.testing.assert_allclose(answer, expected, atol=1e-6)


def test_gaussian_process_tuned_on_some_samples_still_uses_all(study, task, monkeypatch):
    monkeypatch.setattr(scattered, "MOST_TO_TUNE", 40)
    samples = grid_samples(study, task, 5)
    answer = fit("gaussian-process", task, samples).predict(samples.x)[0]
    np.testing.assert_allclose(answer, samples.joints, rtol=0, atol=1e-6)


# --- samples that a method cannot use --------------------------------------------------------


@pytest.fixture
def masked():
    study = parse_study(
        {
            "name": "wide",
            "workspace": {"upper_mm": [100, 100, 60]},
            "samples": {"unreachable": "mask"},
        }
    )
    samples = grid_samples(study, study_task(study), 4)
    assert 0 < samples.n_masked < 30
    return study, samples


@pytest.mark.parametrize("kind", ON_GRIDS)
def test_methods_on_grids_refuse_masked_and_scattered_samples(kind, masked, study, task, rng):
    wide, samples = masked
    with pytest.raises(NotApplicableError, match=rf"^{kind}: .*grid4 .*points are masked.*rbf"):
        fit(kind, study_task(wide), samples)
    whole = grid_samples(study, task, 3)
    scattered = with_points(whole, uniform(study, rng, 27), whole.joints)
    with pytest.raises(NotApplicableError, match="27 samples on 27 x 27 x 27 coordinates"):
        fit(kind, task, scattered)
    # As many as there are crossings, but one is there twice.
    twice = whole.x.copy()
    twice[1] = twice[0]
    with pytest.raises(NotApplicableError, match="27 samples on 3 x 3 x 3 coordinates"):
        fit(kind, task, with_points(whole, twice, whole.joints))


def test_rounded_coordinates_are_one(study, task, rng):
    samples = grid_samples(study, task, 4)
    rounded = samples.x + rng.uniform(-1e-9, 1e-9, (64, 3))
    grid = tensor_grid(with_points(samples, rounded, samples.joints), "cubic")
    np.testing.assert_array_equal(grid.joints, samples.joints.reshape(4, 4, 4, 3))
    for axis in grid.axes:
        assert len(axis) == 4


@pytest.mark.parametrize("kind", EVERYWHERE)
def test_methods_for_scattered_samples_take_masked_grids(kind, masked):
    study, samples = masked
    task = study_task(study)
    predictor = fit(kind, study_task(study), samples)
    np.testing.assert_allclose(predictor.predict(samples.x)[0], samples.joints, atol=1e-6)
    assert errors_mm(task, predictor, region_points(task.region, 1024)).mean() < 3


def test_rbf_names_coinciding_and_flat_samples(study, task):
    samples = grid_samples(study, task, 3)
    flat = samples.x.copy()
    flat[:, 2] = flat[:, 0]
    with pytest.raises(IksamplesError, match="rbf: cannot interpolate mine"):
        fit("rbf", task, with_points(samples, flat, samples.joints))


def test_samples_that_defeat_a_method_leave_the_reason_and_no_answer(study, task):
    samples = grid_samples(study, task, 3)
    flat = samples.x.copy()
    flat[:, 2] = flat[:, 0]
    failed = fit_each("rbf", task, with_points(samples, flat, samples.joints), ())
    assert failed.failed.startswith("rbf: cannot interpolate mine")
    answers = failed.predict(samples.x)
    assert answers.shape == (1, 27, 3)
    assert np.isnan(answers).all()
    assert fit_each("rbf", task, samples, ()).failed == ""


@pytest.mark.parametrize(
    ("fault", "is_a_result"),
    [
        (lambda: np.linalg.inv(np.zeros((2, 2))), True),
        (lambda: np.linalg.cholesky(-np.eye(2)), True),
        (lambda: math.exp(1e4), True),
        (lambda: len(None), False),
        (lambda: np.zeros(2)[3], False),
        (lambda: np.zeros(2) + np.zeros(3), False),
        (lambda: np.empty((1 << 44, 1 << 4)), False),
        (lambda: Path("/absent/file").read_text(), False),
    ],
)
def test_only_what_stems_from_the_numbers_is_a_result(fault, is_a_result):
    if is_a_result:
        found, why = attempt("table on grid3", fault)
        assert found is None
        assert why.startswith("table on grid3: ")
    else:
        with pytest.raises((TypeError, IndexError, ValueError, MemoryError, OSError)):
            attempt("table on grid3", fault)


@pytest.mark.parametrize("kind", ["rbf", "gaussian-process"])
def test_dense_methods_refuse_what_they_cannot_hold(kind, study, task, monkeypatch):
    monkeypatch.setattr(scattered, "MOST_SAMPLES", 26)
    with pytest.raises(NotApplicableError, match="grid3 has 27 samples, more than the 26"):
        fit(kind, task, grid_samples(study, task, 3))


# --- the rest of the house takes any of them -------------------------------------------------


def test_errors_are_measured_of_any_predictor(study, task, chain):
    predictor = fit("multilinear", task, grid_samples(study, task, 4))
    waypoints, cube = (
        track_paths(study.evaluation, task, predictor),
        cube_errors(study.evaluation, task, predictor),
    )
    table = summarise(waypoints, cube).set_index("region")
    assert list(table.index) == [*study.evaluation.paths, "cube"]
    assert set(table["seed"]) == {0}
    points = region_points(task.region, study.evaluation.cube_points)
    expected = errors_mm(task, predictor, points)
    assert table.loc["cube", "error_mean_mm"] == pytest.approx(expected.mean(), rel=1e-5)
    assert table.loc["cube", "error_max_mm"] == pytest.approx(expected.max(), rel=1e-5)


def test_single_wraps_any_function():
    predictor = Single(lambda x: x[:, :2] * 2)
    np.testing.assert_array_equal(predictor.predict([[1, 2, 3]]), [[[2, 4]]])
