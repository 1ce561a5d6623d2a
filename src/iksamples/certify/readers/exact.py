"""Affine arithmetic without rounding, so that a network read is the network of the file.

Floats stay floats where an operation cannot round (a matrix that only selects, a zero added);
anywhere else arrays of ``Fraction`` take over. ``to_floats`` rounds once, at the end, and says
whether it had to.
"""

from fractions import Fraction

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iksamples.errors import IksamplesError


Numbers = NDArray  # float64, or Fractions in an array of objects
Floats = NDArray[np.float64]

_MOST_PRODUCTS = 1_000_000
"""Products of fractions in one matrix product, a few seconds' worth."""
_NORMAL = 2.0**-1022


def fractions(values: ArrayLike) -> Numbers:
    """The same numbers as fractions."""
    array = np.asarray(values)
    if array.dtype == object:
        return array
    return np.asarray(np.frompyfunc(Fraction, 1, 1)(array.astype(float)), object)


def plus(a: Numbers, b: Numbers) -> Numbers:
    """a + b, broadcast."""
    for one, other in ((a, b), (b, a)):
        if not np.any(one != 0):
            return np.broadcast_to(other, np.broadcast_shapes(a.shape, b.shape))
    return np.asarray(fractions(a) + fractions(b), object)


def times(a: Numbers, b: Numbers) -> Numbers:
    """a * b, broadcast."""
    if _are_floats(a, b) and (_zeros_and_ones(a) or _zeros_and_ones(b)):
        return np.asarray(a * b)
    return np.asarray(fractions(a) * fractions(b), object)


def over(a: Numbers, b: Numbers) -> Numbers:
    """a / b, broadcast.

    Raises:
        IksamplesError: A zero in b.
    """
    if np.any(b == 0):
        raise IksamplesError("divides by zero")
    if np.all(b == 1):
        return np.broadcast_to(a, np.broadcast_shapes(a.shape, b.shape))
    return np.asarray(fractions(a) / fractions(b), object)


def product(a: Numbers, b: Numbers) -> Numbers:
    """a @ b.

    Raises:
        IksamplesError: The matrices are too large to be multiplied without rounding.
    """
    if _are_floats(a, b) and (_selects(a, -1) or _selects(b, max(b.ndim - 2, 0))):
        return np.asarray(a @ b)
    inner = a.shape[-1]
    outer = max(np.asarray(np.empty(a.shape, "b") @ np.empty(b.shape, "b")).size, 1)
    if inner * outer > _MOST_PRODUCTS:
        raise IksamplesError(
            "has linear layers in a row that are too large to be multiplied without rounding; "
            "merge them before you export"
        )
    return np.asarray(fractions(a) @ fractions(b), object)


def to_floats(values: Numbers) -> tuple[Floats, bool]:
    """The nearest float64 numbers, and whether they are the same numbers.

    Raises:
        IksamplesError: A number is beyond the range of float64.
    """
    if values.dtype != object:
        return np.asarray(values, float), True
    try:
        floats = np.asarray(np.frompyfunc(float, 1, 1)(values)).astype(float)
    except OverflowError:
        raise IksamplesError("has a number that is too large for float64") from None
    same = np.asarray(fractions(floats) == values, bool)
    if np.any(~same & (np.abs(floats) < _NORMAL)):
        raise IksamplesError("has a number that is too small for float64")
    return floats, bool(same.all())


def _are_floats(a: Numbers, b: Numbers) -> bool:
    return a.dtype != object and b.dtype != object


def _zeros_and_ones(a: Numbers) -> bool:
    return bool(np.all((a == 0) | (a == 1)))


def _selects(a: Numbers, axis: int) -> bool:
    """Whether every sum along an axis has one term at most, and that without a factor."""
    return _zeros_and_ones(a) and bool(np.all(np.sum(a, axis=axis) <= 1))
