"""The statistics of seeds: shares with their confidence, resampling, and paired comparisons."""

from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BeforeValidator, PlainSerializer, WithJsonSchema

from iksamples.errors import IksamplesError


if TYPE_CHECKING:
    import pandas as pd

Floats = NDArray[np.float64]
Draws = NDArray[np.int64]

FEWEST_SEEDS = 5
"""With fewer seeds a bootstrap interval says nothing."""
LEVEL = 0.95
"""Level of every two-sided interval."""
_MOST_SEEDS = 10**7


Number = Annotated[
    float,
    BeforeValidator(lambda value: np.nan if value is None else value),
    PlainSerializer(lambda value: float(value) if np.isfinite(value) else None),
    WithJsonSchema({"anyOf": [{"type": "number"}, {"type": "null"}]}),
]
"""A number of a JSON file, where null stands for what is not finite or not known."""


@dataclass(frozen=True)
class Interval:
    """An estimate with its 95 % interval; the ends are NaN where there are too few seeds."""

    value: Number
    low: Number
    high: Number

    def __iter__(self) -> Iterator[float]:
        """The value and the ends, so that they can be unpacked."""
        return iter((self.value, self.low, self.high))

    @property
    def known(self) -> bool:
        """Whether there is an interval at all."""
        return bool(np.isfinite(self.low) and np.isfinite(self.high))


def draws(n_seeds: int, rng: np.random.Generator, resamples: int = 1000) -> Draws:
    """Rows of seeds drawn with replacement (Efron and Tibshirani 1993, ch. 6).

    Everything that is compared is resampled with the same draws: seed k stands for seed k in every
    number of samples and every method.

    Returns:
        Indices into the seeds, shape (resamples, n_seeds).
    """
    return rng.integers(0, n_seeds, (resamples, n_seeds))


def interquartile_mean(errors: ArrayLike, axis: int = 0) -> Floats:
    """Mean of the middle half: as robust as the median, with less scatter.

    A quarter of the values, rounded down, is left out at either end (Agarwal et al. 2021,
    arXiv 2108.13264). Up to a quarter of diverged seeds (infinite errors) do no harm.
    """
    ordered = np.sort(np.moveaxis(np.asarray(errors, float), axis, 0), axis=0)
    out = len(ordered) // 4
    return np.asarray(ordered[out : len(ordered) - out].mean(axis=0))


def share_quantile(errors: ArrayLike, share: float, axis: int = 0) -> Floats:
    """Smallest of the errors that at least this share of the seeds does not exceed."""
    return np.quantile(np.asarray(errors, float), share, axis=axis, method="inverted_cdf")


def interval(value: float, resampled: ArrayLike) -> Interval:
    """An estimate with the percentile interval of its resampled values."""
    values = np.asarray(resampled, float)
    if values.size == 0 or np.isnan(values).any():
        return Interval(float(value), np.nan, np.nan)
    tail = (1 - LEVEL) / 2
    low, high = np.quantile(values, [tail, 1 - tail], method="inverted_cdf")
    return Interval(float(value), float(low), float(high))


def share_lower(n_met: int, n: int, confidence: float) -> float:
    """One-sided lower end of a share (Clopper and Pearson 1934).

    Args:
        n_met: Trainings that met the tolerance.
        n: Trainings.
        confidence: Of the share being no smaller.
    """
    from scipy.special import betaincinv

    return float(betaincinv(n_met, n - n_met + 1, 1 - confidence)) if n_met else 0.0


def share_interval(n_met: int, n: int) -> Interval:
    """A share with its two-sided 95 % interval (Clopper and Pearson 1934)."""
    tail = (1 - LEVEL) / 2
    high = 1 - share_lower(n - n_met, n, 1 - tail)
    return Interval(n_met / n, share_lower(n_met, n, 1 - tail), high)


def best_of_share(share: float, best_of: int) -> float:
    """How often the best of several trainings meets what this share of single ones meets."""
    return float(-np.expm1(best_of * np.log1p(-share))) if share < 1 else 1.0


def single_share(share: float, best_of: int) -> float:
    """The share of single trainings that makes the best of several meet it this often."""
    return float(-np.expm1(np.log1p(-share) / best_of))


@lru_cache(maxsize=4096)
def met_needed(n: int, share: float, confidence: float) -> int | None:
    """Fewest of n trainings that must meet it for the lower end to reach a share; None: no way."""
    if share_lower(n, n, confidence) < share:
        return None
    return bisect_left(range(n + 1), share, key=lambda n_met: share_lower(n_met, n, confidence))


def seeds_needed(share: float, confidence: float, failures: int = 0) -> int:
    """Fewest trainings whose lower end reaches a share though some of them failed.

    Raises:
        IksamplesError: More than ten million.
    """
    n = failures + bisect_left(
        range(failures, _MOST_SEEDS),
        share,
        lo=1,
        key=lambda n: share_lower(n - failures, n, confidence),
    )
    if n >= _MOST_SEEDS:
        raise IksamplesError(
            f"a share of {share:g} with confidence {confidence:g} takes more than "
            f"{_MOST_SEEDS:,} trainings; lower tolerance.success_share or raise best_of."
        )
    return n


def compare(
    ours: "pd.DataFrame",
    theirs: "pd.DataFrame",
    rng: np.random.Generator,
    chance: tuple[bool, bool] = (True, True),
) -> "pd.DataFrame":
    """One line's error over another's, seed by seed at equal numbers of samples.

    A seed gives two networks of one shape the same initial weights and shuffles; pairing takes what
    that has in common out of the comparison. What is not left to chance is held against every seed.

    Args:
        ours: Outcomes of one method on one design.
        theirs: Outcomes it is compared with.
        rng: Draws the resamples.
        chance: Whether the first and the second are networks, of which each seed is one.

    Returns:
        One row per number of samples that both have: n_samples, n_pairs, ratio (median over seeds
        of the error divided by the other's; NaN where that is of an infinite error),
        ratio_low and ratio_high (95 % interval; NaN with too few seeds), better (share of the seeds
        with the smaller error).
    """
    import pandas as pd

    records = []
    for n in sorted(set(ours["n_samples"]) & set(theirs["n_samples"])):
        first, second = _paired(
            ours[ours["n_samples"] == n], theirs[theirs["n_samples"] == n], all(chance)
        )
        if not len(first):
            continue
        resampled: Floats | list[float] = []
        with np.errstate(divide="ignore", invalid="ignore"):  # an exact inverse may have none
            # Below all others, but no median: 0 would be said to be a share of it.
            ratio = np.where(np.isinf(second), -np.inf, first / second)
            if len(ratio) >= FEWEST_SEEDS:
                resampled = np.median(ratio[draws(len(ratio), rng)], axis=1)
            value, low, high = interval(float(np.median(ratio)), resampled)
        middle = (value, np.maximum(low, 0.0), high) if np.isfinite(value) else (np.nan,) * 3
        better = float(np.mean(first < second))
        records.append((int(n), len(ratio), *middle, better))
    columns = ["n_samples", "n_pairs", "ratio", "ratio_low", "ratio_high", "better"]
    return pd.DataFrame(records, columns=columns)


def _paired(first: "pd.DataFrame", second: "pd.DataFrame", by_seed: bool) -> tuple[Floats, Floats]:
    """Errors of two methods, seed by seed; a pair of which both diverged says nothing."""
    if not by_seed:
        x, y = (side["error_mm"].to_numpy(float) for side in (first, second))
        x, y = np.broadcast_arrays(x, y)
    else:
        both = first.merge(second, on="seed", suffixes=("", "_other"))
        x, y = both["error_mm"].to_numpy(float), both["error_mm_other"].to_numpy(float)
    useful = np.isfinite(x) | np.isfinite(y)
    return x[useful], y[useful]
