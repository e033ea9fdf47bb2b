"""A number eight doubles wide for Numba kernels.

Kernels written with it read like scalar code and are vector code by
construction: nothing depends on what the auto-vectoriser recognises, and
Newton loops of unknown length may stand inside a kernel. One lane is one
cluster (`lanes`, `water`) or one piece of a chain (`chain`).

Arrays are handed to intrinsics only: an array handed to a Python function
inside a loop costs reference counting, and the call makes every vector
register spill.
"""

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.datamodel import models, register_default
from numba.core.imputils import lower_builtin
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic

WIDTH = 8
"""Doubles a lane vector holds: one AVX-512 register, two AVX2 registers."""

FASTMATH = {"contract", "arcp", "nsz"}
"""No 'nnan' (it calls NaN converged) and no 'reassoc' (it undoes differences)."""

_FLAGS = ("contract", "arcp", "nsz")


# --------------------------------------------------------------------------
# A number WIDTH doubles wide


class LanesType(types.Type):
    """Numba type of `WIDTH` doubles that are computed with together."""

    def __init__(self) -> None:
        super().__init__(name=f"Lanes{WIDTH}")


lanes_type = LanesType()
_DOUBLE = ir.DoubleType()
_INT32 = ir.IntType(32)
_INT64 = ir.IntType(64)
_VECTOR = ir.VectorType(_DOUBLE, WIDTH)
_ROW = ir.VectorType(_DOUBLE, 4)
_MASK = ir.Constant(ir.VectorType(ir.IntType(1), 4), [1, 1, 1, 0])
_TRIPLE = types.UniTuple(lanes_type, 3)


@register_default(LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, numba_type: types.Type) -> None:
        super().__init__(manager, numba_type, _VECTOR)


class _Arithmetic(ConcreteTemplate):
    cases = [
        signature(lanes_type, lanes_type, lanes_type),
        signature(lanes_type, lanes_type, types.float64),
        signature(lanes_type, types.float64, lanes_type),
    ]


class _Negation(ConcreteTemplate):
    cases = [signature(lanes_type, lanes_type)]


def _splat(builder: Any, value: Any) -> Any:
    if value.type == _VECTOR:
        return value
    one = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), value, _INT32(0))
    return builder.shuffle_vector(one, one, ir.Constant(ir.VectorType(_INT32, WIDTH), [0] * WIDTH))


def _define(function: Any, instruction: str) -> None:
    infer_global(function)(type(f"_{instruction}", (_Arithmetic,), {}))

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        left, right = (_splat(builder, value) for value in args)
        return getattr(builder, instruction)(left, right, flags=_FLAGS)

    for case in _Arithmetic.cases:
        lower_builtin(function, *case.args)(lower)


for _function, _instruction in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _define(_function, _instruction)

infer_global(operator.neg)(type("_neg", (_Negation,), {}))


@lower_builtin(operator.neg, lanes_type)
def _lower_neg(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.fneg(args[0], flags=_FLAGS)


def _data(context: Any, builder: Any, array_type: Any, value: Any) -> Any:
    return context.make_array(array_type)(context, builder, value).data


def _call(builder: Any, name: str, result: Any, args: Any) -> Any:
    function_type = ir.FunctionType(result, [a.type for a in args])
    return builder.call(cgutils.get_or_insert_function(builder.module, function_type, name), args)


def _shuffle(builder: Any, left: Any, right: Any, mask: list[int]) -> Any:
    constants = ir.Constant(ir.VectorType(_INT32, len(mask)), mask)
    return builder.shuffle_vector(left, right, constants)


@intrinsic
def splat(typingctx, value):
    """All lanes equal to one number."""

    def codegen(context, builder, sig, args):
        return _splat(builder, args[0])

    return lanes_type(types.float64), codegen


@intrinsic
def load(typingctx, array, start):
    """``array[start:start + WIDTH]`` of a flat float64 array."""

    def codegen(context, builder, sig, args):
        pointer = builder.gep(_data(context, builder, sig.args[0], args[0]), [args[1]])
        return builder.load(builder.bitcast(pointer, ir.PointerType(_VECTOR)), align=8)

    return lanes_type(array, types.int64), codegen


@intrinsic
def store(typingctx, array, start, value):
    """Write ``array[start:start + WIDTH]`` of a flat float64 array."""

    def codegen(context, builder, sig, args):
        pointer = builder.gep(_data(context, builder, sig.args[0], args[0]), [args[1]])
        builder.store(args[2], builder.bitcast(pointer, ir.PointerType(_VECTOR)), align=8)

    return types.void(array, types.int64, lanes_type), codegen


def _vectors(context: Any, builder: Any, array_type: Any, array: Any, start: Any) -> Any:
    pointer = builder.gep(_data(context, builder, array_type, array), [start])
    return builder.bitcast(pointer, ir.PointerType(_VECTOR))


@intrinsic
def load_triple(typingctx, array, start):
    """Three vectors one after another in a flat float64 array."""

    def codegen(context, builder, sig, args):
        base = _vectors(context, builder, sig.args[0], *args)
        triple = [builder.load(builder.gep(base, [_INT64(k)]), align=8) for k in range(3)]
        return context.make_tuple(builder, sig.return_type, triple)

    return _TRIPLE(array, types.int64), codegen


@intrinsic
def store_triple(typingctx, array, start, x, y, z):
    """Inverse of `load_triple`."""

    def codegen(context, builder, sig, args):
        base = _vectors(context, builder, sig.args[0], *args[:2])
        for k in range(3):
            builder.store(args[2 + k], builder.gep(base, [_INT64(k)]), align=8)

    return types.void(array, types.int64, *(lanes_type,) * 3), codegen


def _pointers(context: Any, builder: Any, sig: Any, args: Any, shift: Any = None) -> list[Any]:
    """Pointers ``array + table[start + lane] + shift`` for every lane."""
    base = _data(context, builder, sig.args[0], args[0])
    if shift is not None:
        base = builder.gep(base, [shift])
    table = builder.gep(_data(context, builder, sig.args[1], args[1]), [args[2]])
    offsets = [builder.load(builder.gep(table, [_INT64(lane)])) for lane in range(WIDTH)]
    return [builder.gep(base, [builder.zext(offset, _INT64)]) for offset in offsets]


def _load_rows(context: Any, builder: Any, sig: Any, args: Any) -> list[Any]:
    """One point (x, y, z, 0) a lane.

    The mask keeps the last point of an array from reading beyond it.
    """
    rows = []
    for pointer in _pointers(context, builder, sig, args):
        source = builder.bitcast(pointer, ir.PointerType(_ROW))
        rest = ir.Constant(_ROW, [0.0] * 4)
        name = "llvm.masked.load.v4f64.p0v4f64"
        rows.append(_call(builder, name, _ROW, [source, _INT32(8), _MASK, rest]))
    return rows


def _columns(builder: Any, rows: list[Any]) -> list[Any]:
    """Vectors x, y, z of eight rows."""
    pairs = [_shuffle(builder, rows[k], rows[k + 1], list(range(8))) for k in range(0, 8, 2)]
    low_xy = _shuffle(builder, pairs[0], pairs[1], [0, 4, 8, 12, 1, 5, 9, 13])
    high_xy = _shuffle(builder, pairs[2], pairs[3], [0, 4, 8, 12, 1, 5, 9, 13])
    low_z = _shuffle(builder, pairs[0], pairs[1], [2, 6, 10, 14])
    high_z = _shuffle(builder, pairs[2], pairs[3], [2, 6, 10, 14])
    return [
        _shuffle(builder, low_xy, high_xy, [0, 1, 2, 3, 8, 9, 10, 11]),
        _shuffle(builder, low_xy, high_xy, [4, 5, 6, 7, 12, 13, 14, 15]),
        _shuffle(builder, low_z, high_z, list(range(8))),
    ]


def _rows(builder: Any, x: Any, y: Any, z: Any) -> list[Any]:
    """Eight rows (x, y, z, any) of three vectors."""
    rows = []
    for lane in range(0, WIDTH, 2):
        xy = _shuffle(builder, x, y, [lane, 8 + lane, 0, 0, lane + 1, 9 + lane, 0, 0])
        pair = _shuffle(builder, xy, z, [0, 1, 8 + lane, 0, 4, 5, 9 + lane, 0])
        rows += [_shuffle(builder, pair, pair, [4 * k + c for c in range(4)]) for k in range(2)]
    return rows


def _store_rows(context: Any, builder: Any, sig: Any, args: Any, rows: list[Any]) -> None:
    for pointer, row in zip(_pointers(context, builder, sig, args), rows, strict=True):
        front = _shuffle(builder, row, row, [0, 1])
        builder.store(front, builder.bitcast(pointer, ir.PointerType(front.type)), align=8)
        last = builder.extract_element(row, _INT32(2))
        builder.store(last, builder.gep(pointer, [_INT64(2)]), align=8)


@intrinsic
def gather(typingctx, array, table, start, shift):
    """``array[table[start + lane] + shift]`` for every lane."""

    def codegen(context, builder, sig, args):
        result = ir.Constant(_VECTOR, ir.Undefined)
        for lane, pointer in enumerate(_pointers(context, builder, sig, args, args[3])):
            result = builder.insert_element(result, builder.load(pointer, align=8), _INT32(lane))
        return result

    return lanes_type(array, table, types.int64, types.int64), codegen


@intrinsic
def scatter(typingctx, array, table, start, shift, value):
    """Inverse of `gather`; lanes that repeat an entry must hold equal values."""

    def codegen(context, builder, sig, args):
        for lane, pointer in enumerate(_pointers(context, builder, sig, args, args[3])):
            builder.store(builder.extract_element(args[4], _INT32(lane)), pointer, align=8)

    return types.void(array, table, types.int64, types.int64, lanes_type), codegen


@intrinsic
def gather_points(typingctx, points, table, start):
    """Coordinates (x, y, z) of the points at the offsets ``table[start + lane]``."""

    def codegen(context, builder, sig, args):
        columns = _columns(builder, _load_rows(context, builder, sig, args))
        return context.make_tuple(builder, sig.return_type, columns)

    return _TRIPLE(points, table, types.int64), codegen


@intrinsic
def keep_points(typingctx, points, table, start, undo, saved):
    """`gather_points`, with a copy of the three vectors from ``undo[saved]`` on."""

    def codegen(context, builder, sig, args):
        columns = _columns(builder, _load_rows(context, builder, sig, args))
        base = _vectors(context, builder, sig.args[3], *args[3:])
        for k, column in enumerate(columns):
            builder.store(column, builder.gep(base, [_INT64(k)]), align=8)
        return context.make_tuple(builder, sig.return_type, columns)

    return _TRIPLE(points, table, types.int64, undo, types.int64), codegen


@intrinsic
def gather_differences(typingctx, points, table, start, other):
    """Coordinates of the points at `start` minus those at `other`."""

    def codegen(context, builder, sig, args):
        left = _load_rows(context, builder, sig, args)
        right = _load_rows(context, builder, sig, [args[0], args[1], args[3]])
        rows = [builder.fsub(a, b, flags=_FLAGS) for a, b in zip(left, right, strict=True)]
        return context.make_tuple(builder, sig.return_type, _columns(builder, rows))

    return _TRIPLE(points, table, types.int64, types.int64), codegen


@intrinsic
def scatter_points(typingctx, points, table, start, x, y, z):
    """Inverse of `gather_points`; lanes that repeat a point must agree."""

    def codegen(context, builder, sig, args):
        _store_rows(context, builder, sig, args, _rows(builder, *args[3:]))

    return types.void(points, table, types.int64, *(lanes_type,) * 3), codegen


def _unary(name: str) -> Callable[..., Any]:
    @intrinsic
    def function(typingctx, value):
        def codegen(context, builder, sig, args):
            return _call(builder, f"llvm.{name}.v{WIDTH}f64", _VECTOR, args)

        return lanes_type(lanes_type), codegen

    return function


absolute = _unary("fabs")
nearest = _unary("rint")
square_root = _unary("sqrt")


def _reduced(builder: Any, test: Any) -> Any:
    return builder.bitcast(test, ir.IntType(WIDTH))


@intrinsic
def all_within(typingctx, value, bound):
    """Whether ``value <= bound`` in every lane; false where either is NaN."""

    def codegen(context, builder, sig, args):
        value, limit = (_splat(builder, a) for a in args)
        bits = _reduced(builder, builder.fcmp_ordered("<=", value, limit))
        return builder.icmp_unsigned("==", bits, ir.Constant(bits.type, 2**WIDTH - 1))

    return types.boolean(value, bound), codegen


@intrinsic
def where_zero(typingctx, test, value, otherwise):
    """``value`` in the lanes where ``test`` is zero, else ``otherwise``."""

    def codegen(context, builder, sig, args):
        zero = ir.Constant(_VECTOR, [0.0] * WIDTH)
        return builder.select(
            builder.fcmp_ordered("==", args[0], zero),
            _splat(builder, args[1]),
            _splat(builder, args[2]),
        )

    return lanes_type(lanes_type, value, otherwise), codegen


@intrinsic
def not_positive(typingctx, value):
    """1 in the lanes where ``value > 0`` does not hold (NaN included), else 0."""

    def codegen(context, builder, sig, args):
        zero = ir.Constant(_VECTOR, [0.0] * WIDTH)
        positive = builder.fcmp_ordered(">", args[0], zero)
        return builder.select(positive, zero, ir.Constant(_VECTOR, [1.0] * WIDTH))

    return lanes_type(lanes_type), codegen


@intrinsic
def where_greater(typingctx, left, right, value, otherwise):
    """``value`` in the lanes where ``left > right``, else ``otherwise``."""

    def codegen(context, builder, sig, args):
        return builder.select(builder.fcmp_ordered(">", args[0], args[1]), args[2], args[3])

    return lanes_type(*(lanes_type,) * 4), codegen


def _shifted(mask: list[int]) -> Callable[..., Any]:
    @intrinsic
    def function(typingctx, value):
        def codegen(context, builder, sig, args):
            return _shuffle(builder, args[0], ir.Constant(_VECTOR, [0.0] * WIDTH), mask)

        return lanes_type(lanes_type), codegen

    return function


# What the lane before, or after, holds; 0 at the end.
from_previous = _shifted([WIDTH, *range(WIDTH - 1)])
from_next = _shifted([*range(1, WIDTH + 1)])


@intrinsic
def product_difference(typingctx, a, b, c, d):
    """``a * b - c * d`` with the second product rounded, the first not.

    Spelt out, so that it gives the same number wherever it is repeated.
    """

    def codegen(context, builder, sig, args):
        a, b, c, d = args
        second = builder.fneg(builder.fmul(c, d))
        return _call(builder, f"llvm.fma.v{WIDTH}f64", _VECTOR, [a, b, second])

    return lanes_type(*(lanes_type,) * 4), codegen


@intrinsic
def stack(typingctx, entries):
    """Room for a fixed number of lane vectors, in registers where it fits."""
    if not isinstance(entries, types.IntegerLiteral):
        return None
    count = entries.literal_value

    def codegen(context, builder, sig, args):
        room = cgutils.alloca_once(builder, _VECTOR, size=_INT64(count))
        return builder.bitcast(room, context.get_value_type(sig.return_type))

    return types.CPointer(lanes_type)(entries), codegen


@intrinsic
def peek(typingctx, room, entry):
    """Entry of a `stack`."""

    def codegen(context, builder, sig, args):
        return builder.load(builder.gep(args[0], [args[1]]))

    return lanes_type(room, types.int64), codegen


@intrinsic
def poke(typingctx, room, entry, value):
    """Set an entry of a `stack`."""

    def codegen(context, builder, sig, args):
        builder.store(args[2], builder.gep(args[0], [args[1]]))

    return types.void(room, types.int64, lanes_type), codegen
