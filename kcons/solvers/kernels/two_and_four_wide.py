"""Numbers two and four doubles wide for Numba kernels that work row by row.

The narrow counterpart of `kernels.eight_wide`: a `Pair` holds what belongs to both triangles of a matrix, a
`Quad` a vector in space and one number more. Arrays are read and written without checks of the index, and
handed to intrinsics only, for the reasons given there.
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

_FLAGS = ("contract", "arcp", "nsz")
_DOUBLE = ir.DoubleType()
_INT32 = ir.IntType(32)
_INT64 = ir.IntType(64)


class PairType(types.Type):
    """Numba type of two doubles that are computed with together."""

    def __init__(self) -> None:
        super().__init__(name="Pair")


class QuadType(types.Type):
    """Numba type of four doubles that are computed with together."""

    def __init__(self) -> None:
        super().__init__(name="Quad")


pair_type = PairType()
quad_type = QuadType()
_PAIR = ir.VectorType(_DOUBLE, 2)
_QUAD = ir.VectorType(_DOUBLE, 4)
_LINE = ir.VectorType(_DOUBLE, 8)
_POINT_MASK = ir.Constant(ir.VectorType(ir.IntType(1), 4), [1, 1, 1, 0])


@register_default(PairType)
class _PairModel(models.PrimitiveModel):
    def __init__(self, manager: Any, numba_type: types.Type) -> None:
        super().__init__(manager, numba_type, _PAIR)


@register_default(QuadType)
class _QuadModel(models.PrimitiveModel):
    def __init__(self, manager: Any, numba_type: types.Type) -> None:
        super().__init__(manager, numba_type, _QUAD)


def _splat(builder: Any, value: Any, vector: Any) -> Any:
    if value.type == vector:
        return value
    one = builder.insert_element(ir.Constant(vector, ir.Undefined), value, _INT32(0))
    return _shuffle(builder, one, one, [0] * vector.count)


def _shuffle(builder: Any, left: Any, right: Any, mask: list[int]) -> Any:
    return builder.shuffle_vector(left, right, ir.Constant(ir.VectorType(_INT32, len(mask)), mask))


def _define(function: Any, instruction: str) -> None:
    cases = []
    for kind in (pair_type, quad_type):
        cases.append(signature(kind, kind, kind))
        cases.append(signature(kind, types.float64, kind))
        cases.append(signature(kind, kind, types.float64))
    infer_global(function)(type(f"_narrow_{instruction}", (ConcreteTemplate,), {"cases": cases}))

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        vector = _PAIR if sig.return_type == pair_type else _QUAD
        left, right = (_splat(builder, value, vector) for value in args)
        return getattr(builder, instruction)(left, right, flags=_FLAGS)

    for case in cases:
        lower_builtin(function, *case.args)(lower)


for _function, _instruction in ((operator.add, "fadd"), (operator.sub, "fsub"), (operator.mul, "fmul")):
    _define(_function, _instruction)


def _pointer(context: Any, builder: Any, array_type: Any, array: Any, start: Any, vector: Any = None) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    pointer = builder.gep(data, [start], inbounds=True)
    return pointer if vector is None else builder.bitcast(pointer, ir.PointerType(vector))


def _reader(vector: Any, result: Any) -> Callable[..., Any]:
    @intrinsic
    def function(typingctx, array, start):
        def codegen(context, builder, sig, args):
            return builder.load(_pointer(context, builder, sig.args[0], *args, vector), align=8)

        return result(array, types.int64), codegen

    return function


def _writer(vector: Any, kind: Any) -> Callable[..., Any]:
    @intrinsic
    def function(typingctx, array, start, value):
        def codegen(context, builder, sig, args):
            builder.store(args[2], _pointer(context, builder, sig.args[0], *args[:2], vector), align=8)

        return types.void(array, types.int64, kind), codegen

    return function


# Numbers, pairs and quads that begin at an entry of a flat float64 array.
number = _reader(None, types.float64)
load_pair = _reader(_PAIR, pair_type)
load_quad = _reader(_QUAD, quad_type)
put = _writer(None, types.float64)
store_pair = _writer(_PAIR, pair_type)
store_quad = _writer(_QUAD, quad_type)


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
        value = builder.load(_pointer(context, builder, sig.args[0], *args))
        value.set_metadata("invariant.load", builder.module.add_metadata([]))
        return builder.zext(value, _INT64)

    return types.int64(table, types.int64), codegen


def _assemble(builder: Any, vector: Any, values: Any) -> Any:
    result = ir.Constant(vector, ir.Undefined)
    for lane, value in enumerate(values):
        result = builder.insert_element(result, value, _INT32(lane))
    return result


@intrinsic
def pair(typingctx, a, b):
    """The pair (a, b)."""

    def codegen(context, builder, sig, args):
        return _assemble(builder, _PAIR, args)

    return pair_type(types.float64, types.float64), codegen


@intrinsic
def quad(typingctx, a, b, c, d):
    """The quad (a, b, c, d)."""

    def codegen(context, builder, sig, args):
        return _assemble(builder, _QUAD, args)

    return quad_type(*(types.float64,) * 4), codegen


@intrinsic
def swapped(typingctx, value):
    """(b, a) of a pair (a, b)."""

    def codegen(context, builder, sig, args):
        return _shuffle(builder, args[0], args[0], [1, 0])

    return pair_type(pair_type), codegen


@intrinsic
def settled(typingctx, value):
    """The quad (a, b, 0, 0) of a pair (a, b)."""

    def codegen(context, builder, sig, args):
        return _shuffle(builder, args[0], ir.Constant(_PAIR, [0.0, 0.0]), [0, 1, 2, 3])

    return quad_type(pair_type), codegen


@intrinsic
def lane(typingctx, value, which):
    """One number of a pair or quad; `which` is a literal."""
    if not isinstance(which, types.IntegerLiteral):
        return None
    place = which.literal_value

    def codegen(context, builder, sig, args):
        return builder.extract_element(args[0], _INT32(place))

    return types.float64(value, which), codegen


@intrinsic
def dot(typingctx, a, b):
    """Scalar product of the first three numbers of two quads."""

    def codegen(context, builder, sig, args):
        a, b = ([builder.extract_element(v, _INT32(k)) for k in range(3)] for v in args)
        products = [builder.fmul(x, y, flags=_FLAGS) for x, y in zip(a, b, strict=True)]
        first = builder.fadd(products[0], products[1], flags=_FLAGS)
        return builder.fadd(first, products[2], flags=_FLAGS)

    return types.float64(quad_type, quad_type), codegen


@intrinsic
def load_point(typingctx, points, offset):
    """(x, y, z, 0) of a point of a contiguous (N, 3) array; `offset` is three times its number."""
    if points.layout != "C":
        return None

    def codegen(context, builder, sig, args):
        pointer = _pointer(context, builder, sig.args[0], *args, _QUAD)
        return _masked(builder, "load", _QUAD, [pointer, _INT32(8), _POINT_MASK, ir.Constant(_QUAD, [0.0] * 4)])

    return quad_type(points, types.int64), codegen


@intrinsic
def add_to_point(typingctx, points, offset, value):
    """Add the first three numbers of a quad to a point.

    Reads what it writes and no more: an entry written just before would hold up a wider read.
    """
    if points.layout != "C":
        return None

    def codegen(context, builder, sig, args):
        pointer = _pointer(context, builder, sig.args[0], *args[:2])
        front = builder.bitcast(pointer, ir.PointerType(_PAIR))
        total = builder.fadd(builder.load(front, align=8), _shuffle(builder, args[2], args[2], [0, 1]), flags=_FLAGS)
        builder.store(total, front, align=8)
        back = builder.gep(pointer, [_INT64(2)])
        builder.store(builder.fadd(builder.load(back), builder.extract_element(args[2], _INT32(2)), flags=_FLAGS), back)
        return context.get_dummy_value()

    return types.void(points, types.int64, quad_type), codegen


def _masked(builder: Any, verb: str, result: Any, args: Any) -> Any:
    function_type = ir.FunctionType(result, [a.type for a in args])
    name = f"llvm.masked.{verb}.v4f64.p0v4f64"
    return builder.call(cgutils.get_or_insert_function(builder.module, function_type, name), args)


# A row's line: r and s number by number, then two numbers more: r0 s0 r1 s1 r2 s2 a b.


@intrinsic
def store_line(typingctx, array, start, r, s, rest):
    """Write a row's line of two quads and the pair that follows them."""

    def codegen(context, builder, sig, args):
        vectors = _shuffle(builder, args[2], args[3], [0, 4, 1, 5, 2, 6, 0, 0])
        tail = _shuffle(builder, args[4], args[4], [0, 1, 0, 0, 0, 0, 0, 0])
        line = _shuffle(builder, vectors, tail, [0, 1, 2, 3, 4, 5, 8, 9])
        builder.store(line, _pointer(context, builder, sig.args[0], *args[:2], _LINE), align=8)

    return types.void(array, types.int64, quad_type, quad_type, pair_type), codegen


@intrinsic
def store_first(typingctx, array, start, r, rest):
    """Replace r of a row's line, and the pair behind the vectors."""

    def codegen(context, builder, sig, args):
        pointer = _pointer(context, builder, sig.args[0], *args[:2], _LINE)
        old = builder.load(pointer, align=8)
        wide = _shuffle(builder, args[2], args[2], [0, 1, 2, 0, 0, 0, 0, 0])
        tail = _shuffle(builder, args[3], args[3], [0, 1, 0, 0, 0, 0, 0, 0])
        line = _shuffle(builder, old, wide, [8, 1, 9, 3, 10, 5, 0, 0])
        builder.store(_shuffle(builder, line, tail, [0, 1, 2, 3, 4, 5, 8, 9]), pointer, align=8)

    return types.void(array, types.int64, quad_type, pair_type), codegen


def _vector(first: int) -> Callable[..., Any]:
    @intrinsic
    def function(typingctx, array, start):
        def codegen(context, builder, sig, args):
            line = builder.load(_pointer(context, builder, sig.args[0], *args, _LINE), align=8)
            zero = ir.Constant(_LINE, [0.0] * 8)
            return _shuffle(builder, line, zero, [first, first + 2, first + 4, 8])

        return quad_type(array, types.int64), codegen

    return function


# r, or s, of a row's line, with 0 behind it.
first_vector = _vector(0)
second_vector = _vector(1)
