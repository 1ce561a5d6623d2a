"""How far a position can be from the samples, certified for any design."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iksamples.certify.residual import check_box
from iksamples.certify.search import Supremum, maximise
from iksamples.errors import IksamplesError


Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_NEAREST = 16
"""Samples near a box that are tried for its upper bound."""
_ROUNDING = 1e-12


def covering_radius(
    samples_mm: ArrayLike,
    lower_mm: ArrayLike,
    upper_mm: ArrayLike,
    *,
    rtol: float = 0.01,
    max_boxes: int = 2_000_000,
    time_limit_s: float = 60.0,
) -> Supremum:
    """The largest distance from a position of the box to its nearest sample [mm].

    Also called fill distance or dispersion. On a full grid it is half a cell's diagonal,
    ``sqrt(3) / 2 d`` for a cubic cell, and not d / 2.

    Args:
        samples_mm: The samples, shape (n, d).
        lower_mm: Lower corner of the box [mm], shape (d,).
        upper_mm: Upper corner of the box [mm], shape (d,).
        rtol: The search ends once upper <= (1 + rtol) lower.
        max_boxes: Boxes to bound, at most.
        time_limit_s: Time to spend, at most [s].

    Raises:
        IksamplesError: There are no samples, or the box is empty.
    """
    samples = _checked(samples_mm)
    return cone_envelope(
        samples,
        np.zeros(len(samples)),
        1.0,
        lower_mm,
        upper_mm,
        rtol=rtol,
        max_boxes=max_boxes,
        time_limit_s=time_limit_s,
    )


def cone_envelope(
    samples_mm: ArrayLike,
    heights_mm: ArrayLike,
    slope: float,
    lower_mm: ArrayLike,
    upper_mm: ArrayLike,
    *,
    rtol: float = 0.01,
    max_boxes: int = 2_000_000,
    time_limit_s: float = 60.0,
) -> Supremum:
    """The supremum over a box of ``min_i (height_i + slope |x - x_i|)`` [mm].

    No function that has these heights at the samples and this Lipschitz constant is larger
    anywhere, and one such function takes it (McShane's extension).

    Args:
        samples_mm: The samples, shape (n, d).
        heights_mm: Values at the samples [mm], shape (n,).
        slope: The Lipschitz constant [mm/mm].
        lower_mm: Lower corner of the box [mm], shape (d,).
        upper_mm: Upper corner of the box [mm], shape (d,).
        rtol: The search ends once upper <= (1 + rtol) lower.
        max_boxes: Boxes to bound, at most.
        time_limit_s: Time to spend, at most [s].

    Raises:
        IksamplesError: There are no samples, or the box is empty.
    """
    samples, heights = _checked(samples_mm), np.array(heights_mm, float)
    if heights.shape != samples.shape[:1] or not np.isfinite(heights).all():
        raise IksamplesError(f"need a finite height for each of the {len(samples)} samples.")
    if not (np.isfinite(slope) and slope >= 0):
        raise IksamplesError(f"the slope must be finite and not negative; got {slope}.")
    [found] = maximise(
        _Cones(samples, heights, float(slope), lower_mm, upper_mm),
        rtol=rtol,
        max_boxes=max_boxes,
        time_limit_s=time_limit_s,
    )
    return found


def _checked(samples_mm: ArrayLike) -> Floats:
    samples = np.array(samples_mm, float)
    if samples.ndim != 2 or not samples.size or not np.isfinite(samples).all():
        raise IksamplesError(f"need finite samples of shape (n, d); got shape {samples.shape}.")
    return samples


class _Cones:
    """``min_i (height_i + slope |x - x_i|)`` as an objective."""

    n_networks = 1

    def __init__(
        self,
        samples: Floats,
        heights: Floats,
        slope: float,
        lower_mm: ArrayLike,
        upper_mm: ArrayLike,
    ) -> None:
        from scipy.spatial import KDTree

        self.lower_mm, self.upper_mm = check_box(lower_mm, upper_mm, samples.shape[1])
        self.samples, self.heights, self.slope = samples, heights, slope
        self.level = bool(np.ptp(heights) == 0)
        self.tree = KDTree(samples)
        self.nearest = min(_NEAREST, len(samples))

    def values(self, which: Ints, points_mm: Floats) -> Floats:
        """Values at points, by all samples."""
        return self._lowest(points_mm)[0] * (1.0 - _ROUNDING)

    def upper_bounds(
        self, which: Ints, centre_mm: Floats, radius_mm: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Bounds over boxes: the lowest of some cones, each at its farthest corner."""
        near = self._candidates(centre_mm)
        apart = np.abs(centre_mm[:, None] - self.samples[near])
        farthest = np.linalg.norm(apart + radius_mm[:, None], axis=2)
        bounds = self.heights[near] + self.slope * farthest
        best = bounds.argmin(axis=1)
        rows = np.arange(len(best))
        # Away from the lowest cone's sample is uphill.
        away = np.sign(centre_mm - self.samples[near[rows, best]])
        corner = centre_mm + np.where(away == 0, 1.0, away) * radius_mm
        return bounds[rows, best] * (1.0 + _ROUNDING), corner[:, None], radius_mm

    def _candidates(self, centre_mm: Floats) -> Ints:
        """Samples whose cones may be lowest near some positions, shape (positions, candidates)."""
        _, near = self.tree.query(centre_mm, self.nearest)
        near = near.reshape(len(centre_mm), -1)
        if self.level:
            return near
        return np.concatenate([near, self._lowest(centre_mm)[1][:, None]], axis=1)

    def _lowest(self, points_mm: Floats) -> tuple[Floats, Ints]:
        """Height and sample of the lowest cone at some positions."""
        values, sample = np.empty(len(points_mm)), np.empty(len(points_mm), int)
        step = max(1, 4_000_000 // self.samples.size)
        for first in range(0, len(points_mm), step):
            some = slice(first, first + step)
            distance = np.linalg.norm(points_mm[some, None] - self.samples, axis=2)
            cones = self.heights + self.slope * distance
            sample[some] = cones.argmin(axis=1)
            values[some] = cones.min(axis=1)
        return values, sample
