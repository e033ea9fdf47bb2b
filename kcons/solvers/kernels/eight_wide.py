"""A number eight doubles wide for Numba kernels; see `any_width` for what holds of all widths.

One lane is one cluster (`small_clusters`, `rigid_triangles`) or one piece of a chain (`chains`).
"""

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from kcons.solvers.kernels.any_width import (
    FLAGS,
    INT32,
    INT64,
    call,
    masked_point,
    pointer,
    shuffle,
    vectors,
)

WIDTH = 8
"""Doubles a lane vector holds: one AVX-512 register, two AVX2 registers."""

FASTMATH = set(FLAGS)

_EIGHT = vectors(WIDTH)
lanes_type = _EIGHT.kind
_VECTOR = _EIGHT.llvm
_TRIPLE = types.UniTuple(lanes_type, 3)
load, store = _EIGHT.load, _EIGHT.store


@intrinsic
def splat(typingctx, value):
    """All lanes equal to one number."""

    def codegen(context, builder, sig, args):
        return _EIGHT.splat(builder, args[0])

    return lanes_type(types.float64), codegen


@intrinsic
def load_triple(typingctx, array, start):
    """Three vectors one after another in a flat float64 array."""

    def codegen(context, builder, sig, args):
        base = pointer(context, builder, sig.args[0], *args, _VECTOR)
        triple = [builder.load(builder.gep(base, [INT64(k)]), align=8) for k in range(3)]
        return context.make_tuple(builder, sig.return_type, triple)

    return _TRIPLE(array, types.int64), codegen


@intrinsic
def store_triple(typingctx, array, start, x, y, z):
    """Inverse of `load_triple`."""

    def codegen(context, builder, sig, args):
        base = pointer(context, builder, sig.args[0], *args[:2], _VECTOR)
        for k in range(3):
            builder.store(args[2 + k], builder.gep(base, [INT64(k)]), align=8)

    return types.void(array, types.int64, *(lanes_type,) * 3), codegen


def _pointers(context: Any, builder: Any, sig: Any, args: Any, shift: Any = None) -> list[Any]:
    """Pointers ``array + table[start + lane] + shift`` for every lane."""
    base = pointer(context, builder, sig.args[0], args[0], INT64(0) if shift is None else shift)
    table = pointer(context, builder, sig.args[1], args[1], args[2])
    offsets = [builder.load(builder.gep(table, [INT64(lane)])) for lane in range(WIDTH)]
    return [builder.gep(base, [builder.zext(offset, INT64)]) for offset in offsets]


def _load_rows(context: Any, builder: Any, sig: Any, args: Any) -> list[Any]:
    """One point (x, y, z, 0) a lane."""
    return [masked_point(builder, place) for place in _pointers(context, builder, sig, args)]


def _columns(builder: Any, rows: list[Any]) -> list[Any]:
    """Vectors x, y, z of eight rows."""
    pairs = [shuffle(builder, rows[k], rows[k + 1], list(range(8))) for k in range(0, 8, 2)]
    low_xy = shuffle(builder, pairs[0], pairs[1], [0, 4, 8, 12, 1, 5, 9, 13])
    high_xy = shuffle(builder, pairs[2], pairs[3], [0, 4, 8, 12, 1, 5, 9, 13])
    low_z = shuffle(builder, pairs[0], pairs[1], [2, 6, 10, 14])
    high_z = shuffle(builder, pairs[2], pairs[3], [2, 6, 10, 14])
    return [
        shuffle(builder, low_xy, high_xy, [0, 1, 2, 3, 8, 9, 10, 11]),
        shuffle(builder, low_xy, high_xy, [4, 5, 6, 7, 12, 13, 14, 15]),
        shuffle(builder, low_z, high_z, list(range(8))),
    ]


def _rows(builder: Any, x: Any, y: Any, z: Any) -> list[Any]:
    """Eight rows (x, y, z, any) of three vectors."""
    rows = []
    for lane in range(0, WIDTH, 2):
        xy = shuffle(builder, x, y, [lane, 8 + lane, 0, 0, lane + 1, 9 + lane, 0, 0])
        pair = shuffle(builder, xy, z, [0, 1, 8 + lane, 0, 4, 5, 9 + lane, 0])
        rows += [shuffle(builder, pair, pair, [4 * k + c for c in range(4)]) for k in range(2)]
    return rows


def _store_rows(context: Any, builder: Any, sig: Any, args: Any, rows: list[Any]) -> None:
    for place, row in zip(_pointers(context, builder, sig, args), rows, strict=True):
        front = shuffle(builder, row, row, [0, 1])
        builder.store(front, builder.bitcast(place, ir.PointerType(front.type)), align=8)
        last = builder.extract_element(row, INT32(2))
        builder.store(last, builder.gep(place, [INT64(2)]), align=8)


@intrinsic
def gather(typingctx, array, table, start, shift):
    """``array[table[start + lane] + shift]`` for every lane."""

    def codegen(context, builder, sig, args):
        places = _pointers(context, builder, sig, args, args[3])
        return _EIGHT.of(builder, [builder.load(place, align=8) for place in places])

    return lanes_type(array, table, types.int64, types.int64), codegen


@intrinsic
def scatter(typingctx, array, table, start, shift, value):
    """Inverse of `gather`; lanes that repeat an entry must hold equal values."""

    def codegen(context, builder, sig, args):
        for lane, place in enumerate(_pointers(context, builder, sig, args, args[3])):
            builder.store(builder.extract_element(args[4], INT32(lane)), place, align=8)

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
        base = pointer(context, builder, sig.args[3], *args[3:], _VECTOR)
        for k, column in enumerate(columns):
            builder.store(column, builder.gep(base, [INT64(k)]), align=8)
        return context.make_tuple(builder, sig.return_type, columns)

    return _TRIPLE(points, table, types.int64, undo, types.int64), codegen


@intrinsic
def gather_differences(typingctx, points, table, start, other):
    """Coordinates of the points at `start` minus those at `other`."""

    def codegen(context, builder, sig, args):
        left = _load_rows(context, builder, sig, args)
        right = _load_rows(context, builder, sig, [args[0], args[1], args[3]])
        rows = [builder.fsub(a, b, flags=FLAGS) for a, b in zip(left, right, strict=True)]
        return context.make_tuple(builder, sig.return_type, _columns(builder, rows))

    return _TRIPLE(points, table, types.int64, types.int64), codegen


@intrinsic
def scatter_points(typingctx, points, table, start, x, y, z):
    """Inverse of `gather_points`; lanes that repeat a point must agree."""

    def codegen(context, builder, sig, args):
        _store_rows(context, builder, sig, args, _rows(builder, *args[3:]))

    return types.void(points, table, types.int64, *(lanes_type,) * 3), codegen


absolute = _EIGHT.unary("fabs")
nearest = _EIGHT.unary("rint")
square_root = _EIGHT.unary("sqrt")


@intrinsic
def all_within(typingctx, value, bound):
    """Whether ``value <= bound`` in every lane; false where either is NaN."""

    def codegen(context, builder, sig, args):
        value, limit = (_EIGHT.splat(builder, a) for a in args)
        return _EIGHT.all_true(builder, builder.fcmp_ordered("<=", value, limit))

    return types.boolean(value, bound), codegen


@intrinsic
def where_zero(typingctx, test, value, otherwise):
    """``value`` in the lanes where ``test`` is zero, else ``otherwise``."""

    def codegen(context, builder, sig, args):
        zero = ir.Constant(_VECTOR, [0.0] * WIDTH)
        return builder.select(
            builder.fcmp_ordered("==", args[0], zero),
            _EIGHT.splat(builder, args[1]),
            _EIGHT.splat(builder, args[2]),
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
            return shuffle(builder, args[0], ir.Constant(_VECTOR, [0.0] * WIDTH), mask)

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
        return call(builder, f"llvm.fma.v{WIDTH}f64", _VECTOR, [a, b, second])

    return lanes_type(*(lanes_type,) * 4), codegen


@intrinsic
def stack(typingctx, entries):
    """Room for a fixed number of lane vectors, in registers where it fits."""
    if not isinstance(entries, types.IntegerLiteral):
        return None
    count = entries.literal_value

    def codegen(context, builder, sig, args):
        room = cgutils.alloca_once(builder, _VECTOR, size=INT64(count))
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
