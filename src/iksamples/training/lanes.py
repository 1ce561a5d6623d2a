"""Vectors for numba: a number for every seed of a group, and stacks of them.

numba has no vector type, so ``Tile`` is one; the intrinsics here emit the LLVM instructions that
act on it. Every operation acts on all lanes at once and on each by itself.

How many lanes and how high a tile is are part of the arguments' *types* (the length of the tuples
``lanes`` and ``rows``), since numba's cache on disk notices a changed type but not a changed
global.
"""

from typing import Any

import numba
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, models, register_model


# Best rational approximation x P(x^2) / Q(x^2) of tanh on [-9, 9] (Remez exchange, good to 2.1e-8
# relative); all coefficients are positive, so nothing cancels.
TANH_P = (
    0.9999999794489935,
    0.13381025416658995,
    0.00349558791026175,
    2.0609080280408788e-05,
    1.3354660940723072e-08,
)
TANH_Q = (
    1.0,
    0.4671434100717474,
    0.025876981254715183,
    0.0003285634534006735,
    7.776557626707216e-07,
)
TANH_END = 9.0


class Tile(types.Type):
    """``height`` vectors of ``lanes`` numbers."""

    def __init__(self, dtype: Any, lanes: int, height: int) -> None:
        """Takes the numbers' numba type and the shape."""
        self.dtype, self.lanes, self.height = dtype, lanes, height
        super().__init__(name=f"Tile({dtype}, {lanes}, {height})")


@register_model(Tile)
class _TileModel(models.PrimitiveModel):
    def __init__(self, manager: Any, tile: Tile) -> None:
        super().__init__(manager, tile, _vector(tile))


def _vector(tile: Tile) -> ir.VectorType:
    """The LLVM type: all rows of a tile one after another; LLVM cuts it into registers."""
    number = ir.DoubleType() if tile.dtype.bitwidth == 64 else ir.FloatType()
    return ir.VectorType(number, tile.lanes * tile.height)


def _arrange(builder: Any, value: Any, places: Any) -> Any:
    """The vector of the numbers at the given places of a vector."""
    mask = [ir.Constant(ir.IntType(32), place) for place in places]
    mask = ir.Constant(ir.VectorType(ir.IntType(32), len(mask)), mask)
    return builder.shuffle_vector(value, ir.Constant(value.type, ir.Undefined), mask)


def _place(context: Any, builder: Any, kind: Any, array: Any, index: Any, tile: Tile) -> Any:
    """Pointer to tile ``index`` of a flat array."""
    data = context.make_array(kind)(context, builder, array).data
    start = builder.mul(index, ir.Constant(index.type, tile.lanes * tile.height))
    return builder.bitcast(builder.gep(data, [start]), _vector(tile).as_pointer())


@intrinsic
def load(typing: Any, array: Any, index: Any, lanes: Any, rows: Any) -> Any:
    """The tile at row ``index`` of a flat array."""
    tile = Tile(array.dtype, lanes.count, rows.count)

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        place = _place(context, builder, array, args[0], args[1], tile)
        return builder.load(place, align=tile.dtype.bitwidth // 8)

    return tile(array, types.int64, lanes, rows), emit


@intrinsic
def store(typing: Any, array: Any, index: Any, value: Any) -> Any:
    """Writes a tile to row ``index`` of a flat array."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        place = _place(context, builder, array, args[0], args[1], value)
        builder.store(args[2], place, align=value.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, types.int64, value), emit


@intrinsic
def fill(typing: Any, number: Any, like: Any) -> Any:
    """A tile of height 1 with the same number in every lane."""
    tile = Tile(like.dtype, like.lanes, 1)

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        start = ir.Constant(_vector(tile), ir.Undefined)
        start = builder.insert_element(start, args[0], ir.Constant(ir.IntType(32), 0))
        return _arrange(builder, start, [0] * tile.lanes)

    return tile(like.dtype, like), emit


def _call(name: str, builder: Any, *vectors: Any) -> Any:
    vector = vectors[0].type
    suffix = f"v{vector.count}{'f64' if isinstance(vector.element, ir.DoubleType) else 'f32'}"
    kind = ir.FunctionType(vector, [vector] * len(vectors))
    function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.{suffix}")
    return builder.call(function, vectors)


def _broadcast(operands: tuple[Tile, ...]) -> Tile:
    tallest = max(operands, key=lambda tile: tile.height)
    return Tile(tallest.dtype, tallest.lanes, tallest.height)


def _emitter(operation: Any, tile: Tile) -> Any:
    """Code that applies an operation; a tile of height 1 stands for as many rows as are needed."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        operands = [
            value
            if kind.height == tile.height
            else _arrange(builder, value, [*range(tile.lanes)] * tile.height)
            for kind, value in zip(signature.args, args, strict=True)
        ]
        return operation(builder, *operands)

    return emit


def _one(operation: Any) -> Any:
    @intrinsic
    def function(typing: Any, a: Any) -> Any:
        tile = _broadcast((a,))
        return tile(a), _emitter(operation, tile)

    return function


def _two(operation: Any) -> Any:
    @intrinsic
    def function(typing: Any, a: Any, b: Any) -> Any:
        tile = _broadcast((a, b))
        return tile(a, b), _emitter(operation, tile)

    return function


def _three(operation: Any) -> Any:
    @intrinsic
    def function(typing: Any, a: Any, b: Any, c: Any) -> Any:
        tile = _broadcast((a, b, c))
        return tile(a, b, c), _emitter(operation, tile)

    return function


def _zero(vector: Any) -> Any:
    return ir.Constant(vector.type, None)


add = _two(lambda builder, a, b: builder.fadd(a, b))
sub = _two(lambda builder, a, b: builder.fsub(a, b))
mul = _two(lambda builder, a, b: builder.fmul(a, b))
div = _two(lambda builder, a, b: builder.fdiv(a, b))
sqrt = _one(lambda builder, a: _call("sqrt", builder, a))
absolute = _one(lambda builder, a: _call("fabs", builder, a))
# fmuladd is one instruction where the machine has one, and never a call to a library.
fma = _three(lambda builder, a, b, c: _call("fmuladd", builder, a, b, c))
# Where the second operand is not a number, so is the result: a diverged lane stays visible.
largest = _two(lambda builder, a, b: builder.select(builder.fcmp_ordered(">=", a, b), a, b))
smallest = _two(lambda builder, a, b: builder.select(builder.fcmp_ordered("<=", a, b), a, b))
relu = _one(lambda builder, a: builder.select(builder.fcmp_ordered("<", a, _zero(a)), _zero(a), a))
zeros = _one(lambda builder, a: _zero(a))
where_positive = _two(
    lambda builder, a, b: builder.select(builder.fcmp_ordered(">", a, _zero(a)), b, _zero(b))
)


@intrinsic
def dot(typing: Any, a: Any, b: Any, c: Any) -> Any:
    """``c`` plus the products of ``a`` and ``b``, added sample by sample."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        x, y, total = args
        for row in range(max(a.height, b.height)):
            places = range(row * c.lanes, (row + 1) * c.lanes)
            left = x if a.height == 1 else _arrange(builder, x, places)
            right = y if b.height == 1 else _arrange(builder, y, places)
            total = _call("fmuladd", builder, left, right, total)
        return total

    return c(a, b, c), emit


@intrinsic
def collect(typing: Any, table: Any, column: Any, order: Any, at: Any, lanes: Any) -> Any:
    """Every lane's own sample: ``table[order[lane, at], column]``."""
    tile = Tile(table.dtype, lanes.count, 1)

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        values = context.make_array(table)(context, builder, args[0])
        orders = context.make_array(order)(context, builder, args[2])
        width = builder.extract_value(values.shape, 1)
        n = builder.extract_value(orders.shape, 1)
        vector = ir.Constant(_vector(tile), ir.Undefined)
        for lane in range(tile.lanes):
            place = builder.add(builder.mul(n, ir.Constant(n.type, lane)), args[3])
            row = builder.sext(builder.load(builder.gep(orders.data, [place])), n.type)
            place = builder.add(builder.mul(row, width), args[1])
            number = builder.load(builder.gep(values.data, [place]))
            vector = builder.insert_element(vector, number, ir.Constant(ir.IntType(32), lane))
        return vector

    return tile(table, types.int64, order, types.int64, lanes), emit


@numba.njit(forceinline=True)
def tanh(x):  # type: ignore[no-untyped-def]
    """tanh, within 6 units in the last place of float32 (it may exceed 1 by four of them)."""
    x = largest(fill(-TANH_END, x), smallest(fill(TANH_END, x), x))
    t = mul(x, x)
    p = fma(t, fill(TANH_P[4], x), fill(TANH_P[3], x))
    p = fma(t, p, fill(TANH_P[2], x))
    p = fma(t, p, fill(TANH_P[1], x))
    p = fma(t, p, fill(TANH_P[0], x))
    q = fma(t, fill(TANH_Q[4], x), fill(TANH_Q[3], x))
    q = fma(t, q, fill(TANH_Q[2], x))
    q = fma(t, q, fill(TANH_Q[1], x))
    q = fma(t, q, fill(TANH_Q[0], x))
    return div(mul(x, p), q)
