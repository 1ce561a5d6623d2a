"""The few statistics the report needs: medians with intervals, and how fast an error falls."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iksamples.arm.chain import Floats


_RESAMPLES = 4000
_FEWEST_SEEDS = 5
"""With fewer seeds a bootstrap interval says nothing."""


class Interval(NamedTuple):
    """An estimate with its 95 % interval; the interval is NaN where there are too few seeds."""

    value: float
    low: float
    high: float

    @property
    def known(self) -> bool:
        """Whether there were seeds enough for an interval."""
        return bool(np.isfinite(self.low))


def median_interval(values: ArrayLike) -> Interval:
    """Median over seeds with its percentile bootstrap interval (Efron and Tibshirani 1993)."""
    value = np.asarray(values, float)
    middle = float(np.median(value))
    if len(value) < _FEWEST_SEEDS:
        return Interval(middle, np.nan, np.nan)
    medians = np.median(value[_draws(len(value), 0)], axis=1)
    return Interval(middle, *(float(q) for q in np.quantile(medians, [0.025, 0.975])))


def fall_interval(before: ArrayLike, after: ArrayLike) -> Interval:
    """By which share the mean falls from one group of seeds to another, with its interval."""
    first, second = np.asarray(before, float), np.asarray(after, float)
    fall = 1 - float(second.mean() / first.mean())
    if min(len(first), len(second)) < _FEWEST_SEEDS:
        return Interval(fall, np.nan, np.nan)
    ratio = second[_draws(len(second), 1)].mean(axis=1) / first[_draws(len(first), 0)].mean(axis=1)
    return Interval(fall, *(float(q) for q in np.quantile(1 - ratio, [0.025, 0.975])))


def slope_interval(x: ArrayLike, errors: Sequence[ArrayLike]) -> Interval:
    """Slope of log mean error against log x, with its interval over resampled seeds.

    Args:
        x: One positive value per group, at least two.
        errors: The seeds' errors of each group.
    """
    log_x = np.log(np.asarray(x, float))
    groups = [np.asarray(error, float) for error in errors]
    slope = _slope(log_x, np.log([group.mean() for group in groups]))
    if min(len(group) for group in groups) < _FEWEST_SEEDS:
        return Interval(float(slope), np.nan, np.nan)
    means = [group[_draws(len(group), i)].mean(axis=1) for i, group in enumerate(groups)]
    slopes = _slope(log_x, np.log(np.stack(means, axis=-1)))
    return Interval(float(slope), *(float(q) for q in np.quantile(slopes, [0.025, 0.975])))


def _slope(x: Floats, y: ArrayLike) -> Floats:
    centred = x - x.mean()
    return np.asarray(y) @ centred / (centred @ centred)


def _draws(n: int, stream: int) -> NDArray[np.int64]:
    """Rows of n seeds drawn with replacement, always the same."""
    return np.random.default_rng([stream, n]).integers(0, n, (_RESAMPLES, n))
