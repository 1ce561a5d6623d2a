"""Methods other than the network: what they answer, and the certified look-up table."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.optimize import differential_evolution

from iksamples.arm.chain import SerialChain
from iksamples.certify.lookup import TableCells, certify_table
from iksamples.errors import IksamplesError
from iksamples.evaluation.errors import cube_errors, send, summarise, track_paths
from iksamples.methods import gaussian_process, rbf
from iksamples.methods import predictor as predictor_module
from iksamples.methods.predictor import NotApplicableError, Single
from iksamples.methods.registry import KINDS, fit
from iksamples.methods.tensor import tensor_grid
from iksamples.samples.record import grid_samples, region_points
from iksamples.study import MethodKind, parse_study
from iksamples.task import study_task


FROM_SAMPLES = [kind for kind, one in KINDS.items() if one.fit and one.needs_samples]
ON_GRIDS = ["multilinear", "cubic", "polynomial"]
EVERYWHERE = ["rbf", "gaussian-process"]


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


@pytest.mark.parametrize("kind", FROM_SAMPLES)
@pytest.mark.parametrize("m", [2, 3, 5])
def test_samples_are_hit_exactly_in_whatever_order_they_come(kind, m, study, task, rng):
    samples = grid_samples(study, task, m)
    order = rng.permutation(samples.n_samples)
    shuffled = replace(samples, x=samples.positions_mm[order], joints=samples.joints[order])
    answer = fit(kind, task, shuffled).predict(samples.positions_mm)[0]
    # A Gaussian process has a jitter of 1e-10 of the variance on its diagonal.
    tolerance = 1e-6 if kind == "gaussian-process" else 1e-12
    np.testing.assert_allclose(answer, samples.joints, rtol=0, atol=tolerance)


@pytest.mark.parametrize("kind", FROM_SAMPLES)
def test_joint_values_shift_and_scale_with_the_samples(kind, study, task, rng):
    samples = grid_samples(study, task, 3)
    other = replace(samples, joints=samples.joints * 50 - 7)  # as a prismatic joint's, in mm
    points = uniform(study, rng, 20)
    answer, plain = (fit(kind, task, s).predict(points) for s in (other, samples))
    np.testing.assert_allclose(answer, plain * 50 - 7, rtol=0, atol=1e-4)


# --- what is known about each ----------------------------------------------------------------


def test_analytic_is_exact(study, task, chain, region):
    predictor = fit("analytic", task, grid_samples(study, task, 2))
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
        vander = np.polynomial.chebyshev.chebvander3d(*scaled(samples.positions_mm), degree)
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
    axis = np.unique(samples.positions_mm[:, 0]), np.unique(samples.positions_mm[:, 2])
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
    kernel = gaussian_process.regressor(samples).kernel_
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
    monkeypatch.setattr(gaussian_process, "MOST_TO_TUNE", 40)
    samples = grid_samples(study, task, 5)
    answer = fit("gaussian-process", task, samples).predict(samples.positions_mm)[0]
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
    twice = whole.positions_mm.copy()
    twice[1] = twice[0]
    with pytest.raises(NotApplicableError, match="27 samples on 3 x 3 x 3 coordinates"):
        fit(kind, task, with_points(whole, twice, whole.joints))


def test_rounded_coordinates_are_one(study, task, rng):
    samples = grid_samples(study, task, 4)
    rounded = samples.positions_mm + rng.uniform(-1e-9, 1e-9, (64, 3))
    grid = tensor_grid(with_points(samples, rounded, samples.joints), "cubic")
    np.testing.assert_array_equal(grid.joints, samples.joints.reshape(4, 4, 4, 3))
    for axis in grid.axes:
        assert len(axis) == 4


@pytest.mark.parametrize("kind", EVERYWHERE)
def test_methods_for_scattered_samples_take_masked_grids(kind, masked):
    study, samples = masked
    task = study_task(study)
    predictor = fit(kind, study_task(study), samples)
    np.testing.assert_allclose(
        predictor.predict(samples.positions_mm)[0], samples.joints, atol=1e-6
    )
    assert errors_mm(task, predictor, region_points(task.region, 1024)).mean() < 3


def test_rbf_names_coinciding_and_flat_samples(study, task):
    samples = grid_samples(study, task, 3)
    flat = samples.positions_mm.copy()
    flat[:, 2] = flat[:, 0]
    with pytest.raises(IksamplesError, match="rbf: cannot interpolate mine"):
        fit("rbf", task, with_points(samples, flat, samples.joints))


@pytest.mark.parametrize(("kind", "module"), [("rbf", rbf), ("gaussian-process", gaussian_process)])
def test_dense_methods_refuse_what_they_cannot_hold(kind, module, study, task, monkeypatch):
    monkeypatch.setattr(module, "MOST_SAMPLES", 26)
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


# Measured beforehand by an independent program on many random points.
@pytest.mark.parametrize(
    ("m", "known"),
    [(2, 14.9), (3, 4.52), (4, 2.31), (5, 1.41), (6, 0.95), (7, 0.69), (8, 0.52)],
)
def test_worst_case_of_the_table_is_the_known_one(m, known, study, task, chain):
    certificate = certify_table(study, chain, grid_samples(study, task, m), rtol=1e-2)
    assert certificate.complete
    assert certificate.cells == (m - 1) ** 3
    assert certificate.upper_mm <= 1.0101 * certificate.lower_mm
    assert certificate.lower_mm == pytest.approx(known, rel=0.012)


def test_worst_case_of_the_table_agrees_with_a_global_optimiser(study, task):
    samples = grid_samples(study, task, 3)
    predictor = fit("multilinear", task, samples)
    box = list(zip(study.workspace.lower_mm, study.workspace.upper_mm, strict=True))

    def gain(x):
        return -errors_mm(task, predictor, x.T.reshape(-1, 3))

    found = differential_evolution(
        gain, box, vectorized=True, updating="deferred", popsize=60, rng=1, tol=1e-10
    )
    certificate = certify_table(study, task.arm, samples, rtol=1e-4)
    assert certificate.lower_mm * (1 - 1e-4) <= -found.fun <= certificate.upper_mm
    at = errors_mm(task, predictor, certificate.argmax_mm[None])[0]
    assert at >= certificate.lower_mm
    assert at == pytest.approx(certificate.lower_mm, abs=1e-9)


@pytest.mark.parametrize("spread", [0.5, 0.1])
def test_no_table_exceeds_its_bounds(spread, study, task, chain, rng):
    """Tables of chance, on uneven grids within, at and beyond the workspace's walls."""
    ends = [(20, 80), (30, 75), (-10, 65)]
    for counts in ([2, 2, 2], [3, 2, 4], [2, 4, 3]):
        axes = [
            np.linspace(*end, n) + np.pad(rng.uniform(-6, 6, n - 2), 1)
            for end, n in zip(ends, counts, strict=True)
        ]

        def random(x):
            exact = task.reach(np.clip(x, 20, 60)).joints
            return exact + spread * rng.normal(size=(len(x), 3))

        samples = on_axes(study, task, *axes, function=random)
        cells = TableCells.of(study, chain, samples)
        predictor = fit("multilinear", task, samples)
        which = rng.integers(len(cells.low_mm), size=200)
        radius = 0.5 * rng.random((200, 3)) ** 3
        centre = radius + (1 - 2 * radius) * rng.random((200, 3))
        upper, corner, _ = cells.upper_bounds_mm(which, centre, radius)
        for _ in range(40):
            shares = centre + radius * rng.uniform(-1, 1, (200, 3))
            points = cells.position_mm(which, shares)
            error = errors_mm(task, predictor, points)
            np.testing.assert_allclose(cells.errors_mm(which, shares), error, atol=1e-9)
            assert (error <= upper).all()
        assert (cells.errors_mm(which, corner) <= upper).all()

        certificate = certify_table(study, chain, samples, rtol=0.05)
        sampled = errors_mm(task, predictor, uniform(study, rng, 20_000)).max()
        assert sampled <= certificate.upper_mm
        assert certificate.upper_mm <= 1.06 * certificate.lower_mm
        at = errors_mm(task, predictor, certificate.argmax_mm[None])[0]
        assert at == pytest.approx(certificate.lower_mm, abs=1e-7)


@pytest.mark.parametrize("offset_mm", [0, 6])
def test_worst_case_of_a_gantry_is_at_a_sample(offset_mm, study, task, rng):
    """A gantry's error is multilinear in each cell as the table is: largest at a corner."""
    gantry = SerialChain(
        ("x", "y", "z"),
        ("prismatic",) * 3,
        np.eye(3),
        np.zeros((3, 3)),
        np.zeros(3),
        np.zeros(3),
        np.full(3, 100.0),
    )
    for m in (2, 3):
        samples = grid_samples(study, task, m)
        wrong = samples.positions_mm + offset_mm + rng.normal(size=samples.positions_mm.shape)
        samples = replace(samples, joints=wrong)
        cells = TableCells.of(study, gantry, samples)
        half = np.full(cells.low_mm.shape, 0.5)
        upper, _, _ = cells.upper_bounds_mm(np.arange(len(half)), half, half)
        for shares in np.ndindex(2, 2, 2):
            every = np.tile(np.array(shares, float), (len(half), 1))
            assert (cells.errors_mm(np.arange(len(half)), every) <= upper).all()
        worst = np.linalg.norm(wrong - samples.positions_mm, axis=1).max()
        certificate = certify_table(study, gantry, samples, rtol=1e-6)
        assert certificate.lower_mm == pytest.approx(worst, abs=1e-9)
        assert worst <= certificate.upper_mm <= worst * (1 + 1e-6) + 1e-9


def test_cells_bounds_close_on_the_error_as_the_cube_of_the_box(study, task, chain):
    """The enclosure is exact to second order, so that halving a box takes three quarters off."""
    cells = TableCells.of(study, chain, grid_samples(study, task, 4))
    every = np.arange(len(cells.low_mm))
    centre = np.full((len(every), 3), 0.4)
    excess = []
    for radius in (0.1, 0.05, 0.025):
        box = np.full_like(centre, radius)
        upper, _, _ = cells.upper_bounds_mm(every, centre, box)
        grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 9)] * 3), axis=-1).reshape(-1, 3)
        points = (centre[:, None] + radius * grid).reshape(-1, 3)
        values = cells.errors_mm(np.repeat(every, len(grid)), points).reshape(len(every), -1)
        excess.append(np.median(upper - values.max(axis=1)))
    assert excess[1] < excess[0] / 3
    assert excess[2] < excess[1] / 3


def test_bounds_hold_where_the_error_is_largest_inside_a_box(study, task, chain):
    """There the corners' errors are smaller to second order, the remainder is of third."""
    samples = grid_samples(study, task, 2)
    cells = TableCells.of(study, chain, samples)
    peak = certify_table(study, chain, samples, rtol=1e-6).argmax_mm
    centre = (peak - cells.low_mm) / cells.size_mm
    error = cells.errors_mm(np.zeros(1, int), centre)[0]
    for radius in (0.1, 0.03, 0.01, 0.003):
        box = np.full((1, 3), radius)
        upper, corner, _ = cells.upper_bounds_mm(np.zeros(1, int), centre, box)
        assert cells.errors_mm(np.zeros(1, int), corner)[0] < error
        assert error <= upper[0]


def test_an_unfinished_search_still_bounds(study, task, chain):
    samples = grid_samples(study, task, 2)
    certificate = certify_table(study, chain, samples, rtol=1e-6, max_boxes=20)
    assert not certificate.complete
    assert certificate.upper_mm > 14.9


def test_a_table_without_a_worst_case_is_refused(study, task, chain, masked):
    samples = grid_samples(study, task, 2)
    joints = samples.joints.copy()
    joints[3, 1] = np.nan
    with pytest.raises(IksamplesError, match="grid2: a joint value of the table is not finite"):
        certify_table(study, chain, replace(samples, joints=joints))
    wide, scattered = masked
    with pytest.raises(NotApplicableError):
        certify_table(wide, chain, scattered)


def test_single_wraps_any_function():
    predictor = Single(lambda x: x[:, :2] * 2)
    np.testing.assert_array_equal(predictor.predict([[1, 2, 3]]), [[[2, 4]]])
