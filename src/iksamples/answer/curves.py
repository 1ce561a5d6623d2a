"""Learning curves: how the error falls with the number of samples.

Two laws, both with a floor that no number of samples goes below:

* the power law e(n) = a + b n^(-c);
* the grid law e(m) = a + b / (m - 1)^2, for grids of m points per axis. Interpolating a smooth
  function on a grid costs the square of the spacing (de Boor, *A Practical Guide to Splines*,
  ch. III); what a network adds does not fall with it and is the floor.

The fit minimises squared deviations relative to the error itself (or to a given ±), with a and b
not negative. For a fixed exponent that has a closed form, so many curves are fitted at once over a
list of exponents.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from iksamples.stats import FEWEST_SEEDS, Draws, Floats, Interval, interquartile_mean, interval


_EXPONENTS = np.round(np.arange(0.02, 4.0001, 0.02), 2)
_PUBLISHED_RESAMPLES = 4000


@dataclass(frozen=True, eq=False)
class GridCurve:
    """The grid law fitted to a column of errors. Intervals are 95 %, NaN with too few seeds.

    Attributes:
        floor_mm: a [mm].
        scale_mm: b [mm].
        points_per_axis: The grids, shape (sizes,).
        observed_mm: What was fitted [mm], shape (sizes,).
    """

    floor_mm: Interval
    scale_mm: Interval
    points_per_axis: Floats
    observed_mm: Floats

    def at(self, points_per_axis: ArrayLike) -> Floats:
        """The curve's error [mm] on grids of so many points per axis."""
        return self.floor_mm.value + self.scale_mm.value * _grid(np.asarray(points_per_axis, float))


def fit_seeds(points_per_axis: ArrayLike, errors_mm: ArrayLike, draws: Draws) -> GridCurve | None:
    """Fits the grid law to the interquartile means of the seeds' errors.

    Args:
        points_per_axis: m of each grid, increasing, shape (sizes,).
        errors_mm: Errors [mm], shape (seeds, sizes); a row is one seed. Infinite: diverged.
        draws: Resampled seeds, shape (resamples, seeds), the same for all that is compared.

    Returns:
        The curve, or None where there are no more usable sizes than parameters.
    """
    errors = np.asarray(errors_mm, float)
    observed = interquartile_mean(errors, 0)
    resampled = np.empty((0, len(observed)))
    if len(errors) >= FEWEST_SEEDS:
        resampled = interquartile_mean(errors[draws], 1)
    return _fit(points_per_axis, observed, resampled, None)


def fit_published(
    points_per_axis: ArrayLike, error_mm: ArrayLike, sd_mm: ArrayLike, rng: np.random.Generator
) -> GridCurve | None:
    """Fits the grid law to a published column of errors with its ±, whose seeds nobody has.

    Args:
        points_per_axis: m of each grid, increasing, shape (sizes,).
        error_mm: Errors [mm], shape (sizes,).
        sd_mm: Their ± [mm], taken as one standard deviation, shape (sizes,).
        rng: Draws columns that might have been published instead, from which the intervals come.

    Returns:
        The curve; None with too few sizes.
    """
    error, sd = np.asarray(error_mm, float), np.asarray(sd_mm, float)
    others = rng.normal(error, sd, (_PUBLISHED_RESAMPLES, len(error)))
    return _fit(points_per_axis, error, others, sd)


def fit_power(n_samples: Floats, errors_mm: Floats, floor: bool = True) -> Floats:
    """Fits the power law to many curves.

    Args:
        n_samples: Increasing, shape (sizes,).
        errors_mm: Positive errors [mm], shape (curves, sizes).
        floor: Whether there is a floor; without one a is 0.

    Returns:
        a, b and c of each curve, shape (curves, 3); c is one of 0.02, 0.04, ..., 4.
    """
    # At the middle of the sizes b is of the errors' size, whatever the exponent.
    centre = np.exp(np.log(n_samples).mean())
    x = (n_samples / centre) ** -_EXPONENTS[:, None]
    a, b, loss = _solve(x, errors_mm, errors_mm**-2.0, floor)
    rows, best = np.arange(len(errors_mm)), loss.argmin(axis=1)
    c = _EXPONENTS[best]
    return np.stack([a[rows, best], b[rows, best] * centre**c, c], axis=1)


def _fit(
    points_per_axis: ArrayLike, observed: Floats, resampled: Floats, sd: Floats | None
) -> GridCurve | None:
    m = np.asarray(points_per_axis, float)
    usable = np.isfinite(observed) & (observed > 0)
    if usable.sum() <= 2:
        return None
    m, columns = m[usable], np.concatenate([observed[None], resampled])[:, usable]
    # A resample in which a size diverged has no weight there.
    sound = np.isfinite(columns)
    scale = columns if sd is None else np.broadcast_to(sd[usable], columns.shape)
    weight = np.where(sound, np.where(sound, scale, 1.0) ** -2.0, 0.0)
    a, b, _ = _solve(_grid(m)[None], np.where(sound, columns, 0.0), weight)
    floor, size = (interval(float(part[0, 0]), part[1:, 0]) for part in (a, b))
    return GridCurve(floor, size, m, columns[0])


def _grid(points_per_axis: Floats) -> Floats:
    return (points_per_axis - 1) ** -2.0


def _solve(
    x: Floats, y: Floats, weight: Floats, floor: bool = True
) -> tuple[Floats, Floats, Floats]:
    """Weighted least squares of y against a + b x with a and b not negative.

    From the two normal equations, or where they leave the quadrant from the better of its edges.

    Args:
        x: Shape (laws, sizes).
        y: Shape (curves, sizes).
        weight: Shape (curves, sizes).
        floor: Whether a may be more than 0.

    Returns:
        a, b, and the sum of squares less what does not depend on them, each (curves, laws).
    """
    s0, sy = weight.sum(axis=1)[:, None], (weight * y).sum(axis=1)[:, None]
    sx, sxx, sxy = weight @ x.T, weight @ (x * x).T, (weight * y) @ x.T
    determinant = s0 * sxx - sx * sx
    regular = determinant > 1e-12 * s0 * sxx
    safe = np.where(regular, determinant, 1)
    a, b = (sxx * sy - sx * sxy) / safe, (s0 * sxy - sx * sy) / safe
    inside = regular & (a >= 0) & (b >= 0) & floor
    with np.errstate(invalid="ignore"):  # no size left: neither is known
        only_b, only_a = sxy / sxx, np.broadcast_to(sy / s0, a.shape)
    steeper = (only_b * sxy >= only_a * sy) | (not floor)
    a = np.where(inside, a, np.where(steeper, 0, only_a))
    b = np.where(inside, b, np.where(steeper, only_b, 0))
    return a, b, a * a * s0 + 2 * a * b * sx + b * b * sxx - 2 * a * sy - 2 * b * sxy
