"""The checker's arithmetic: balls, with every rounding counted, and exact tilings.

A ball stands for all reals within ``rad`` of ``mid``. Each operation's result contains every
result of the exact operation on members. It rests on IEEE 754 double precision, rounding to
nearest, on sums and products being computed classically in any order (fused or not), and on
``sin``, ``cos`` and ``tanh`` being right to four units in the last place, which NumPy states for
its own.
"""

import math
from dataclasses import dataclass
from typing import Any, Union

import numpy as np
from numpy.typing import ArrayLike, NDArray


Floats = NDArray[np.float64]

UNIT = 2.0**-53
_TINY = 2.0**-1022
_GROW = 1.0 + 2.0**-49
"""Covers the rounding of up to sixteen operations on numbers that are not negative."""
_LIBRARY = 16.0 * UNIT
"""Relative error of the library's functions: four units in the last place are at most 8 UNIT."""

BallLike = Union["Ball", ArrayLike]


def up(value: Floats) -> Floats:
    """A number at least as large as a short sum of products of what is not negative."""
    return value * _GROW + _TINY


@dataclass(frozen=True, eq=False)
class Ball:
    """An array of balls.

    Attributes:
        mid: Centres.
        rad: Radii, of the same shape.
    """

    mid: Floats
    rad: Floats
    __array_ufunc__ = None  # so that array * ball asks the ball

    @classmethod
    def of(cls, value: BallLike) -> "Ball":
        """A number that is known exactly, or a ball."""
        if isinstance(value, Ball):
            return value
        mid = np.asarray(value, float)
        return cls(mid, np.zeros_like(mid))

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the array."""
        return self.mid.shape

    def __getitem__(self, index: Any) -> "Ball":
        """Part of the array."""
        return Ball(self.mid[index], self.rad[index])

    def __neg__(self) -> "Ball":
        """Exact."""
        return Ball(-self.mid, self.rad)

    def __add__(self, other: BallLike) -> "Ball":
        """Sum; the computed centre is off by at most UNIT of itself."""
        b = Ball.of(other)
        mid = self.mid + b.mid
        return Ball(mid, up(self.rad + b.rad + UNIT * np.abs(mid)))

    __radd__ = __add__

    def __sub__(self, other: BallLike) -> "Ball":
        """Difference."""
        return self + (-Ball.of(other))

    def __rsub__(self, other: BallLike) -> "Ball":
        """Difference."""
        return Ball.of(other) + (-self)

    def __mul__(self, other: BallLike) -> "Ball":
        """Product, element by element."""
        b = Ball.of(other)
        mid = self.mid * b.mid
        spread = self.rad * (np.abs(b.mid) + b.rad) + UNIT * np.abs(mid)
        if isinstance(other, Ball):
            spread = spread + np.abs(self.mid) * b.rad
        return Ball(mid, up(spread))

    __rmul__ = __mul__

    def __truediv__(self, other: ArrayLike) -> "Ball":
        """Division by numbers that are known exactly."""
        divisor = np.asarray(other, float)
        mid = self.mid / divisor
        return Ball(mid, up(self.rad / np.abs(divisor) + UNIT * np.abs(mid)))

    def __matmul__(self, other: BallLike) -> "Ball":
        """Matrix product."""
        b = Ball.of(other)
        terms, size = self.shape[-1], np.abs(b.mid)
        # Higham: a sum of k products is off by at most k UNIT / (1 - k UNIT) of the absolute sum.
        # That share of a factor is counted before it is multiplied, so it must not underflow.
        share = 2.0 * terms * UNIT * size + _TINY
        spread = _dot(np.abs(self.mid), b.rad + share)
        if self.rad.any():
            spread = spread + _dot(self.rad, size + b.rad)
        return Ball(_dot(self.mid, b.mid), _up_sum(spread, terms))

    def __rmatmul__(self, other: ArrayLike) -> "Ball":
        """Matrix product with numbers that are known exactly."""
        return Ball.of(other) @ self

    def sum(self, axis: int) -> "Ball":
        """Sum along an axis."""
        terms = self.shape[axis]
        size = np.abs(self.mid).sum(axis=axis)
        spread = self.rad.sum(axis=axis) + 2.0 * terms * UNIT * size
        return Ball(self.mid.sum(axis=axis), _up_sum(spread, terms))

    def magnitude(self) -> Floats:
        """No member is larger than this in absolute value."""
        return up(np.abs(self.mid) + self.rad)

    def upper(self) -> Floats:
        """No member is larger than this."""
        top = self.mid + self.rad
        return top + (4.0 * UNIT * np.abs(top) + _TINY)

    def lower(self) -> Floats:
        """No member is smaller than this."""
        return -(-self).upper()

    def sin(self) -> "Ball":
        """Sine; its slope is at most 1."""
        mid = np.sin(self.mid)
        return Ball(mid, up(self.rad + _LIBRARY * np.abs(mid)))

    def cos(self) -> "Ball":
        """Cosine; its slope is at most 1."""
        mid = np.cos(self.mid)
        return Ball(mid, up(self.rad + _LIBRARY * np.abs(mid)))

    def tanh(self) -> "Ball":
        """Hyperbolic tangent; its slope is at most 1."""
        mid = np.tanh(self.mid)
        return Ball(mid, up(self.rad + _LIBRARY * np.abs(mid)))

    def reshape(self, *shape: int) -> "Ball":
        """The same balls in another shape."""
        return Ball(self.mid.reshape(shape), self.rad.reshape(shape))

    def swap(self, first: int, second: int) -> "Ball":
        """The array with two axes exchanged."""
        return Ball(np.swapaxes(self.mid, first, second), np.swapaxes(self.rad, first, second))


def _dot(first: Floats, second: Floats) -> Floats:
    """Matrix product; one of many rows where the same matrix follows all of them."""
    if second.ndim > 2 or first.ndim < 3:
        return np.asarray(first @ second)
    *count, terms = first.shape
    return (first.reshape(math.prod(count), terms) @ second).reshape(*count, second.shape[1])


def norm_above(squares: Floats) -> Floats:
    """At least the root of the sum along the last axis of numbers that are not negative."""
    return up(np.sqrt(_up_sum(squares.sum(axis=-1), squares.shape[-1])))


def sum_above(sizes: Floats, axis: int) -> Floats:
    """At least the sum along an axis of numbers that are not negative."""
    return _up_sum(sizes.sum(axis=axis), sizes.shape[axis])


def product_above(first: Floats, second: Floats) -> Floats:
    """At least the matrix product of arrays that are not negative."""
    return _up_sum(_dot(first, second), first.shape[-1])


def join(parts: list[Ball], axis: int) -> Ball:
    """Balls one after the other along an axis."""
    return Ball(
        np.concatenate([part.mid for part in parts], axis=axis),
        np.concatenate([part.rad for part in parts], axis=axis),
    )


def stack(parts: list[Ball], axis: int) -> Ball:
    """Balls of one shape along a new axis."""
    return Ball(
        np.stack([part.mid for part in parts], axis=axis),
        np.stack([part.rad for part in parts], axis=axis),
    )


def _up_sum(value: Floats, terms: int) -> Floats:
    """At least the exact value of a computed sum of that many terms that are not negative."""
    return value * (1.0 + (8.0 * terms + 32.0) * UNIT) + terms * _TINY


_BITS = 52


def tiles(part: NDArray, lower: NDArray, upper: NDArray, shape: tuple[int, int]) -> bool:
    """Whether leaves with binary-fraction corners fill the boxes of a region without overlap.

    Everything is integer arithmetic in units of 2^-52. A cell, to begin with a whole box, is cut at
    its midpoint along the first axis along which no leaf straddles the cut, its leaves are dealt to
    the halves, and so on; a cell that has one leaf left must be that leaf. Any tiling made by
    repeated halving passes, and nothing passes that is not a tiling: no cell is ever left without a
    leaf.

    Args:
        part: The box of the region that each leaf is a part of, integers of shape (leaves,).
        lower: Lower corners as shares of that box's edges, float64 of shape (leaves, d).
        upper: Upper corners, likewise.
        shape: Number of boxes of the region, and d.

    Returns:
        False also for anything but arrays of these shapes and types.
    """
    boxes, d = shape
    if not (
        all(type(array) is np.ndarray for array in (part, lower, upper))
        and part.ndim == 1
        and part.dtype == np.int64
        and lower.dtype == upper.dtype == np.float64
        and lower.shape == upper.shape == (len(part), d)
        and len(part)
        and ((part >= 0) & (part < boxes)).all()
    ):
        return False
    whole = 2**_BITS
    low, high = _integers(lower), _integers(upper)
    if low is None or high is None:
        return False
    if not ((low >= 0) & (low < high) & (high <= whole)).all():
        return False

    cell = part  # the cell that each leaf is in; the cells' corners follow
    cell_low, cell_high = np.zeros((boxes, d), int), np.full((boxes, d), whole)
    while True:
        counts = np.bincount(cell, minlength=len(cell_low))
        if (counts == 0).any():
            return False
        single = counts[cell] == 1
        exact = (low == cell_low[cell]) & (high == cell_high[cell])
        if not exact[single].all():
            return False
        low, high, cell = low[~single], high[~single], cell[~single]
        if not len(low):
            return True
        # Number the cells that are left anew.
        alive, cell = np.unique(cell, return_inverse=True)
        cell_low, cell_high = cell_low[alive], cell_high[alive]
        if ((cell_high - cell_low) % 2 != 0).any():
            return False
        middle = (cell_low + cell_high) // 2
        straddles = (low < middle[cell]) & (high > middle[cell])
        blocked = np.zeros((len(alive), d), bool)
        np.logical_or.at(blocked, cell, straddles)
        axis = blocked.argmin(axis=1)
        rows = np.arange(len(alive))
        if blocked[rows, axis].any():
            return False
        above = (low[np.arange(len(low)), axis[cell]] >= middle[cell, axis[cell]]).astype(int)
        cell_low, cell_high = np.repeat(cell_low, 2, axis=0), np.repeat(cell_high, 2, axis=0)
        cell_high[2 * rows, axis] = middle[rows, axis]
        cell_low[2 * rows + 1, axis] = middle[rows, axis]
        cell = 2 * cell + above


def _integers(shares: Floats) -> NDArray[np.int64] | None:
    """Shares of 1 as integers in units of 2^-52; None where one is not a multiple of that."""
    scaled = shares * 2.0**_BITS  # exact: a power of two
    if not np.isfinite(scaled).all() or (np.abs(scaled) > 2.0**_BITS).any():
        return None
    whole = scaled.astype(np.int64)
    return whole if (whole == scaled).all() else None
