"""Certified means and shares against closed forms and dense points."""

from fractions import Fraction
from itertools import product
from math import factorial, prod

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
from scipy import integrate

from iksamples.certify.enclosure import pairs
from iksamples.certify.mean import (
    _mean_of_cells,
    _share_of_cells,
    _share_under_plane,
    certify_coverage,
    certify_mean,
)
from iksamples.certify.residual import Residual
from iksamples.errors import IksamplesError
from iksamples.region import Region


GANTRY = make_chain("PPP", np.eye(3), np.zeros((3, 3)), (0, 0, 0))
STILL = linear_network(np.zeros((3, 3)), [0.5, 0.5, 0.5])
CUBE = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))


def plain_errors(network, chain, points):
    d = min(points.shape[1], 3)
    reached = plain_tip(chain, plain_answer(network, 0, points))
    return np.linalg.norm(reached[:, :d] - points[:, :d], axis=1)


def test_mean_distance_to_the_middle_of_a_cube():
    """An arm that stays in the middle: the error's mean is a known integral."""
    exact, _ = integrate.tplquad(
        lambda x, y, z: np.sqrt(x * x + y * y + z * z), 0, 0.5, 0, 0.5, 0, 0.5, epsabs=1e-8
    )
    mean = certify_mean(STILL, 0, GANTRY, Region.box(*CUBE), rtol=0.002)
    assert mean.complete
    assert mean.lower_mm <= 8 * exact <= mean.upper_mm
    assert mean.upper_mm - mean.lower_mm <= 0.002 * (mean.upper_mm + mean.lower_mm) * 1.0001


@pytest.mark.parametrize("radius", [0.2, 0.4, 0.5])
def test_share_of_a_ball_in_a_cube(radius):
    coverage = certify_coverage(STILL, 0, GANTRY, Region.box(*CUBE), radius, atol=0.005)
    exact = 4 / 3 * np.pi * radius**3
    assert coverage.complete
    assert coverage.lower <= exact <= coverage.upper <= coverage.lower + 0.005


def test_bad_cells_are_bad_and_fill_what_is_bad(rng):
    coverage = certify_coverage(STILL, 0, GANTRY, Region.box(*CUBE), 0.4, mixed=0.1)
    assert coverage.complete
    assert coverage.mixed <= 0.1
    inside = rng.random((len(coverage.bad_lower_mm), 3))
    points = coverage.bad_lower_mm + inside * (coverage.bad_upper_mm - coverage.bad_lower_mm)
    assert np.linalg.norm(points - 0.5, axis=1).min() > 0.4
    nearest = np.clip(0.5, coverage.bad_lower_mm, coverage.bad_upper_mm)
    assert np.linalg.norm(nearest - 0.5, axis=1).min() > 0.4 - 1e-9
    volume = np.prod(coverage.bad_upper_mm - coverage.bad_lower_mm, axis=1).sum()
    assert volume <= 1 - coverage.lower
    assert volume >= 1 - coverage.upper - coverage.mixed


@pytest.mark.slow
@settings(max_examples=15, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    kinds=st.sampled_from(["RRR", "PRR", "RRRR"]),
    activation=st.sampled_from(["relu", "tanh"]),
    depth=st.integers(0, 2),
    d=st.integers(2, 3),
)
def test_means_and_shares_of_random_networks(seed, kinds, activation, depth, d):
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, kinds)
    lower, upper = np.full(d, -30.0), np.full(d, 30.0)
    stack = random_network(
        rng, (d, *rng.integers(2, 7, depth), len(kinds)), activation,
        spread=0.7, lower=lower, upper=upper,
    )  # fmt: skip
    errors = plain_errors(stack, chain, lower + 60 * rng.random((3000, d)))
    mean = certify_mean(stack, 0, chain, Region.box(lower, upper), rtol=0.02)
    assert mean.complete
    slack = 6 * errors.std() / np.sqrt(len(errors))
    assert mean.lower_mm - slack <= errors.mean() <= mean.upper_mm + slack
    tolerance = float(np.quantile(errors, 0.3))
    coverage = certify_coverage(stack, 0, chain, Region.box(lower, upper), tolerance, atol=0.03)
    assert coverage.complete
    slack = 6 * np.sqrt(0.3 * 0.7 / len(errors)) + 1 / len(errors)
    assert coverage.lower - slack <= 0.3 <= coverage.upper + slack


def test_the_same_error_everywhere_is_its_own_mean(rng):
    """A gantry that is off by the same everywhere: the squared length is known exactly."""
    for bias in np.float32(rng.uniform(-3, 3, (40, 3))):
        mean = certify_mean(linear_network(np.eye(3), bias), 0, GANTRY, Region.box(*CUBE))
        exact = sum(Fraction(float(b)) ** 2 for b in bias)
        assert Fraction(mean.lower_mm) ** 2 <= exact <= Fraction(mean.upper_mm) ** 2
        assert mean.upper_mm - mean.lower_mm < 1e-9


def made_up(centre, linear, quadratic, remainder=0.0):
    """A residual over one box that is a polynomial to within a remainder."""
    d = len(linear)
    return Residual(
        np.array([centre], float), np.array([linear], float), np.array([quadratic], float),
        np.zeros((1, 0, len(centre))), np.zeros((1, 2**d, 0)), np.zeros((1, 1, 0)), True,
        np.full((1, 2**d), remainder), np.full((1, 1), remainder),
        np.full(1, np.inf), np.ones((1, d)),
    )  # fmt: skip


def mean_size(centre, linear, quadratic, n=40):
    """The mean of the polynomial's norm, by Gauss's rule."""
    nodes, weights = np.polynomial.legendre.leggauss(n)
    d = len(linear)
    s = np.stack(np.meshgrid(*[nodes] * d, indexing="ij"), -1).reshape(-1, d)
    w = np.prod(np.stack(np.meshgrid(*[weights / 2] * d, indexing="ij"), -1).reshape(-1, d), 1)
    first, second = pairs(d)
    values = np.asarray(centre) + s @ np.asarray(linear)
    values = values + (s[:, first] * s[:, second]) @ np.asarray(quadratic)
    return float(w @ np.linalg.norm(values, axis=1))


@settings(max_examples=100, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), d=st.integers(1, 3), size=st.floats(0.01, 2))
def test_mean_of_a_cell(seed, d, size):
    rng = np.random.default_rng(seed)
    parts = (rng.normal(size=3), size * rng.normal(size=(d, 3)),
             size * rng.normal(size=(len(pairs(d)[0]), 3)))  # fmt: skip
    [low], [high] = _mean_of_cells(made_up(*parts))
    exact = mean_size(*parts)
    assert low - 2e-3 * size <= exact <= high + 2e-3 * size


@settings(max_examples=150, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    size=st.floats(0.05, 2),
    remainder=st.sampled_from([0.0, 0.1, 0.5]),
    part=st.floats(0.02, 0.98),
)
def test_share_of_a_cell(seed, size, remainder, part):
    """Against a fine row of positions, for an error that is off by the remainder either way."""
    rng = np.random.default_rng(seed)
    centre = 3.0 * rng.normal(size=3)
    linear, quadratic = size * rng.normal(size=(2, 1, 3))
    s = np.linspace(-1, 1, 20_001)[:, None]
    sizes = np.linalg.norm(centre + s * linear + s * s * quadratic, axis=1)
    tolerance = float(np.quantile(sizes, part))
    residual = made_up(centre, linear, quadratic, remainder)
    [low], [high] = _share_of_cells(residual, tolerance, 0.0)
    assert low <= np.mean(sizes + remainder <= tolerance) + 1e-3
    assert high >= np.mean(sizes - remainder <= tolerance) - 1e-3


@pytest.mark.parametrize("steepest", [(1, 1, 1, 0.5, 0.5), (1, 0.8, 0.6, 0.6), (1, 1, 1, 1, 1, 1)])
def test_share_under_a_plane_in_many_dimensions(steepest):
    """Against the exact volume, a sum over all corners in exact arithmetic."""
    slope = [Fraction(a).limit_denominator(10) for a in steepest]
    for room in np.linspace(-sum(steepest), sum(steepest), 25):
        exact = sum(
            (-1) ** sum(v)
            * max(Fraction(room) + sum((1 - 2 * b) * a for a, b in zip(slope, v, strict=True)), 0)
            ** len(slope)
            for v in product((0, 1), repeat=len(slope))
        ) / (factorial(len(slope)) * prod(2 * a for a in slope))
        low, high = (
            float(_share_under_plane(np.array([steepest]), np.array([room]), side)[0])
            for side in (-1.0, 1.0)
        )
        assert low <= float(exact) + 1e-12
        assert high >= float(exact) - 1e-12


def test_mean_of_a_cell_is_nearly_attained():
    """What varies is across the mean, by each kind of term in turn."""
    for linear, quadratic, centre in (
        ([[0, 3, 0], [0, 0, 0]], np.zeros((3, 3)), (20, 0, 0)),
        (np.zeros((2, 3)), [[0, 3, 0], [0, 0, 0], [0, 0, 0]], (20, -1, 0)),
        (np.zeros((2, 3)), [[0, 0, 0], [0, 0, 0], [0, 3, 0]], (20, 0, 0)),
    ):
        [low], [high] = _mean_of_cells(made_up(centre, linear, quadratic))
        exact = mean_size(centre, linear, quadratic)
        assert low <= exact <= high
        assert high - low < 0.03 * (exact - 20)


@settings(max_examples=200, deadline=None)
@given(
    slope=st.lists(st.floats(0, 1) | st.sampled_from([0.0, 1e-9]), min_size=1, max_size=5),
    room=st.floats(-3, 3),
)
def test_share_under_a_plane(slope, room):
    """Against a sum of uniform numbers on a fine grid of each."""
    d = len(slope)
    n = {1: 4001, 2: 401, 3: 61, 4: 21, 5: 13}[d]
    s = (2 * np.arange(n) + 1) / n - 1
    total = np.zeros(1)
    for a in slope:
        total = (total[:, None] + a * s).ravel()
    share = np.mean(total <= room)
    low, high = (
        float(_share_under_plane(np.array([slope]), np.array([room]), side)[0])
        for side in (-1.0, 1.0)
    )
    # Cells of the grid that the plane cuts are counted either way.
    cut = np.mean(np.abs(total - room) <= sum(slope) / n) if sum(slope) > 1e-6 else 1.0
    assert 0 <= low <= high <= 1
    assert low - cut - 1e-9 <= share <= high + cut + 1e-9
    if d <= 3 and max(slope) > 1e-6 and min(slope) > 2e-3 * max(slope):
        assert high - low < 1e-5


def test_cut_short_searches_still_enclose():
    chain = planar([40.0, 30.0])
    rng = np.random.default_rng(1)
    stack = random_network(rng, (2, 8, 2), "relu", lower=(20, 20), upper=(50, 50))
    errors = plain_errors(stack, chain, 20 + 30 * rng.random((20_000, 2)))
    mean = certify_mean(stack, 0, chain, Region.box((20, 20), (50, 50)), rtol=1e-9, max_boxes=100)
    assert not mean.complete
    assert mean.lower_mm < errors.mean() < mean.upper_mm
    tolerance = float(np.median(errors))
    coverage = certify_coverage(
        stack, 0, chain, Region.box((20, 20), (50, 50)), tolerance, atol=1e-9, max_boxes=100
    )
    assert not coverage.complete
    assert coverage.lower < 0.5 < coverage.upper


def test_a_length_that_is_close_enough_ends_the_search():
    """No cell is split once the bounds lie within the length, and they still enclose."""
    chain = planar([40.0, 30.0])
    rng = np.random.default_rng(1)
    stack = random_network(rng, (2, 8, 2), "relu", lower=(20, 20), upper=(50, 50))
    errors = plain_errors(stack, chain, 20 + 30 * rng.random((20_000, 2)))
    box = (20, 20), (50, 50)
    fine = certify_mean(stack, 0, chain, Region.box(*box), rtol=1e-3)
    rough = certify_mean(stack, 0, chain, Region.box(*box), rtol=1e-3, atol_mm=0.5)
    assert rough.complete
    assert 2e-3 * rough.upper_mm < rough.upper_mm - rough.lower_mm <= 1.0
    assert rough.lower_mm < errors.mean() < rough.upper_mm
    assert rough.boxes < fine.boxes / 4


@pytest.mark.parametrize("tolerance", [0.0, -1.0, np.nan, np.inf])
def test_a_tolerance_is_a_positive_length(tolerance):
    with pytest.raises(IksamplesError, match="positive"):
        certify_coverage(STILL, 0, GANTRY, Region.box(*CUBE), tolerance)
