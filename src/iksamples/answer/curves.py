"""Learning curves: how the error falls with the number of samples, and what they foretell.

Two laws, both with a floor that no number of samples goes below:

* ``power``: e(n) = a + b n^(-c);
* ``grid``: e(m) = a + b / (m - 1)^2, for grids of m points per axis. Interpolating a smooth
  function on a grid costs the square of the spacing (de Boor, *A Practical Guide to Splines*,
  ch. III); what a network adds does not fall with it and is the floor.

The fit minimises squared deviations relative to the error itself (or to a given ±), with a and b
not negative. For a fixed exponent that has a closed form, so all resamples are fitted at once over
a list of exponents; the fit itself is refined between them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from iksamples.answer.statistics import (
    FEWEST_SEEDS,
    Draws,
    Floats,
    Interval,
    interquartile_mean,
    interval,
)


Law = Literal["power", "grid"]
Summary = Callable[[Floats, int], Floats]
"""One number for the seeds of each rung: (errors, axis of the seeds) -> errors without it."""

_PARAMETERS = {"power": 3, "grid": 2}
NEVER = 1000
"""A curve that takes more than so many times the most samples tried never gets there."""
_EXPONENTS = np.round(np.arange(-0.5, 4.0001, 0.05), 2)
"""Exponents tried. A rising curve (below 0) is allowed, so that an interval can span 0."""
_PUBLISHED_RESAMPLES = 4000


@dataclass(frozen=True)
class HeldOut:
    """The largest rung, predicted from the others.

    Attributes:
        n_samples: Its number of samples.
        observed_mm: Its error [mm].
        predicted_mm: What the curve through the smaller rungs says, with its interval [mm].
    """

    n_samples: int
    observed_mm: float
    predicted_mm: Interval

    @property
    def relative_error(self) -> float:
        """By which share the prediction is too high (positive) or too low."""
        return self.predicted_mm.value / self.observed_mm - 1


@dataclass(frozen=True)
class Needed:
    """Samples at which a curve comes down to a tolerance.

    Attributes:
        n_samples: By the fit; infinite for never.
        upper: No more than these with the confidence asked for; NaN with too few seeds.
        reachable: Share of the resamples in which the curve ever comes down to it; NaN likewise.
    """

    n_samples: float
    upper: float
    reachable: float


@dataclass(frozen=True, eq=False)
class Curve:
    """A fitted learning curve. Intervals are 95 %; NaN where there were too few seeds.

    Attributes:
        law: Which law.
        floor_mm: a [mm].
        scale_mm: b [mm]; for the power law the (extrapolated) excess at one sample.
        exponent: c; fixed for the grid law: 2, in m - 1.
        n_samples: The rungs, shape (rungs,).
        points_per_axis: Their grids, shape (rungs,).
        observed_mm: What was fitted, shape (rungs,).
        chi2_per_dof: Squared deviations in units of the given ±, over the degrees of freedom; NaN
            without a ±.
        held_out: The largest rung predicted; None with too few rungs.
        resampled: a, b and c of every resample, shape (resamples, 3).
    """

    law: Law
    floor_mm: Interval
    scale_mm: Interval
    exponent: Interval
    n_samples: Floats
    points_per_axis: Floats
    observed_mm: Floats
    chi2_per_dof: float
    held_out: HeldOut | None
    resampled: Floats

    @property
    def unidentified(self) -> str:
        """Why the curve's numbers cannot be told from these rungs; empty where they can."""
        if not self.floor_mm.known:
            return "too few seeds for intervals"
        if self.law == "power" and self.exponent.low <= 0:
            return "the interval of the exponent spans 0"
        if self.law == "power" and self.exponent.high >= _EXPONENTS[-1]:
            return f"the interval of the exponent goes beyond {_EXPONENTS[-1]:g}"
        if self.floor_mm.high - self.floor_mm.low > self.observed_mm[-1] / 2:
            return "the interval of the floor is wider than half the last error"
        return ""

    def at(self, n_samples: ArrayLike, points_per_axis: ArrayLike) -> Floats:
        """The curve's error [mm] at some numbers of samples (of grids, for the grid law)."""
        n, m = np.asarray(n_samples, float), np.asarray(points_per_axis, float)
        return _law(self.law, self.floor_mm.value, self.scale_mm.value, self.exponent.value, n, m)

    @property
    def level_mm(self) -> Interval:
        """Where the curve ends, for all that matters: its error at ``NEVER`` times the most tried.

        Unlike the floor this is determined even where floor and exponent can stand in for each
        other. A curve that rises is taken to stay where it is.
        """
        n = np.array([[self.n_samples[-1]], [NEVER * self.n_samples[-1]]])
        m = np.cbrt(n)
        fit = _law(self.law, self.floor_mm.value, self.scale_mm.value, self.exponent.value, n, m)
        a, b, c = self.resampled.T
        return interval(float(fit.min()), _law(self.law, a, b, c, n, m).min(axis=0))

    def needed(self, tolerance_mm: float, confidence: float) -> Needed:
        """Samples at which the curve comes down to a tolerance.

        More than ``NEVER`` times the most tried count as never.

        Args:
            tolerance_mm: The tolerance [mm].
            confidence: Of ``upper``.
        """
        fit = np.array([[self.floor_mm.value, self.scale_mm.value, self.exponent.value]])
        n = float(self._inverse(fit, tolerance_mm)[0])
        if not self.floor_mm.known:
            return Needed(n, np.nan, np.nan)
        resampled = self._inverse(self.resampled, tolerance_mm)
        upper = float(np.quantile(resampled, confidence, method="inverted_cdf"))
        return Needed(n, upper, float(np.isfinite(resampled).mean()))

    def _inverse(self, parameters: Floats, tolerance_mm: float) -> Floats:
        """Samples at which curves with these parameters reach a tolerance, or infinity."""
        a, b, c = parameters.T
        most = self.n_samples[-1]
        falls = (a < tolerance_mm) & (c > 0)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            ratio = b / (tolerance_mm - a)
            n = (1 + np.sqrt(ratio)) ** 3 if self.law == "grid" else ratio ** (1 / c)
        n = np.where(falls & (n <= NEVER * most), n, np.inf)
        # A curve that does not fall, but is low enough already.
        return np.where(
            ~falls & (_law(self.law, a, b, c, most, np.cbrt(most)) <= tolerance_mm), most, n
        )


def fit_seeds(
    law: Law,
    n_samples: ArrayLike,
    points_per_axis: ArrayLike,
    errors_mm: ArrayLike,
    draws: Draws,
    summary: Summary = interquartile_mean,
) -> Curve | None:
    """Fits a law to the seeds' errors.

    Args:
        law: Which law.
        n_samples: Increasing, shape (rungs,).
        points_per_axis: m of each grid, shape (rungs,); used by the grid law alone.
        errors_mm: Errors [mm], shape (seeds, rungs); a row is one seed. Infinite: diverged.
        draws: Resampled seeds, shape (resamples, seeds), the same for all that is compared.
        summary: What is fitted of each rung's seeds.

    Returns:
        The curve, or None where there are no more usable rungs than parameters.
    """
    errors = np.asarray(errors_mm, float)
    observed = summary(errors, 0)[None]
    resampled = observed[:0]
    if len(errors) >= FEWEST_SEEDS:
        resampled = summary(errors[draws], 1)
    return _fit(law, n_samples, points_per_axis, observed, resampled, None)


def fit_published(
    law: Law,
    n_samples: ArrayLike,
    points_per_axis: ArrayLike,
    error_mm: ArrayLike,
    sd_mm: ArrayLike,
    rng: np.random.Generator,
) -> Curve | None:
    """Fits a law to a published column of errors with its ±, whose seeds nobody has.

    Args:
        law: Which law.
        n_samples: Increasing, shape (rungs,).
        points_per_axis: m of each grid, shape (rungs,).
        error_mm: Errors [mm], shape (rungs,).
        sd_mm: Their ± [mm], taken as one standard deviation, shape (rungs,).
        rng: Draws columns that might have been published instead, from which the intervals come.

    Returns:
        The curve; None with too few rungs.
    """
    error, sd = np.asarray(error_mm, float), np.asarray(sd_mm, float)
    others = rng.normal(error, sd, (_PUBLISHED_RESAMPLES, len(error)))
    return _fit(law, n_samples, points_per_axis, error[None], others, sd)


def _fit(
    law: Law,
    n_samples: ArrayLike,
    points_per_axis: ArrayLike,
    observed: Floats,
    resampled: Floats,
    sd: Floats | None,
) -> Curve | None:
    n, m = np.asarray(n_samples, float), np.asarray(points_per_axis, float)
    usable = np.isfinite(observed[0]) & (observed[0] > 0)
    if usable.sum() <= _PARAMETERS[law]:
        return None
    n, m, observed, resampled = n[usable], m[usable], observed[:, usable], resampled[:, usable]
    sd = sd[usable] if sd is not None else None
    best = _refined(law, n, m, observed[0], sd)
    others = _profile(law, n, m, resampled, sd)
    chi2 = np.nan
    if sd is not None:
        deviation = (_law(law, *best, n, m) - observed[0]) / sd
        chi2 = float(deviation @ deviation / (len(n) - _PARAMETERS[law]))
    held_out = None
    if len(n) - 1 > _PARAMETERS[law]:
        held_out = _predict_last(law, n, m, observed, resampled, sd)
    a, b, c = (interval(best[i], others[:, i]) for i in range(3))
    return Curve(law, a, b, c, n, m, observed[0], chi2, held_out, others)


def _predict_last(
    law: Law, n: Floats, m: Floats, observed: Floats, resampled: Floats, sd: Floats | None
) -> HeldOut:
    """Fits all rungs but the largest and predicts that one."""
    fewer = sd[:-1] if sd is not None else None
    best = _refined(law, n[:-1], m[:-1], observed[0, :-1], fewer)
    predicted = float(_law(law, *best, n[-1:], m[-1:])[0])
    a, b, c = _profile(law, n[:-1], m[:-1], resampled[:, :-1], fewer).T
    others = _law(law, a, b, c, n[-1], m[-1])
    return HeldOut(int(n[-1]), float(observed[0, -1]), interval(predicted, others))


def _law(
    law: Law,
    a: float | Floats,
    b: float | Floats,
    c: float | Floats,
    n: float | Floats,
    m: float | Floats,
) -> Floats:
    return np.asarray(a + b * ((m - 1.0) ** -2.0 if law == "grid" else n ** -np.asarray(c)))


def _profile(law: Law, n: Floats, m: Floats, errors: Floats, sd: Floats | None) -> Floats:
    """Least-squares a, b and c for many sets of errors, shape (sets, rungs) -> (sets, 3).

    Rungs whose error is not finite have no weight; a set with too few left gets an infinite floor.
    """
    exponents = _EXPONENTS if law == "power" else np.array([2.0])
    sound = np.isfinite(errors) & (errors > 0)
    weight = np.where(sound, 1 / np.where(sound, errors if sd is None else sd, 1), 0) ** 2
    # At the middle of the rungs b is of the errors' size, whatever the exponent.
    centre = _centre(law, n)
    x = np.stack([_law(law, 0.0, 1.0, c, n / centre, m) for c in exponents])
    a, b, loss = _solve(x, np.where(sound, errors, 0), weight)
    rows, best = np.arange(len(errors)), loss.argmin(axis=1)
    c = exponents[best]
    floor = np.where(sound.sum(axis=1) >= _PARAMETERS[law], a[rows, best], np.inf)
    return np.stack([floor, b[rows, best] * centre**c, c], axis=1)


def _refined(
    law: Law, n: Floats, m: Floats, error: Floats, sd: Floats | None
) -> tuple[float, float, float]:
    """The fit itself: a, b and c, refined between the exponents tried."""
    from scipy.optimize import minimize_scalar

    a, b, c = (float(value) for value in _profile(law, n, m, error[None], sd)[0])
    if law == "grid" or b == 0:
        return a, b, c
    weight = (1 / (error if sd is None else sd)) ** 2
    centre = _centre(law, n)

    def fit(exponent: float) -> tuple[float, float]:
        x = (n / centre) ** -exponent
        a, b, _ = _solve(x[None], error[None], weight[None])
        return a.item(), b.item()

    def loss(exponent: float) -> float:
        a, b = fit(exponent)
        deviation = a + b * (n / centre) ** -exponent - error
        return float(deviation**2 @ weight)

    step = _EXPONENTS[1] - _EXPONENTS[0]
    ends = (max(c - step, _EXPONENTS[0]), min(c + step, _EXPONENTS[-1]))
    found = minimize_scalar(loss, bounds=ends, method="bounded", options={"xatol": 1e-10})
    c = float(found.x) if found.fun <= loss(c) else c
    a, b = fit(c)
    return a, b * centre**c, c


def _centre(law: Law, n: Floats) -> float:
    return float(np.exp(np.log(n).mean())) if law == "power" else 1.0


def _solve(x: Floats, y: Floats, weight: Floats) -> tuple[Floats, Floats, Floats]:
    """Weighted least squares of y against a + b x with a and b not negative.

    From the two normal equations, or where they leave the quadrant from the better of its edges.

    Args:
        x: Shape (laws, rungs).
        y: Shape (sets, rungs).
        weight: Shape (sets, rungs).

    Returns:
        a, b, and the sum of squares less what does not depend on them, each (sets, laws).
    """
    s0, sy = weight.sum(axis=1)[:, None], (weight * y).sum(axis=1)[:, None]
    sx, sxx, sxy = weight @ x.T, weight @ (x * x).T, (weight * y) @ x.T
    determinant = s0 * sxx - sx * sx
    regular = determinant > 1e-12 * s0 * sxx
    safe = np.where(regular, determinant, 1)
    a, b = (sxx * sy - sx * sxy) / safe, (s0 * sxy - sx * sy) / safe
    inside = regular & (a >= 0) & (b >= 0)
    nothing = s0 == 0  # no rung left
    only_b = sxy / np.where(nothing, 1, sxx)
    only_a = np.broadcast_to(sy / np.where(nothing, 1, s0), a.shape)
    edge_b, edge_a = -only_b * sxy, -only_a * sy
    a = np.where(inside, a, np.where(edge_b <= edge_a, 0, only_a))
    b = np.where(inside, b, np.where(edge_b <= edge_a, only_b, 0))
    return a, b, a * a * s0 + 2 * a * b * sx + b * b * sxx - 2 * a * sy - 2 * b * sxy
