"""Learning curves: the laws, what they foretell, and when they say nothing."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import curve_fit

from iksamples.answer.curves import NEVER, Needed, fit_published, fit_seeds
from iksamples.answer.statistics import draws, interquartile_mean, share_quantile
from iksamples.paper.table import paper_table


M = np.arange(2, 9)
N = M**3


def fitted(law, errors, rng, **settings):
    """A curve through errors (seeds, rungs) on the ladder of the paper."""
    rungs = np.shape(errors)[1]
    return fit_seeds(law, N[:rungs], M[:rungs], errors, draws(len(errors), rng, 400), **settings)


def scattered(curve, rng, seeds=20, spread=0.1):
    return curve * np.exp(spread * rng.normal(size=(seeds, len(curve))))


@pytest.fixture
def published():
    return paper_table().reset_index()


def test_the_papers_own_column_follows_the_grid_law_with_a_floor(published, rng):
    columns = ["n_samples", "samples_per_axis", "paper_error_mm", "paper_error_sd_mm"]
    curve = fit_published("grid", *(published[name] for name in columns), rng)
    for part, value, error in ((curve.floor_mm, 0.97, 0.11), (curve.scale_mm, 16.6, 1.5)):
        assert part.value == pytest.approx(value, abs=0.06 * value)
        assert (part.high - part.low) / 2 / 1.96 == pytest.approx(error, rel=0.06)
    assert curve.chi2_per_dof == pytest.approx(0.57, abs=0.005)
    assert curve.exponent == (2, 2, 2)
    # Fitted without them, 7 and 8 points per axis come out near the published 1.52 and 1.23.
    first = published[published["samples_per_axis"] <= 6]
    shorter = fit_published("grid", *(first[name] for name in columns), rng)
    np.testing.assert_allclose(shorter.at([343, 512], [7, 8]), [1.53, 1.42], atol=0.005)


def test_the_papers_column_does_not_settle_at_its_last_row(published, rng):
    columns = ["n_samples", "samples_per_axis", "paper_error_mm", "paper_error_sd_mm"]
    curve = fit_published("power", *(published[name] for name in columns), rng)
    expected, _ = curve_fit(
        lambda n, a, b, c: a + b * (n / 60) ** -c,
        published["n_samples"].to_numpy(float),
        published["paper_error_mm"],
        p0=(1, 2, 1),
        sigma=published["paper_error_sd_mm"],
    )
    assert curve.floor_mm.value == pytest.approx(expected[0], rel=1e-4)
    assert curve.exponent.value == pytest.approx(expected[2], rel=1e-4)
    assert curve.scale_mm.value == pytest.approx(expected[1] * 60 ** expected[2], rel=1e-3)


@settings(max_examples=40, deadline=None)
@given(st.floats(0, 5), st.floats(1, 100), st.floats(0.3, 2.5))
def test_an_exact_power_law_is_found_again(a, b, c):
    curve = fit_seeds("power", N, M, (a + b * N**-c)[None], np.zeros((0, 1), int))
    np.testing.assert_allclose(curve.at(N, M), a + b * N**-c, rtol=1e-4)
    assert curve.held_out.relative_error == pytest.approx(0, abs=1e-4)
    assert curve.unidentified == "too few seeds for intervals"


@given(st.floats(0, 5), st.floats(1, 100))
def test_an_exact_grid_law_is_found_again(a, b):
    curve = fit_seeds("grid", N, M, (a + b / (M - 1) ** 2)[None], np.zeros((0, 1), int))
    assert curve.floor_mm.value == pytest.approx(a, abs=1e-9)
    assert curve.scale_mm.value == pytest.approx(b)


def test_the_fit_agrees_with_scipys_in_relative_error(rng):
    errors = scattered(0.5 + 40 * N**-0.8, rng)
    observed = interquartile_mean(errors)
    expected, _ = curve_fit(
        lambda n, a, b, c: a + b * n**-c, N.astype(float), observed, (0.5, 40, 0.8), sigma=observed
    )
    curve = fitted("power", errors, rng)
    found = [curve.floor_mm.value, curve.scale_mm.value, curve.exponent.value]
    np.testing.assert_allclose(found, expected, rtol=1e-3)


def test_what_is_needed_lies_on_the_curve(rng):
    errors = scattered(0.5 + 40 * N**-0.8, rng)
    for law in ("power", "grid"):
        curve = fitted(law, errors, rng)
        tolerance = 0.9 * curve.observed_mm[-1]
        needed = curve.needed(tolerance, 0.95)
        at = curve.at(needed.n_samples, np.cbrt(needed.n_samples))
        assert at == pytest.approx(tolerance)
        assert N[-1] < needed.n_samples < needed.upper
        assert needed.reachable > 0.95


def test_below_the_floor_nothing_is_enough(rng):
    curve = fitted("power", scattered(2 + 100 * N**-1.1, rng, 40, 0.05), rng)
    assert curve.unidentified == ""
    needed = curve.needed(1.5, 0.95)
    assert needed == Needed(np.inf, np.inf, 0)
    low, high = curve.level_mm[1:]
    assert low < 2 < high
    assert curve.floor_mm.low < 2 < curve.floor_mm.high


def test_a_curve_that_takes_a_thousand_times_the_samples_never_gets_there(rng):
    curve = fitted("power", (10 * N**-0.1)[None], rng)
    assert curve.needed(10 * (NEVER * 512 * 0.99) ** -0.1, 0.95).n_samples < NEVER * 512
    assert np.isinf(curve.needed(10 * (NEVER * 512 * 1.01) ** -0.1, 0.95).n_samples)


def test_a_flat_or_rising_curve_is_not_identified(rng):
    for level in (np.full(7, 3.0), 3 + 0.1 * M):
        curve = fitted("power", scattered(level, rng, 20, 0.1), rng)
        assert "spans 0" in curve.unidentified
        assert np.isinf(curve.needed(0.1, 0.95).upper)


def test_an_undetermined_floor_is_said(rng):
    # Falling all along: nothing tells a small floor from none.
    curve = fitted("power", scattered(20 * N**-0.4, rng, 20, 0.2), rng)
    assert "floor" in curve.unidentified


def test_the_largest_rung_is_predicted_from_the_others(rng):
    errors = np.tile(1 + 30 * N**-0.7, (6, 1))
    errors[:, -1] *= 0.8
    held_out = fitted("power", errors, rng).held_out
    assert held_out.n_samples == 512
    assert held_out.observed_mm == pytest.approx(errors[0, -1])
    assert held_out.relative_error == pytest.approx(1 / 0.8 - 1, rel=1e-3)


def test_too_few_rungs_make_no_curve(rng):
    errors = np.tile(1 + 30 * N**-0.7, (6, 1))
    assert fitted("power", errors[:, :3], rng) is None
    assert fitted("power", errors[:, :4], rng).held_out is None
    assert fitted("power", errors[:, :5], rng).held_out is not None
    assert fitted("grid", errors[:, :2], rng) is None


def test_diverged_seeds_spoil_neither_the_fit_nor_its_interval(rng):
    errors = scattered(1 + 30 * N**-0.7, rng)
    errors[3, 4] = np.inf
    curve = fitted("power", errors, rng)
    assert curve.floor_mm.known
    assert curve.floor_mm.low <= 1 <= curve.floor_mm.high
    # A rung at which most seeds diverged is left out.
    errors[:15, 0] = np.inf
    assert fitted("power", errors, rng).n_samples[0] == 27


def test_the_quantile_of_the_seeds_can_be_fitted_as_well(rng):
    errors = scattered(1 + 30 * N**-0.7, rng)
    curve = fitted("power", errors, rng, summary=lambda e, axis: share_quantile(e, 0.8, axis))
    np.testing.assert_allclose(curve.observed_mm, np.sort(errors, axis=0)[15])


@pytest.mark.slow
def test_intervals_of_the_floor_hold_what_they_promise(rng):
    hits = 0
    for _ in range(150):
        curve = fitted("grid", scattered(1 + 20 / (M - 1) ** 2, rng, 20, 0.2), rng)
        # The law of the interquartile mean of a lognormal scatter: its median, within one per cent.
        hits += curve.floor_mm.low <= 1.005 <= curve.floor_mm.high
    assert 0.87 <= hits / 150 <= 0.99
