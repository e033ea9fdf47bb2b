"""Numbers two and four doubles wide for Numba kernels that work row by row; see `any_width` for all widths.

A `pair` holds what belongs to both triangles of a matrix, a `quad` a vector in space and one number more.
"""

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from kcons.solvers.kernels.any_width import (
    FLAGS,
    INT32,
    INT64,
    masked_point,
    pointer,
    reader,
    shuffle,
    vectors,
    writer,
)

_TWO, _FOUR, _LINE = vectors(2), vectors(4), vectors(8).llvm
pair_type, quad_type = _TWO.kind, _FOUR.kind

# Numbers, pairs and quads that begin at an entry of a flat float64 array.
number, put = reader(types.float64, None), writer(types.float64, None)
load_pair, store_pair = _TWO.load, _TWO.store
load_quad, store_quad = _FOUR.load, _FOUR.store


@intrinsic
def rolled(typingctx):
    """Stands in a loop of few turns and keeps the compiler from unrolling it."""

    def codegen(context, builder, sig, args):
        kind = ir.FunctionType(ir.VoidType(), [])
        nothing = ir.InlineAsm(kind, "", "", side_effect=True)
        builder.call(nothing, [], attrs=("convergent", "nounwind"))
        return context.get_dummy_value()

    return types.void(), codegen


@intrinsic
def entry(typingctx, table, start):
    """``table[start]`` of a uint32 array as int64; the table must not change while a kernel runs."""

    def codegen(context, builder, sig, args):
        value = builder.load(pointer(context, builder, sig.args[0], *args))
        value.set_metadata("invariant.load", builder.module.add_metadata([]))
        return builder.zext(value, INT64)

    return types.int64(table, types.int64), codegen


@intrinsic
def pair(typingctx, a, b):
    """The pair (a, b)."""

    def codegen(context, builder, sig, args):
        return _TWO.of(builder, args)

    return pair_type(types.float64, types.float64), codegen


@intrinsic
def quad(typingctx, a, b, c, d):
    """The quad (a, b, c, d)."""

    def codegen(context, builder, sig, args):
        return _FOUR.of(builder, args)

    return quad_type(*(types.float64,) * 4), codegen


@intrinsic
def swapped(typingctx, value):
    """(b, a) of a pair (a, b)."""

    def codegen(context, builder, sig, args):
        return shuffle(builder, args[0], args[0], [1, 0])

    return pair_type(pair_type), codegen


@intrinsic
def settled(typingctx, value):
    """The quad (a, b, 0, 0) of a pair (a, b)."""

    def codegen(context, builder, sig, args):
        return shuffle(builder, args[0], ir.Constant(_TWO.llvm, [0.0, 0.0]), [0, 1, 2, 3])

    return quad_type(pair_type), codegen


@intrinsic
def lane(typingctx, value, which):
    """One number of a pair or quad; `which` is a literal."""
    if not isinstance(which, types.IntegerLiteral):
        return None
    place = which.literal_value

    def codegen(context, builder, sig, args):
        return builder.extract_element(args[0], INT32(place))

    return types.float64(value, which), codegen


@intrinsic
def dot(typingctx, a, b):
    """Scalar product of the first three numbers of two quads."""

    def codegen(context, builder, sig, args):
        a, b = ([builder.extract_element(v, INT32(k)) for k in range(3)] for v in args)
        products = [builder.fmul(x, y, flags=FLAGS) for x, y in zip(a, b, strict=True)]
        first = builder.fadd(products[0], products[1], flags=FLAGS)
        return builder.fadd(first, products[2], flags=FLAGS)

    return types.float64(quad_type, quad_type), codegen


@intrinsic
def load_point(typingctx, points, offset):
    """(x, y, z, 0) of a point of a contiguous (N, 3) array; `offset` is three times its number."""
    if points.layout != "C":
        return None

    def codegen(context, builder, sig, args):
        return masked_point(builder, pointer(context, builder, sig.args[0], *args))

    return quad_type(points, types.int64), codegen


@intrinsic
def add_to_point(typingctx, points, offset, value):
    """Add the first three numbers of a quad to a point.

    Reads what it writes and no more: an entry written just before would hold up a wider read.
    """
    if points.layout != "C":
        return None

    def codegen(context, builder, sig, args):
        place = pointer(context, builder, sig.args[0], *args[:2])
        front = builder.bitcast(place, ir.PointerType(_TWO.llvm))
        total = builder.fadd(builder.load(front, align=8), shuffle(builder, args[2], args[2], [0, 1]), flags=FLAGS)
        builder.store(total, front, align=8)
        back = builder.gep(place, [INT64(2)])
        builder.store(builder.fadd(builder.load(back), builder.extract_element(args[2], INT32(2)), flags=FLAGS), back)
        return context.get_dummy_value()

    return types.void(points, types.int64, quad_type), codegen


# A row's line: r and s number by number, then two numbers more: r0 s0 r1 s1 r2 s2 a b.


@intrinsic
def store_line(typingctx, array, start, r, s, rest):
    """Write a row's line of two quads and the pair that follows them."""

    def codegen(context, builder, sig, args):
        vectors = shuffle(builder, args[2], args[3], [0, 4, 1, 5, 2, 6, 0, 0])
        tail = shuffle(builder, args[4], args[4], [0, 1, 0, 0, 0, 0, 0, 0])
        line = shuffle(builder, vectors, tail, [0, 1, 2, 3, 4, 5, 8, 9])
        builder.store(line, pointer(context, builder, sig.args[0], *args[:2], _LINE), align=8)

    return types.void(array, types.int64, quad_type, quad_type, pair_type), codegen


@intrinsic
def store_first(typingctx, array, start, r, rest):
    """Replace r of a row's line, and the pair behind the vectors."""

    def codegen(context, builder, sig, args):
        place = pointer(context, builder, sig.args[0], *args[:2], _LINE)
        old = builder.load(place, align=8)
        wide = shuffle(builder, args[2], args[2], [0, 1, 2, 0, 0, 0, 0, 0])
        tail = shuffle(builder, args[3], args[3], [0, 1, 0, 0, 0, 0, 0, 0])
        line = shuffle(builder, old, wide, [8, 1, 9, 3, 10, 5, 0, 0])
        builder.store(shuffle(builder, line, tail, [0, 1, 2, 3, 4, 5, 8, 9]), place, align=8)

    return types.void(array, types.int64, quad_type, pair_type), codegen


def _vector(first: int) -> Callable[..., Any]:
    @intrinsic
    def function(typingctx, array, start):
        def codegen(context, builder, sig, args):
            line = builder.load(pointer(context, builder, sig.args[0], *args, _LINE), align=8)
            zero = ir.Constant(_LINE, [0.0] * 8)
            return shuffle(builder, line, zero, [first, first + 2, first + 4, 8])

        return quad_type(array, types.int64), codegen

    return function


# r, or s, of a row's line, with 0 behind it.
first_vector = _vector(0)
second_vector = _vector(1)
