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
    instruction,
    masked_point,
    place,
    shuffle,
    unpacked,
    vectors,
)

WIDTH = 8
"""Doubles a lane vector holds: one AVX-512 register, two AVX2 registers."""

FASTMATH = set(FLAGS)

_EIGHT = vectors(WIDTH)
lanes_type = _EIGHT.kind
_VECTOR = _EIGHT.llvm
TRIPLE = types.UniTuple(lanes_type, 3)
load, store = _EIGHT.load, _EIGHT.store
_ZERO = ir.Constant(_VECTOR, [0.0] * WIDTH)


@instruction(lanes_type, types.float64)
def splat(builder, value):
    """All lanes equal to one number."""
    return _EIGHT.splat(builder, value)


@instruction(TRIPLE, None, types.int64)
def load_triple(builder, array, start):
    """Three vectors one after another in a flat float64 array."""
    base = place(builder, array, start, _VECTOR)
    return [builder.load(builder.gep(base, [INT64(k)]), align=8) for k in range(3)]


def _store_triple(builder: Any, array: Any, start: Any, triple: Any) -> None:
    base = place(builder, array, start, _VECTOR)
    for k, vector in enumerate(triple):
        builder.store(vector, builder.gep(base, [INT64(k)]), align=8)


@instruction(types.void, None, types.int64, TRIPLE)
def store_triple(builder, array, start, triple):
    """Inverse of `load_triple`."""
    _store_triple(builder, array, start, unpacked(builder, triple))


def _places(builder: Any, array: Any, table: Any, start: Any, shift: Any = None) -> list[Any]:
    """Pointers ``array + table[start + lane] + shift`` for every lane."""
    base, table = place(builder, array, INT64(0) if shift is None else shift), place(builder, table, start)
    offsets = [builder.load(builder.gep(table, [INT64(lane)])) for lane in range(WIDTH)]
    return [builder.gep(base, [builder.zext(offset, INT64)]) for offset in offsets]


def _load_rows(builder: Any, points: Any, table: Any, start: Any) -> list[Any]:
    """One point (x, y, z, 0) a lane."""
    return [masked_point(builder, at) for at in _places(builder, points, table, start)]


def _columns(builder: Any, rows: list[Any], last: tuple[int, ...] = (2,)) -> list[Any]:
    """Vectors x, y and what is `last` of eight rows."""
    pairs, columns = [shuffle(builder, rows[k], rows[k + 1], list(range(8))) for k in range(0, 8, 2)], []
    for wanted in ((0, 1), last):
        mask, size = [4 * k + c for c in wanted for k in range(4)], 4 * len(wanted)
        low, high = (shuffle(builder, pairs[k], pairs[k + 1], mask) for k in (0, 2))
        for c in range(0, size, 4):
            columns.append(shuffle(builder, low, high, [*range(c, c + 4), *range(size + c, size + c + 4)]))
    return columns


def _rows(builder: Any, x: Any, y: Any, z: Any) -> list[Any]:
    """Eight rows (x, y, z, any) of three vectors."""
    rows = []
    for lane in range(0, WIDTH, 2):
        xy = shuffle(builder, x, y, [lane, 8 + lane, 0, 0, lane + 1, 9 + lane, 0, 0])
        pair = shuffle(builder, xy, z, [0, 1, 8 + lane, 0, 4, 5, 9 + lane, 0])
        rows += [shuffle(builder, pair, pair, [4 * k + c for c in range(4)]) for k in range(2)]
    return rows


@instruction(lanes_type, None, None, types.int64, types.int64)
def gather(builder, array, table, start, shift):
    """``array[table[start + lane] + shift]`` for every lane."""
    places = _places(builder, array, table, start, shift)
    return _EIGHT.of(builder, [builder.load(at, align=8) for at in places])


@instruction(types.void, None, None, types.int64, types.int64, lanes_type)
def scatter(builder, array, table, start, shift, value):
    """Inverse of `gather`; lanes that repeat an entry must hold equal values."""
    for lane, at in enumerate(_places(builder, array, table, start, shift)):
        builder.store(builder.extract_element(value, INT32(lane)), at, align=8)


@instruction(TRIPLE, None, None, types.int64)
def gather_points(builder, points, table, start):
    """Coordinates (x, y, z) of the points at the offsets ``table[start + lane]``."""
    return _columns(builder, _load_rows(builder, points, table, start))


@instruction(TRIPLE, None, None, types.int64, None, types.int64)
def keep_points(builder, points, table, start, undo, saved):
    """`gather_points`, with a copy of the three vectors from ``undo[saved]`` on."""
    columns = _columns(builder, _load_rows(builder, points, table, start))
    _store_triple(builder, undo, saved, columns)
    return columns


@instruction(TRIPLE, None, None, types.int64, types.int64)
def gather_differences(builder, points, table, start, other):
    """Coordinates of the points at `start` minus those at `other`."""
    left, right = (_load_rows(builder, points, table, at) for at in (start, other))
    return _columns(builder, [builder.fsub(a, b, flags=FLAGS) for a, b in zip(left, right, strict=True)])


@instruction(types.UniTuple(lanes_type, 4), None, None, types.int64, types.int64)
def gather_ends(builder, quads, table, start, other):
    """Of quads (x, y, z, w), those at `start` minus those at `other`; of w, which comes last, their sum."""
    quad = ir.VectorType(_VECTOR.element, 4)
    left, right = (
        [
            builder.load(builder.bitcast(at, ir.PointerType(quad)), align=8)
            for at in _places(builder, quads, table, first)
        ]
        for first in (start, other)
    )
    signs = ir.Constant(quad, [1.0, 1.0, 1.0, -1.0])
    rows = [builder.fsub(a, builder.fmul(b, signs), flags=FLAGS) for a, b in zip(left, right, strict=True)]
    return _columns(builder, rows, (2, 3))


@instruction(types.void, None, None, types.int64, TRIPLE)
def scatter_points(builder, points, table, start, found):
    """Inverse of `gather_points`; lanes that repeat a point must agree."""
    rows = _rows(builder, *unpacked(builder, found))
    for at, row in zip(_places(builder, points, table, start), rows, strict=True):
        front = shuffle(builder, row, row, [0, 1])
        builder.store(front, builder.bitcast(at, ir.PointerType(front.type)), align=8)
        builder.store(builder.extract_element(row, INT32(2)), builder.gep(at, [INT64(2)]), align=8)


absolute, square_root = _EIGHT.unary("fabs"), _EIGHT.unary("sqrt")


@instruction(types.boolean, None, None)
def all_within(builder, value, bound):
    """Whether ``value <= bound`` in every lane; false where either is NaN."""
    value, limit = _EIGHT.splat(builder, value), _EIGHT.splat(builder, bound)
    return _EIGHT.all_true(builder, builder.fcmp_ordered("<=", value, limit))


@instruction(lanes_type, lanes_type, None, None)
def where_zero(builder, test, value, otherwise):
    """``value`` in the lanes where ``test`` is zero, else ``otherwise``."""
    value, otherwise = _EIGHT.splat(builder, value), _EIGHT.splat(builder, otherwise)
    return builder.select(builder.fcmp_ordered("==", test, _ZERO), value, otherwise)


@instruction(lanes_type, lanes_type)
def not_positive(builder, value):
    """1 in the lanes where ``value > 0`` does not hold (NaN included), else 0."""
    return builder.select(builder.fcmp_ordered(">", value, _ZERO), _ZERO, ir.Constant(_VECTOR, [1.0] * WIDTH))


@instruction(lanes_type, *(lanes_type,) * 4)
def where_greater(builder, left, right, value, otherwise):
    """``value`` in the lanes where ``left > right``, else ``otherwise``."""
    return builder.select(builder.fcmp_ordered(">", left, right), value, otherwise)


def _shifted(mask: list[int]) -> Callable[..., Any]:
    @instruction(lambda value: value(value), None)
    def function(builder, value):
        if isinstance(value.type, ir.ArrayType):
            return [shuffle(builder, each, _ZERO, mask) for each in unpacked(builder, value)]
        return shuffle(builder, value, _ZERO, mask)

    return function


# What the lane before, or after, holds; 0 at the end.
from_previous, from_next = _shifted([WIDTH, *range(WIDTH - 1)]), _shifted([*range(1, WIDTH + 1)])


@instruction(TRIPLE, TRIPLE, lanes_type, TRIPLE, lanes_type)
def product_difference(builder, a, b, c, d):
    """``a * b - c * d`` for each of a and c, with the second product rounded, the first not.

    Spelt out, so that it gives the same number wherever it is repeated.
    """
    pairs = zip(unpacked(builder, a), unpacked(builder, c), strict=True)
    negative = [(x, builder.fneg(builder.fmul(y, d))) for x, y in pairs]
    return [call(builder, f"llvm.fma.v{WIDTH}f64", _VECTOR, [x, b, y]) for x, y in negative]


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


@instruction(lanes_type, None, types.int64)
def peek(builder, room, entry):
    """Entry of a `stack`."""
    return builder.load(builder.gep(room, [entry]))


@instruction(types.void, None, types.int64, lanes_type)
def poke(builder, room, entry, value):
    """Set an entry of a `stack`."""
    builder.store(value, builder.gep(room, [entry]))
