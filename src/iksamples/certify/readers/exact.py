"""Affine arithmetic without rounding, so that a network read is the network of the file.

Floats stay floats where an operation cannot round (a matrix that only selects, a zero added);
anywhere else arrays of ``Fraction`` take over. ``to_floats`` rounds once, at the end, and says
whether it had to. A ``Value`` is what flows along an edge of an ONNX graph: a constant, or an
affine map of what came before.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

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


@dataclass(frozen=True, eq=False)
class Value:
    """A constant, or an affine map of the values that came out of the last activation.

    Attributes:
        const: A constant, or the constant part, shape (*shape,).
        coef: Factor of every value that the map starts from, shape (k, *shape); None: a constant.
        start: Which values the map starts from; the input is 0.
    """

    const: Numbers
    coef: Numbers | None = None
    start: int = 0

    def reshaped(self, change: Callable[[NDArray], NDArray]) -> "Value":
        """The same elements in another shape or order."""
        if self.coef is None:
            return Value(change(self.const))
        parts = [change(part) for part in self.coef]
        return replace(self, const=change(self.const), coef=np.stack(parts))


def shape_for_one(kind: Any, name: str, n_inputs: int) -> tuple[int, ...]:
    """The shape of the input for one position; lengths left open are the batch's or the values'."""
    from onnx import TensorProto

    if kind.elem_type not in (TensorProto.FLOAT, TensorProto.DOUBLE):
        number = TensorProto.DataType.Name(kind.elem_type)
        raise IksamplesError(f"takes its input '{name}' as {number}; export it in float32")
    if not kind.HasField("shape"):
        return (1, n_inputs)
    lengths = [d.dim_value if d.HasField("dim_value") else None for d in kind.shape.dim]
    known = int(np.prod([n for n in lengths if n is not None], dtype=int))
    if None in lengths[1:] and known == 1 and lengths.count(None) <= 2:
        lengths[len(lengths) - 1 - lengths[::-1].index(None)] = n_inputs
    return tuple(1 if n is None else n for n in lengths)


def read_tensor(tensor: Any, name: str) -> NDArray:
    """The numbers of a tensor of the file.

    Raises:
        IksamplesError: They are damaged or not finite.
    """
    from onnx import numpy_helper

    try:
        array = numpy_helper.to_array(tensor)
    except (TypeError, ValueError, KeyError) as error:
        raise IksamplesError(f"has a damaged constant '{name}' ({error})") from None
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise IksamplesError(f"has a number that is not finite in '{name}'")
    return plain(array)


def plain(array: NDArray) -> NDArray:
    """Real numbers as float64 and integers as int64, both exact; anything else stays."""
    if array.dtype.kind == "f" or array.dtype.name in ("bfloat16", "float16"):
        return array.astype(np.float64)
    return array.astype(np.int64) if array.dtype.kind == "i" else array


def real(value: Value) -> Numbers:
    """The constant part, which has to be of real numbers."""
    if value.const.dtype not in (np.float64, object):
        raise IksamplesError(f"has a constant of {value.const.dtype}, not of real numbers")
    return value.const


def integers(value: Value) -> NDArray:
    """The numbers of a constant of integers."""
    if value.coef is not None or value.const.dtype != np.int64:
        raise IksamplesError("takes a shape or an index that is not a constant of integers")
    return value.const


def each(change: Callable[[Numbers], Numbers], value: Value) -> Numbers:
    """A linear map of each factor."""
    parts = [change(part) for part in value.coef] if value.coef is not None else []
    if any(part.dtype == object for part in parts):
        parts = [fractions(part) for part in parts]
    return np.stack(parts)


def stretched(value: Value, shape: tuple[int, ...]) -> Numbers:
    """The factors, broadcast to a shape."""
    coef = np.asarray(value.coef)
    ones = (1,) * (len(shape) - value.const.ndim)
    return np.broadcast_to(coef.reshape(len(coef), *ones, *value.const.shape), (len(coef), *shape))
