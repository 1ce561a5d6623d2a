"""Learning curves: the laws, how they are fitted, and when they are not believed."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import curve_fit, nnls

from iksamples.answer.collect import Variant
from iksamples.answer.curves import fit_power, fit_published, fit_seeds
from iksamples.answer.extrapolate import (
    MARGIN,
    MOST,
    extrapolate,
    forecast,
    needed_samples,
    shape,
    untrusted,
)
from iksamples.paper.equations import paper_table
from iksamples.stats import Interval, draws, share_quantile
from iksamples.study import parse_study


M = np.arange(2, 9)
N = (M**3).astype(float)
TABLE = Variant("table", "grid")
STUDY = parse_study(
    {
        "name": "s",
        "methods": {
            "table": {"kind": "multilinear"},
            "converged": {"training": {"optimizer": "levenberg-marquardt"}},
        },
    }
)


STEEPER = np.append(0, np.array([0.3, 0.38, 0.48, 0.6, 0.75, 0.9]) * np.diff(np.log(N)))
"""Falls of the logarithm of an error, evenly steeper from size to size."""


def scattered(curve, rng, seeds=20, spread=0.1):
    return curve * np.exp(spread * rng.normal(size=(seeds, len(curve))))


def resampled(errors, rng):
    """The curve of what four trainings in five keep to, and of resampled seeds."""
    again = np.concatenate([np.arange(len(errors))[None], draws(len(errors), rng, 200)])
    return share_quantile(errors[again], 0.8, axis=1)


def say(curve, tolerance_mm, n=N):
    """What is said of a curve without chance."""
    return extrapolate(STUDY, TABLE, forecast(STUDY, TABLE, n, curve[None]), tolerance_mm)


class TestFits:
    def test_the_papers_own_column_follows_the_grid_law_with_a_floor(self, rng):
        published = paper_table().reset_index()
        columns = ["samples_per_axis", "paper_error_mm", "paper_error_sd_mm"]
        curve = fit_published(*(published[name] for name in columns), rng)
        for part, value, error in ((curve.floor_mm, 0.97, 0.11), (curve.scale_mm, 16.6, 1.5)):
            assert part.value == pytest.approx(value, abs=0.06 * value)
            assert (part.high - part.low) / 2 / 1.96 == pytest.approx(error, rel=0.06)
        # Fitted without them, 7 and 8 points per axis come out near the published 1.52 and 1.23.
        first = published[published["samples_per_axis"] <= 6]
        shorter = fit_published(*(first[name] for name in columns), rng)
        np.testing.assert_allclose(shorter.at([7, 8]), [1.53, 1.42], atol=0.005)

    @given(st.floats(0, 5), st.floats(1, 100))
    def test_an_exact_grid_law_is_found_again(self, a, b):
        curve = fit_seeds(M, (a + b / (M - 1) ** 2)[None], np.zeros((0, 1), int))
        assert curve.floor_mm.value == pytest.approx(a, abs=1e-9)
        assert curve.scale_mm.value == pytest.approx(b)
        assert not curve.floor_mm.known

    def test_diverged_seeds_spoil_neither_the_fit_nor_its_interval(self, rng):
        errors = scattered(1 + 20 / (M - 1) ** 2, rng)
        errors[3, 4] = np.inf
        curve = fit_seeds(M, errors, draws(20, rng, 400))
        assert curve.floor_mm.low <= 1 <= curve.floor_mm.high
        errors[:15, 0] = np.inf  # a size at which most seeds diverged is left out
        assert fit_seeds(M, errors, draws(20, rng, 400)).points_per_axis[0] == 3
        assert fit_seeds(M[:2], errors[:, :2], draws(20, rng, 400)) is None

    @pytest.mark.slow
    def test_intervals_of_the_floor_hold_what_they_promise(self, rng):
        hits = 0
        for _ in range(150):
            errors = scattered(1 + 20 / (M - 1) ** 2, rng, 20, 0.2)
            floor = fit_seeds(M, errors, draws(20, rng, 400)).floor_mm
            # The interquartile mean of a lognormal scatter: its median, within one per cent.
            hits += floor.low <= 1.005 <= floor.high
        assert 0.87 <= hits / 150 <= 0.99

    def test_the_power_law_agrees_with_scipys_in_relative_error(self, rng):
        errors = scattered(0.5 + 40 * N**-0.8, rng)
        fits = fit_power(N, errors)
        for error, (a, b, c) in zip(errors, fits, strict=True):
            design = np.stack([1 / error, N**-c / error], axis=1)
            expected, _ = nnls(design, np.ones(len(N)))
            np.testing.assert_allclose([a, b], expected, rtol=1e-6, atol=1e-9)
            best, _ = curve_fit(
                lambda n, a, b, c: a + b * n**-c, N, error, (a, b, c), sigma=error,
                bounds=([0, 0, 0.02], [np.inf, np.inf, 4]),
            )  # fmt: skip
            assert abs(best[2] - c) <= 0.011  # exponents are tried in steps of 0.02

    @settings(max_examples=30)
    @given(st.floats(0.1, 100), st.sampled_from([0.3, 0.66, 1.4]))
    def test_without_a_floor_it_is_a_line_in_logarithms(self, b, c):
        ((a, found, exponent),) = fit_power(N, (b * N**-c)[None], floor=False)
        assert (a, exponent) == (0, pytest.approx(c))
        assert found == pytest.approx(b)


class TestBelief:
    @settings(max_examples=40)
    @given(st.floats(0.3, 1.5), st.floats(0.55, 0.95))
    def test_a_pure_power_law_is_extrapolated_to_where_it_goes(self, c, share):
        curve = 20 * N**-c
        n = N[-1] * share ** (-1 / c)
        said = say(curve, share * curve[-1])
        if said.n_samples is None:
            assert MARGIN * n > 0.9 * MOST * N[-1]  # too far
        else:
            assert said.needed.low <= n <= said.needed.high <= said.n_samples
            assert round(said.n_samples ** (1 / 3)) ** 3 == said.n_samples

    def test_a_floor_near_the_tolerance_is_not_extrapolated(self):
        for tolerance in (0.9, 1.001):
            assert "levelling off" in say(1 + 30 * N**-0.6, tolerance).reason

    @pytest.mark.parametrize(
        ("curve", "reason"),
        [
            (3 + 0 * N, "does not fall"),
            (np.array([9, 5, 3, 2, 1.5, 1.1, 1.3]), "does not fall"),
            (np.array([9, 5, 3, 2, 1.5, 1.4, 1.39]), "levelled off"),
            (np.array([9, 8, 7, 6.2, 5.5, 5, 2]), "falls unevenly"),
            (9 * np.exp(-np.cumsum(STEEPER)), "its learning curve is wrong at"),
            (np.array([9, 5, 3, 2, 1.5, 1.1, np.inf]), "failed"),
            (0 * N, "no error at all"),
        ],
    )
    def test_ill_behaved_curves_are_refused_with_the_reason(self, curve, reason):
        said = say(curve, 0.5)
        assert (said.n_samples, said.needed) == (None, None)
        assert reason in said.reason
        assert said.record_next == 10**3  # the first grid of at least 1.5 x 512

    def test_four_sizes_are_no_learning_curve(self):
        assert "fewer than 5 sizes" in untrusted(N[:4], (20 / N[:4])[None])
        assert not untrusted(N[:5], (20 / N[:5])[None])

    def test_some_variants_are_never_extrapolated(self, rng):
        curves = resampled(scattered(20 * N**-0.7, rng, spread=0.02), rng)
        known = {
            name: forecast(STUDY, Variant(name, design), N, curves).reason
            for name, design in (("network", "grid"), ("converged", "grid"), ("table", "sobol"))
        }
        assert known["network"] == ""
        assert "trained to convergence" in known["converged"]
        assert "scattered samples" in known["table"]
        single = forecast(STUDY, Variant("network", "grid"), N, curves[:1])
        assert "fewer than 5 trainings" in single.reason

    def test_scatter_of_the_seeds_widens_the_interval(self, rng):
        widths = []
        for spread in (0.005, 0.03):
            curves = resampled(scattered(20 * N**-0.7, rng, spread=spread), rng)
            known = forecast(STUDY, Variant("network", "grid"), N, curves)
            needed = needed_samples(known, 0.9 * curves[0, -1])
            assert isinstance(needed, Interval)
            widths.append(needed.high / needed.low)
        assert widths[1] > widths[0] > 1.25

    def test_shapes(self):
        assert shape(N, 20 / N) == shape(N, 3 + 0 * N)
        convex, steep, rising = (
            shape(N, curve) for curve in (20 / N, 600 - N, np.array([9, 5, 3, 2, 1.5, 1.1, 1.3]))
        )
        assert (convex.monotone, convex.convex) == (True, True)
        assert (steep.monotone, rising.monotone) == (True, False)
        assert not shape(N[:4], np.array([9, 8, 7, 1.0])).convex
        assert shape(N[:2], np.array([9, 8.0])) is None
