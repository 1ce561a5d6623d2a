"""Lipschitz constants, covering radii and the corrected analytic bounds."""

import numpy as np
import pytest
from certificate_cases import (
    linear_network,
    make_chain,
    plain_answer,
    plain_tip,
    planar,
    random_chain,
    random_network,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from iksamples.certify.analytic import (
    interpolation_on_grid,
    triangle_on_grid,
    triangle_on_samples,
)
from iksamples.certify.dispersion import cone_envelope, covering_radius
from iksamples.certify.lipschitz import (
    _largest_square,
    certify_lipschitz,
    certify_slope,
)
from iksamples.certify.search import certify_sup
from iksamples.errors import IksamplesError
from iksamples.network import StackedMLP
from iksamples.samples.designs import full_grid


GANTRY = make_chain("PPP", np.eye(3), np.zeros((3, 3)), (0, 0, 0))
LOWER, UPPER = np.full(3, 20.0), np.full(3, 80.0)


def two_layers(first, bias, second, activation="relu"):
    """One hidden layer, no output bias, nothing normalised."""
    first, second = np.float32(first), np.float32(second)
    return StackedMLP(
        (first[None], second[None]),
        (np.float32(bias)[None], np.zeros((1, second.shape[1]), np.float32)),
        activation,
        np.zeros(len(first)),
        np.ones(len(first)),
        (0,),
    )


@settings(max_examples=100, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), rows=st.integers(1, 6), columns=st.integers(1, 3))
def test_spectral_norms_in_closed_form(seed, rows, columns):
    rng = np.random.default_rng(seed)
    matrices = rng.normal(size=(5, rows, columns)) * 10.0 ** rng.integers(-6, 6)
    matrices[0] = 0
    matrices[1, :, 0] = matrices[1, :, -1]
    expected = np.linalg.norm(matrices, ord=2, axis=(1, 2))
    largest = np.sqrt(np.maximum(_largest_square(matrices), 0))
    np.testing.assert_allclose(largest, expected, rtol=1e-7, atol=1e-150)


def test_lipschitz_constant_of_a_linear_answer(rng):
    matrix = rng.normal(size=(3, 3)).astype(np.float32)
    stack = linear_network(matrix, np.zeros(3))
    for minus, expected in ((True, matrix - np.eye(3)), (False, matrix)):
        [found] = certify_lipschitz(stack, GANTRY, LOWER, UPPER, minus_identity=minus)
        assert found.complete
        exact = np.linalg.norm(expected, 2)
        assert found.lower <= exact * (1 + 1e-6)
        assert exact <= found.upper <= 1.011 * exact


def test_lipschitz_constant_across_a_kink():
    """|x| has slope one on either side; an average of the slopes would say zero."""
    first = np.zeros((3, 2))
    first[0] = [1, -1]
    second = np.zeros((2, 3))
    second[:, 0] = [1, 1]
    stack = two_layers(first, [-50, 50], second)  # |x - 50|
    [found] = certify_lipschitz(stack, GANTRY, LOWER, UPPER, minus_identity=False)
    assert found.complete
    assert found.lower <= 1 <= found.upper <= 1.011
    [slope] = certify_slope(stack, LOWER, UPPER)
    assert slope.lower == pytest.approx(1)
    assert slope.upper == pytest.approx(1)


def test_kinks_that_never_meet_are_told_apart():
    """Two nearly coincident kinks: between them the slope is 1, and nowhere 1 + 4."""
    gap = 2.0**-9
    first = np.zeros((3, 2))
    first[0] = [-1, 1]
    second = np.zeros((2, 3))
    second[:, 0] = [-1, 4]
    # Falling before 50 with slope 1, rising with slope 4 from 50 + gap on.
    stack = two_layers(first, [50, -50 - gap], second)
    [found] = certify_lipschitz(stack, GANTRY, LOWER, UPPER, minus_identity=False)
    assert found.complete
    assert found.upper <= 4.05
    assert found.boxes < 3000


@settings(max_examples=15, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    kinds=st.sampled_from(["RRR", "PRR", "RRPR"]),
    activation=st.sampled_from(["relu", "tanh"]),
    depth=st.integers(1, 2),
)
def test_lipschitz_constants_of_random_networks(seed, kinds, activation, depth):
    """No pair of points is steeper, and the lower bound is taken where it is said."""
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, kinds)
    stack = random_network(
        rng, (3, *rng.integers(2, 7, depth), len(kinds)), activation,
        spread=0.7, lower=LOWER, upper=UPPER,
    )  # fmt: skip
    [found] = certify_lipschitz(stack, chain, LOWER, UPPER, rtol=0.1, max_boxes=20_000)

    def missing(points):
        return plain_tip(chain, plain_answer(stack, 0, points)) - points

    a = rng.uniform(LOWER, UPPER, (1000, 3))
    b = np.clip(a + rng.normal(size=a.shape) * 10.0 ** rng.uniform(-3, 1, (1000, 1)), LOWER, UPPER)
    ratio = np.linalg.norm(missing(a) - missing(b), axis=1) / np.linalg.norm(a - b, axis=1)
    assert ratio.max() <= found.upper * (1 + 1e-6)
    step = 1e-7 * np.eye(3)
    at = found.argmax_mm
    slope = (missing(at + step) - missing(at - step)) / 2e-7
    assert np.linalg.norm(slope, 2) >= found.lower * (1 - 1e-3)


@pytest.mark.parametrize("activation", ["relu", "tanh"])
def test_network_slopes_against_dense_points(rng, activation):
    stack = random_network(rng, (3, 8, 6, 3), activation, n=3, lower=LOWER, upper=UPPER)
    found = certify_slope(stack, LOWER, UPPER, rtol=1e-6 if activation == "relu" else 0.01)
    points = rng.uniform(LOWER, UPPER, (20_000, 3))
    for row, supremum in enumerate(found):
        step = 1e-4
        columns = [
            (plain_answer(stack, row, points + d) - plain_answer(stack, row, points - d))
            / (2 * step)
            for d in step * np.eye(3)
        ]
        sums = np.abs(np.stack(columns, axis=-1) * stack.scale_mm).sum(axis=-1).max(axis=-1)
        assert supremum.complete
        assert sums.max() <= supremum.upper * (1 + 1e-6)
        assert sums.max() >= 0.9 * supremum.lower


@pytest.mark.parametrize("m", [2, 3, 4, 6])
def test_covering_radius_of_a_grid_is_half_a_diagonal(m):
    grid = full_grid((0, 0, 0), (60, 60, 60), m)
    found = covering_radius(grid, (0, 0, 0), (60, 60, 60))
    exact = np.sqrt(3) / 2 * 60 / (m - 1)
    assert found.complete
    assert found.lower <= exact * (1 + 1e-9)
    assert exact <= found.upper <= 1.0101 * exact


@pytest.mark.parametrize("d", [1, 2, 3, 4])
def test_covering_radius_of_scattered_samples(rng, d):
    samples = rng.random((40, d))
    found = covering_radius(samples, np.zeros(d), np.ones(d))
    points = rng.random((20_000, d))
    nearest = np.linalg.norm(points[:, None] - samples, axis=2).min(axis=1)
    assert found.complete
    assert nearest.max() <= found.upper
    taken = np.linalg.norm(found.argmax_mm - samples, axis=1).min()
    assert taken == pytest.approx(found.lower)
    assert nearest.max() >= 0.8 * found.lower


def test_cones_over_samples(rng):
    samples, heights = rng.random((30, 3)), rng.random(30)
    found = cone_envelope(samples, heights, 1.5, np.zeros(3), np.ones(3))
    points = rng.random((20_000, 3))
    cones = heights + 1.5 * np.linalg.norm(points[:, None] - samples, axis=2)
    assert found.complete
    assert 0.8 * found.lower <= cones.min(axis=1).max() <= found.upper
    flat = cone_envelope(samples, heights, 0.0, np.zeros(3), np.ones(3))
    assert flat.upper == pytest.approx(heights.min())


def test_samples_that_are_none():
    for samples in (np.zeros((0, 3)), np.zeros(3), np.full((2, 3), np.nan)):
        with pytest.raises(IksamplesError, match="samples"):
            covering_radius(samples, np.zeros(3), np.ones(3))
    with pytest.raises(IksamplesError, match="height"):
        cone_envelope(np.zeros((2, 3)), np.zeros(3), 1.0, np.zeros(3), np.ones(3))
    with pytest.raises(IksamplesError, match="slope"):
        cone_envelope(np.zeros((2, 3)), np.zeros(2), -1.0, np.zeros(3), np.ones(3))


@pytest.mark.parametrize("activation", ["relu", "tanh"])
@pytest.mark.parametrize("m", [2, 4])
def test_analytic_bounds_hold_in_the_order_they_should(chain, rng, activation, m):
    lower, upper = np.array([20.0, 20.0, 0.0]), np.array([80.0, 80.0, 60.0])
    stack = random_network(rng, (3, 10, 3), activation, spread=0.5, lower=lower, upper=upper)
    axes = [np.linspace(a, b, m) for a, b in zip(lower, upper, strict=True)]
    true = certify_sup(stack, 0, chain, lower, upper)
    inter = interpolation_on_grid(stack, 0, chain, axes)
    triangle = triangle_on_grid(stack, 0, chain, axes)
    nodes = full_grid(lower, upper, m)
    anywhere = triangle_on_samples(stack, 0, chain, nodes, lower, upper)
    assert inter.complete
    for bound in (inter, triangle, anywhere):
        assert bound.bound_mm >= true.lower_mm
    errors = np.linalg.norm(plain_tip(chain, plain_answer(stack, 0, nodes)) - nodes, axis=1)
    for bound in (inter, triangle, anywhere):
        assert bound.training_mm == pytest.approx(errors.max(), rel=1e-6)
    assert inter.bound_mm <= (inter.training_mm + inter.remainder_mm) * (1 + 1e-9)
    assert triangle.covering_mm == pytest.approx(np.sqrt(3) / 2 * 60 / (m - 1))
    assert (
        triangle.bound_mm <= triangle.training_mm + triangle.lipschitz * triangle.covering_mm + 1e-6
    )
    assert anywhere.bound_mm <= (anywhere.training_mm + anywhere.lipschitz * anywhere.covering_mm)


def test_the_interpolation_remainder_is_that_of_the_map(rng):
    """Against dense differences between the map and its interpolation, cell by cell."""
    chain = planar([40.0, 30.0])
    stack = random_network(rng, (2, 6, 2), "tanh", lower=(20, 20), upper=(50, 50))
    axes = [np.array([20.0, 32.0, 50.0]), np.array([20.0, 41.0, 50.0])]

    def reached(points):
        return plain_tip(chain, plain_answer(stack, 0, points))[:, :2]

    largest, bounds = [], []
    for i in range(2):
        for j in range(2):
            low = np.array([axes[0][i], axes[1][j]])
            high = np.array([axes[0][i + 1], axes[1][j + 1]])
            s = rng.random((4000, 2))
            corners = np.array([[0, 0], [0, 1], [1, 0], [1, 1]])
            weights = np.prod(np.where(corners, s[:, None], 1 - s[:, None]), axis=2)
            inter = weights @ reached(low + corners * (high - low))
            apart = np.linalg.norm(reached(low + s * (high - low)) - inter, axis=1)
            errors = np.linalg.norm(
                reached(low + corners * (high - low)) - (low + corners * (high - low)), axis=1
            )
            largest.append(apart.max())
            bounds.append(errors.max() + apart.max())
    found = interpolation_on_grid(stack, 0, chain, axes)
    assert found.complete
    assert max(largest) <= found.remainder_mm <= 1.03 * max(largest)
    assert max(bounds) <= found.bound_mm <= 1.03 * max(bounds)


def test_the_interpolation_form_of_a_linear_answer_is_its_training_error():
    stack = linear_network([[1.1, 0, 0], [0, 0.9, 0.1], [0, 0, 1]], [1, 2, 3])
    axes = [np.linspace(0, 10, 3)] * 3
    found = interpolation_on_grid(stack, 0, GANTRY, axes)
    assert found.remainder_mm < 1e-6
    assert found.bound_mm == pytest.approx(found.training_mm, abs=1e-6)


def test_grids_and_samples_that_do_not_fit(rng):
    stack = linear_network(np.eye(3), np.zeros(3))
    for axes in ([], [[0.0]] * 3, [[0.0, 0.0]] * 3, [[1.0, 0.0]] * 3):
        with pytest.raises(IksamplesError, match="ascending"):
            triangle_on_grid(stack, 0, GANTRY, axes)
    with pytest.raises(IksamplesError, match="outside"):
        triangle_on_samples(stack, 0, GANTRY, [[2.0, 0, 0]], (0, 0, 0), (1, 1, 1))
