"""Beyond the sizes tried: how many samples the learning curve asks for, or why it does not say.

Many curves do not go on as they have: they level off, turn up, or fall in steps (Mahmood et al.
2022, arXiv 2207.01725: families of curves diverge, together they bracket the truth). So a number is
given only where

* the samples lie on a grid, since the worst error between scattered samples falls in leaps;
* the curve is not of a network that is trained until it no longer improves: what such a network
  leaves is set by its neurons, and that floor does not show in the curve before it is reached;
* the curve falls over the last sizes, each time, and as steeply at the end as before;
* several laws, fitted to all sizes or to the last ones, with a floor and without, foretell the last
  sizes from those before them;
* none of them asks for many times the most samples tried.

Otherwise the answer is the size to record next. docs/confidence.md says how often what is printed
holds, on studies and on made-up curves.
"""

from typing import NamedTuple

import numpy as np
import pandas as pd

from iksamples.answer.answer import Curve, Extrapolation
from iksamples.answer.collect import Variant
from iksamples.answer.curves import fit_power
from iksamples.answer.sizes import is_random, required_share
from iksamples.stats import FEWEST_SEEDS, LEVEL, Draws, Floats, Interval, draws, share_quantile
from iksamples.study import RECORDED, TENSOR, Study


STREAM = 20260523
"""Seed of the resampling: the same results have the same answer, and all variants the same."""
FEWEST_SIZES = 5
"""So many sizes make a curve that can be fitted and tested."""
MOST = 2.0
"""Extrapolates to at most so many times the most samples tried."""
MARGIN = 1.4
"""By which factor the number may lie outside what the laws say."""
_HELD_OUT = 2
"""So many of the largest sizes are foretold from the smaller ones."""
_MISS = 0.15
"""By which share an error held out may lie outside what the laws foretell."""
_FLAT = 0.2
"""A curve whose last exponent is smaller has levelled off."""
_SLOWING = 0.9
"""A curve whose last exponent is less than so much of the one before is levelling off."""
_UNEVEN = 1.3
"""Exponents of neighbouring sizes that differ by a larger factor make an uneven curve."""
_LAST = 4
_GROWTH = 1.5
_RESAMPLES = 400


class Forecast(NamedTuple):
    """What can be said of a learning curve beyond its largest size.

    Attributes:
        largest: The most samples tried.
        fits: Parameters a, b, c of each law for the curve as seen and resampled.
        reason: Why the curve is not extrapolated; empty: it is.
    """

    largest: float
    fits: list[Floats]
    reason: str


def errors_matrix(rows: pd.DataFrame) -> pd.DataFrame:
    """Errors of one variant [mm], a row per seed and a column per number of samples.

    Only the seeds that every number of samples has, so that a row is the same seed all along.
    """
    return rows.pivot(index="seed", columns="n_samples", values="error_mm").dropna()


def seen(study: Study, variant: Variant, rows: pd.DataFrame) -> tuple[Floats, Floats]:
    """A variant's learning curve and its resamples.

    Args:
        study: The study.
        variant: The method and design.
        rows: Its outcomes.

    Returns:
        Numbers of samples, shape (sizes,), and errors that the required share of the trainings
        does not exceed [mm], shape (1 + resamples, sizes): as seen, and for seeds drawn again.
    """
    matrix, share = errors_matrix(rows), required_share(study.tolerance)
    errors = matrix.to_numpy(float)
    if not len(errors):  # each size has seeds of its own, so none can be drawn again for all
        sizes = {n: own["error_mm"] for n, own in rows.groupby("n_samples")}
        curve = np.array([share_quantile(own, share) for own in sizes.values()], float)
        return np.array(list(sizes), float), curve[None]
    again: Draws = np.arange(len(errors))[None]
    if is_random(study, variant.method) and len(errors) >= FEWEST_SEEDS:
        drawn = draws(len(errors), np.random.default_rng(STREAM), _RESAMPLES)
        again = np.concatenate([again, drawn])
    curves = share_quantile(errors[again], share, axis=1)
    return matrix.columns.to_numpy(float), curves


def shape(n_samples: Floats, curve: Floats) -> Curve | None:
    """Whether a curve falls, ever more slowly; None where it has fewer than three sizes.

    Args:
        n_samples: Numbers of samples, shape (sizes,).
        curve: Errors [mm], shape (sizes,).
    """
    if len(curve) < 3:
        return None
    if not np.isfinite(curve).all():
        return Curve(monotone=False, convex=False)
    slopes = np.diff(curve) / np.diff(n_samples)
    return Curve(monotone=bool((slopes <= 0).all()), convex=bool((np.diff(slopes) >= 0).all()))


def forecast(study: Study, variant: Variant, n_samples: Floats, curves: Floats) -> Forecast:
    """Fits the laws to a variant's learning curve, and says whether they can be trusted.

    Args:
        study: The study.
        variant: The method and design.
        n_samples: As ``seen`` returned.
        curves: As ``seen`` returned.
    """
    largest = float(n_samples[-1])
    by_chance, method = is_random(study, variant.method), study.all_methods[variant.method]
    if variant.design not in (*TENSOR, RECORDED):
        reason = "the error between scattered samples falls in leaps"
    elif method.kind == "network" and method.training.optimizer != "adam":
        reason = (
            "a network trained to convergence has a floor set by its neurons, which its learning "
            "curve does not show before it is reached"
        )
    elif by_chance and len(curves) == 1:
        reason = f"fewer than {FEWEST_SEEDS} trainings do not say how sure its learning curve is"
    else:
        reason = untrusted(n_samples, curves)
    return Forecast(largest, [] if reason else _fits(n_samples, curves), reason)


def untrusted(n_samples: Floats, curves: Floats) -> str:
    """Why a curve is not to be extrapolated, by itself; empty where it may be.

    Args:
        n_samples: Numbers of samples, increasing, shape (sizes,).
        curves: Errors as seen and resampled [mm], shape (1 + resamples, sizes).
    """
    curve = curves[0]
    if len(n_samples) < FEWEST_SIZES:
        return f"fewer than {FEWEST_SIZES} sizes are no learning curve"
    if not (np.isfinite(curves).all() and (curves > 0).all()):
        return "trainings failed, or have no error at all"
    if (np.diff(curve[-_LAST:]) >= 0).any():
        return "its learning curve does not fall from each size to the next"
    exponents = -np.diff(np.log(curve)) / np.diff(np.log(n_samples))
    if exponents[-1] < _FLAT:
        return "its learning curve has levelled off"
    change = exponents[-2:] / exponents[-3:-1]
    if change[-1] < _SLOWING:
        return "its learning curve is levelling off"
    if not (change.min() > 1 / _UNEVEN and change.max() < _UNEVEN):
        return "its learning curve falls unevenly"
    for fewer in range(max(len(n_samples) - _HELD_OUT, _LAST), len(n_samples)):
        fits = _fits(n_samples[:fewer], curves[:, :fewer])
        for n, error in zip(n_samples[fewer:], curve[fewer:], strict=True):
            low, high = _ends([a + b * n**-c for a, b, c in (fit.T for fit in fits)])
            if not low * (1 - _MISS) <= error <= high * (1 + _MISS):
                return (
                    f"fitted to its {fewer} smallest sizes, its learning curve is wrong at "
                    f"{n:.0f} samples ({low:.3g} to {high:.3g} mm foretold, {error:.3g} mm seen)"
                )
    return ""


def needed_samples(known: Forecast, tolerance_mm: float) -> Interval | str:
    """Samples at which a curve comes down to a tolerance, or why that is not to be said.

    Args:
        known: What ``forecast`` returned.
        tolerance_mm: A tolerance that the sizes tried do not meet [mm].
    """
    if known.reason:
        return known.reason
    needed = [_inverse(fit, tolerance_mm) for fit in known.fits]
    low, high = _ends(needed)
    low, high = max(low / MARGIN, known.largest), MARGIN * high
    if not np.isfinite(high):
        return "its learning curve may level off above the tolerance"
    if high <= known.largest:
        return "its learning curve is at the tolerance already, about which the trainings scatter"
    if high > MOST * known.largest:
        return f"it may take more than {MOST:g} times the most tried, too far to say"
    middle = float(np.median([one[0] for one in needed]))
    return Interval(float(np.clip(middle, low, high)), low, high)


def extrapolate(
    study: Study, variant: Variant, known: Forecast, tolerance_mm: float
) -> Extrapolation:
    """The samples to take for a tolerance that the sizes tried do not meet, or to record next.

    Args:
        study: The study.
        variant: The method and design.
        known: What ``forecast`` returned.
        tolerance_mm: The tolerance [mm].
    """
    needed = needed_samples(known, tolerance_mm)
    if isinstance(needed, str):
        record = _whole_design(study, variant, _GROWTH * known.largest)
        return Extrapolation(n_samples=None, needed=None, record_next=record, reason=needed)
    n = _whole_design(study, variant, needed.high)
    return Extrapolation(n_samples=n, needed=needed, record_next=n, reason="")


def _fits(n_samples: Floats, curves: Floats) -> list[Floats]:
    """Parameters of each law for each curve, shape (1 + resamples, 3)."""
    last, fewer = slice(-_LAST, None), slice(1 - _LAST, None)
    return [
        fit_power(n_samples, curves),
        fit_power(n_samples[last], curves[:, last]),
        fit_power(n_samples[last], curves[:, last], floor=False),
        fit_power(n_samples[fewer], curves[:, fewer], floor=False),
    ]


def _ends(of_laws: list[Floats]) -> tuple[float, float]:
    """The ends of the widest of the laws' intervals."""
    tail = (1 - LEVEL) / 2
    ends = np.quantile(np.array(of_laws), [tail, 1 - tail], axis=1, method="inverted_cdf")
    return float(ends[0].min()), float(ends[1].max())


def _inverse(parameters: Floats, tolerance_mm: float) -> Floats:
    """Samples at which curves with these parameters reach a tolerance, or infinity."""
    a, b, c = parameters.T
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return np.where(a < tolerance_mm, (b / (tolerance_mm - a)) ** (1 / c), np.inf)


def _whole_design(study: Study, variant: Variant, n_samples: float) -> int:
    """The next number of samples that the design can have."""
    if variant.design not in TENSOR:
        return int(np.ceil(n_samples))
    d = len(study.task.inputs)
    return int(np.ceil(n_samples ** (1 / d) - 1e-9)) ** d
