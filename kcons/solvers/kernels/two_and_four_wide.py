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
    instruction,
    masked_point,
    place,
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


@instruction(types.void)
def rolled(builder):
    """Stands in a loop of few turns and keeps the compiler from unrolling it."""
    nothing = ir.InlineAsm(ir.FunctionType(ir.VoidType(), []), "", "", side_effect=True)
    builder.call(nothing, [], attrs=("convergent", "nounwind"))


@instruction(types.int64, None, types.int64)
def entry(builder, table, start):
    """``table[start]`` of a uint32 array as int64; the table must not change while a kernel runs."""
    value = builder.load(place(builder, table, start))
    value.set_metadata("invariant.load", builder.module.add_metadata([]))
    return builder.zext(value, INT64)


@instruction(pair_type, types.float64, types.float64)
def pair(builder, a, b):
    """The pair (a, b)."""
    return _TWO.of(builder, (a, b))


@instruction(quad_type, *(types.float64,) * 4)
def quad(builder, a, b, c, d):
    """The quad (a, b, c, d)."""
    return _FOUR.of(builder, (a, b, c, d))


@instruction(pair_type, pair_type)
def swapped(builder, value):
    """(b, a) of a pair (a, b)."""
    return shuffle(builder, value, value, [1, 0])


@instruction(quad_type, pair_type)
def settled(builder, value):
    """The quad (a, b, 0, 0) of a pair (a, b)."""
    return shuffle(builder, value, ir.Constant(_TWO.llvm, [0.0, 0.0]), [0, 1, 2, 3])


@intrinsic
def lane(typingctx, value, which):
    """One number of a pair or quad; `which` is a literal."""
    if not isinstance(which, types.IntegerLiteral):
        return None
    number = which.literal_value

    def codegen(context, builder, sig, args):
        return builder.extract_element(args[0], INT32(number))

    return types.float64(value, which), codegen


@instruction(types.float64, quad_type, quad_type)
def dot(builder, a, b):
    """Scalar product of the first three numbers of two quads."""
    products = [
        builder.fmul(*(builder.extract_element(v, INT32(k)) for v in (a, b)), flags=FLAGS)  #
        for k in range(3)
    ]
    return builder.fadd(builder.fadd(products[0], products[1], flags=FLAGS), products[2], flags=FLAGS)


@instruction(quad_type, None, types.int64)
def load_point(builder, points, offset):
    """(x, y, z, 0) of a point of an (N, 3) array; `offset` is three times its number."""
    return masked_point(builder, place(builder, points, offset))


@instruction(types.void, None, types.int64, quad_type)
def add_to_point(builder, points, offset, value):
    """Add the first three numbers of a quad to a point.

    Reads what it writes and no more: an entry written just before would hold up a wider read.
    """
    point = place(builder, points, offset)
    front = builder.bitcast(point, ir.PointerType(_TWO.llvm))
    total = builder.fadd(builder.load(front, align=8), shuffle(builder, value, value, [0, 1]), flags=FLAGS)
    builder.store(total, front, align=8)
    back = builder.gep(point, [INT64(2)])
    builder.store(builder.fadd(builder.load(back), builder.extract_element(value, INT32(2)), flags=FLAGS), back)


# A row's line: r and s number by number, then two numbers more: r0 s0 r1 s1 r2 s2 a b.


@instruction(types.void, None, types.int64, quad_type, quad_type, pair_type)
def store_line(builder, array, start, r, s, rest):
    """Write a row's line of two quads and the pair that follows them."""
    vectors = shuffle(builder, r, s, [0, 4, 1, 5, 2, 6, 0, 0])
    tail = shuffle(builder, rest, rest, [0, 1, 0, 0, 0, 0, 0, 0])
    line = shuffle(builder, vectors, tail, [0, 1, 2, 3, 4, 5, 8, 9])
    builder.store(line, place(builder, array, start, _LINE), align=8)


@instruction(types.void, None, types.int64, quad_type, pair_type)
def store_first(builder, array, start, r, rest):
    """Replace r of a row's line, and the pair behind the vectors."""
    at = place(builder, array, start, _LINE)
    old = builder.load(at, align=8)
    wide = shuffle(builder, r, r, [0, 1, 2, 0, 0, 0, 0, 0])
    tail = shuffle(builder, rest, rest, [0, 1, 0, 0, 0, 0, 0, 0])
    line = shuffle(builder, old, wide, [8, 1, 9, 3, 10, 5, 0, 0])
    builder.store(shuffle(builder, line, tail, [0, 1, 2, 3, 4, 5, 8, 9]), at, align=8)


def _vector(first: int) -> Callable[..., Any]:
    @instruction(quad_type, None, types.int64)
    def function(builder, array, start):
        line = builder.load(place(builder, array, start, _LINE), align=8)
        return shuffle(builder, line, ir.Constant(_LINE, [0.0] * 8), [first, first + 2, first + 4, 8])

    return function


# r, or s, of a row's line, with 0 behind it.
first_vector, second_vector = _vector(0), _vector(1)
