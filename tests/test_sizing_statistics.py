"""Shares of seeds, and comparisons of methods over the same seeds."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binom, binomtest

from iksamples.errors import IksamplesError
from iksamples.stats import (
    best_of_share,
    compare,
    draws,
    interquartile_mean,
    interval,
    met_needed,
    seeds_needed,
    share_interval,
    share_lower,
    share_quantile,
    single_share,
)


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 200).flatmap(lambda n: st.tuples(st.integers(1, n), st.just(n))))
def test_lower_end_is_the_share_at_which_so_many_successes_become_rare(counts):
    met, n = counts
    for confidence in (0.8, 0.95, 0.99):
        lower = share_lower(met, n, confidence)
        assert binom.sf(met - 1, n, lower) == pytest.approx(1 - confidence, rel=1e-6)
        theirs = binomtest(met, n, alternative="greater").proportion_ci(confidence, "exact")
        assert lower == pytest.approx(theirs.low, rel=1e-6)


def test_lower_end_at_the_ends():
    assert share_lower(0, 20, 0.95) == 0
    assert share_lower(0, 0, 0.95) == 0
    assert share_lower(20, 20, 0.95) == pytest.approx(0.05 ** (1 / 20))


def test_two_sided_interval_leaves_a_fortieth_at_either_end():
    value, low, high = share_interval(17, 20)
    assert value == 0.85
    assert binom.sf(16, 20, low) == pytest.approx(0.025)
    assert binom.cdf(17, 20, high) == pytest.approx(0.025)


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 60), st.floats(0.05, 0.95), st.floats(0.55, 0.99))
def test_fewest_successes_are_the_first_whose_lower_end_reaches_the_share(n, share, confidence):
    reach = [k for k in range(n + 1) if share_lower(k, n, confidence) >= share]
    assert met_needed(n, share, confidence) == (reach[0] if reach else None)


@pytest.mark.parametrize(("failures", "expected"), [(0, 14), (1, 22), (2, 30)])
def test_trainings_needed_for_eight_in_ten(failures, expected):
    # 14 is ln 0.05 / ln 0.8 rounded up; the others by trying all.
    assert seeds_needed(0.8, 0.95, failures) == expected
    assert share_lower(expected - failures, expected, 0.95) >= 0.8
    assert share_lower(expected - 1 - failures, expected - 1, 0.95) < 0.8


def test_a_share_out_of_reach_is_refused():
    with pytest.raises(IksamplesError, match="more than 10,000,000 trainings"):
        seeds_needed(1 - 1e-9, 0.95)


@given(st.floats(0.001, 0.999), st.integers(1, 50))
def test_the_best_of_several_and_back(share, best_of):
    assert single_share(best_of_share(share, 1), 1) == pytest.approx(share)
    assert best_of_share(single_share(share, best_of), best_of) == pytest.approx(share)


def test_the_best_of_three_coins():
    assert best_of_share(0.5, 3) == pytest.approx(7 / 8)
    assert best_of_share(1.0, 3) == 1


def test_interquartile_mean_takes_the_middle_half(rng):
    errors = rng.normal(size=(20, 3))
    np.testing.assert_allclose(
        interquartile_mean(errors), np.sort(errors, axis=0)[5:15].mean(axis=0)
    )
    errors[:5, 0] = np.inf  # a quarter diverged
    assert np.isfinite(interquartile_mean(errors)).all()


@given(st.lists(st.floats(0, 100), min_size=1, max_size=40), st.floats(0.01, 0.99))
def test_share_quantile_is_the_smallest_error_that_the_share_keeps_to(errors, share):
    values = np.array(errors)
    at = float(share_quantile(values, share))
    assert at in values
    assert np.mean(values <= at) >= share - 1e-12
    smaller = values[values < at]
    if len(smaller):
        assert np.mean(values <= smaller.max()) < share


def test_interval_of_nothing_is_unknown():
    assert not interval(1.0, []).known
    assert not interval(1.0, [0.5, np.nan]).known
    assert tuple(interval(1.0, np.linspace(0, 1, 1001))) == (1.0, 0.025, 0.975)


def test_bootstrap_interval_of_a_mean_has_the_textbook_width(rng):
    values = rng.normal(size=400)
    _, low, high = interval(0.0, values[draws(400, rng, 4000)].mean(axis=1))
    assert high - low == pytest.approx(2 * 1.96 * values.std() / 20, rel=0.08)


def line(errors_by_n):
    """Outcomes of one line: number of samples -> errors of seeds 0, 1, ..."""
    return pd.DataFrame(
        [
            {"n_samples": n, "seed": seed, "error_mm": error}
            for n, errors in errors_by_n.items()
            for seed, error in enumerate(errors)
        ]
    )


def test_pairing_takes_what_the_seeds_have_in_common_out(rng):
    luck = np.exp(rng.normal(size=30))  # a factor of about 3 between seeds
    ours = line({8: 0.9 * luck, 27: 2 * luck})
    # The other's seeds in another order, and one size that only one of them has.
    theirs = line({8: luck, 27: luck, 64: luck}).sample(frac=1, random_state=0)
    table = compare(ours, theirs, rng)
    assert table["n_samples"].tolist() == [8, 27]
    np.testing.assert_allclose(table["ratio"], [0.9, 2])
    np.testing.assert_allclose(table["ratio_low"], [0.9, 2])
    np.testing.assert_allclose(table["ratio_high"], [0.9, 2])
    assert table["better"].tolist() == [1, 0]
    assert table["n_pairs"].tolist() == [30, 30]


def test_what_is_not_left_to_chance_is_held_against_every_seed(rng):
    many = line({8: [1.0, 4.0, 4.0, 8.0, np.inf]})
    table = compare(line({8: [2.0]}), many, rng, (False, True))
    assert table["ratio"].item() == 0.5
    assert table["better"].item() == 0.8


def test_a_network_with_one_seed_is_one_pair(rng):
    table = compare(line({8: [2.0]}), line({8: [1.0, 4.0, 4.0, 8.0, 9.0]}), rng)
    assert table["n_pairs"].item() == 1
    assert np.isnan(table["ratio_low"].item())


def test_a_pair_that_diverged_on_both_sides_says_nothing(rng):
    table = compare(line({8: [np.inf, 1.0]}), line({8: [np.inf, 2.0]}), rng)
    assert table["n_pairs"].item() == 1
    assert np.isnan(table["ratio_low"].item())
    assert compare(line({8: [np.inf]}), line({8: [np.inf]}), rng).empty


@pytest.mark.parametrize("n", [1, 2, 7, 8])
@pytest.mark.parametrize(
    ("first", "second"), [(1.0, np.inf), (np.inf, 1.0), (0.0, np.inf), (0.0, 0.0), (1.0, 0.0)]
)
def test_there_is_no_share_of_an_error_that_is_not_finite(rng, n, first, second):
    """Nor of none; half the pairs of an even number are enough to spoil their median."""
    sound = [] if n % 2 else [1.0] * n
    ours, theirs = [first] * n + sound, [second] * n + sound
    table = compare(line({8: ours}), line({8: theirs}), rng)
    assert table[["ratio", "ratio_low", "ratio_high"]].isna().to_numpy().all()


def test_a_seed_that_diverged_leaves_the_median_of_the_others(rng):
    table = compare(line({8: [1.0] * 7}), line({8: [2.0] * 4 + [np.inf] * 3}), rng)
    assert table[["ratio", "ratio_low", "ratio_high"]].to_numpy().tolist() == [[0.5, 0, 0.5]]
