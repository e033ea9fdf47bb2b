"""Four rows at a time: what the loops over rows need of vectors of four numbers, as LLVM has them."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from kcons.solvers.kernels.any_width import FLAGS, INT32, INT64, POINT_MASK, call, shuffle, vectors

_FOUR = vectors(4)
quad_type, _DOUBLES = _FOUR.kind, _FOUR.llvm
_SINGLES = ir.VectorType(ir.FloatType(), 4)


def _entry(builder: Any, table: Any, k: Any, n: int) -> Any:
    return builder.load(builder.gep(table, [builder.add(k, ir.Constant(INT64, n))]))


def _point(builder: Any, x: Any, table: Any, k: Any, n: int) -> Any:
    """The point that the (k + n)-th entry of a table leads to, as four singles of which the last is 0."""
    # The fourth number of a vector is not read: it lies beyond the array for the last atom.
    atom = builder.zext(_entry(builder, table, k, n), INT64)
    pointer = builder.gep(x, [builder.mul(atom, ir.Constant(INT64, 3))], inbounds=True)
    wide = builder.bitcast(pointer, ir.PointerType(_SINGLES))
    rest = ir.Constant(_SINGLES, [0.0] * 4)
    return call(builder, "llvm.masked.load.v4f32.p0v4f32", _SINGLES, [wide, INT32(4), POINT_MASK, rest])


def _norms(builder: Any, vectors: list[Any]) -> Any:
    """Squares of the norms of four vectors of doubles, as one vector."""
    squares = [builder.fmul(d, d, flags=FLAGS) for d in vectors]
    halves = [
        builder.fadd(shuffle(builder, a, b, [0, 4, 2, 6]), shuffle(builder, a, b, [1, 5, 3, 7]), flags=FLAGS)
        for a, b in (squares[:2], squares[2:])
    ]
    return builder.fadd(
        shuffle(builder, halves[0], halves[1], [0, 1, 4, 5]),
        shuffle(builder, halves[0], halves[1], [2, 3, 6, 7]),
        flags=FLAGS,
    )


def _four_squares(on_grid: bool) -> Any:
    """Squared distances of the four pairs from the k-th on; of coordinates rounded to multiples of `step`."""

    def squares_of(context, builder, array_types, arrays, k, step):  # type: ignore[no-untyped-def]
        tables = [
            context.make_array(kind)(context, builder, a).data for kind, a in zip(array_types, arrays, strict=True)
        ]
        if on_grid:
            one = builder.fdiv(ir.Constant(ir.DoubleType(), 1.0), step)
            steps, counts = (_FOUR.splat(builder, value) for value in (step, one))

        def point(table: Any, n: int) -> Any:
            exact = builder.fpext(_point(builder, tables[0], table, k, n), _DOUBLES)
            if on_grid:
                exact = builder.fmul(call(builder, "llvm.rint.v4f64", _DOUBLES, [builder.fmul(exact, counts)]), steps)
            return exact

        return _norms(builder, [builder.fsub(point(tables[1], n), point(tables[2], n), flags=FLAGS) for n in range(4)])

    @intrinsic
    def function(typingctx, points, first, second, k, step):  # type: ignore[no-untyped-def]
        def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
            return squares_of(context, builder, sig.args[:3], args[:3], args[3], args[4])

        return quad_type(points, first, second, types.int64, types.float64), codegen

    return function


@intrinsic
def sums_of_powers(typingctx, powers, first, second, k):  # type: ignore[no-untyped-def]
    """Of the four pairs from the k-th on, the numbers of both atoms together."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        data, *tables = (
            context.make_array(kind)(context, builder, a).data for kind, a in zip(sig.args[:3], args[:3], strict=True)
        )
        result = ir.Constant(_SINGLES, ir.Undefined)
        for n in range(4):
            one, other = (
                builder.load(builder.gep(data, [builder.zext(_entry(builder, table, args[3], n), INT64)]))
                for table in tables
            )
            result = builder.insert_element(result, builder.fadd(one, other), INT32(n))
        return builder.fpext(result, _DOUBLES)

    return quad_type(powers, first, second, types.int64), codegen


@intrinsic
def not_coarse(typingctx, rounding, limit):  # type: ignore[no-untyped-def]
    """1 where rounding does not exceed the limit, 0 elsewhere; 1 where it is no finite number, which others see."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        coarse = builder.and_(
            builder.fcmp_ordered(">", *args),
            builder.fcmp_ordered("<", args[0], ir.Constant(_DOUBLES, [float("inf")] * 4)),
        )
        return builder.select(coarse, ir.Constant(_DOUBLES, [0.0] * 4), ir.Constant(_DOUBLES, [1.0] * 4))

    return quad_type(quad_type, quad_type), codegen


four_squares = _four_squares(False)
four_squares_on_grid = _four_squares(True)


roots = _FOUR.unary("sqrt")
sizes = _FOUR.unary("fabs")


@intrinsic
def larger_of(typingctx, a, b):  # type: ignore[no-untyped-def]
    """The larger of two quads, lane by lane; a NaN in the first is not seen."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.select(builder.fcmp_ordered(">", *args), *args)

    return quad_type(quad_type, quad_type), codegen


@intrinsic
def record(typingctx, most, with_it, k, value, other):  # type: ignore[no-untyped-def]
    """Raise four numbers of a float32 array to those of a quad that are larger, and put others into another array."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        places = []
        for kind, array in zip(sig.args[:2], args[:2], strict=True):
            data = context.make_array(kind)(context, builder, array).data
            places.append(builder.bitcast(builder.gep(data, [args[2]], inbounds=True), ir.PointerType(_SINGLES)))
        new = builder.fptrunc(args[3], _SINGLES)
        old = builder.load(places[0], align=4)
        larger = builder.fcmp_ordered(">", new, old)
        bits = builder.bitcast(larger, ir.IntType(4))
        # Records become rare soon.
        with builder.if_then(builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(4), 0)), likely=False):
            builder.store(builder.select(larger, new, old), places[0], align=4)
            kept = builder.load(places[1], align=4)
            builder.store(builder.select(larger, builder.fptrunc(args[4], _SINGLES), kept), places[1], align=4)
        return context.get_dummy_value()

    return types.void(most, with_it, types.int64, quad_type, quad_type), codegen


@intrinsic
def all_below(typingctx, value, limit):  # type: ignore[no-untyped-def]
    """Whether all four numbers are below `limit`; False with a NaN."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        below = builder.fcmp_ordered("<", args[0], _FOUR.splat(builder, args[1]))
        return _FOUR.all_true(builder, below)

    return types.boolean(quad_type, types.float64), codegen
