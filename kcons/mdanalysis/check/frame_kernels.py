"""Lengths in one frame of a trajectory: coordinates in single precision, statistics in double.

A frame is read once and looked at once, so that what counts is memory traffic and the number of instructions a
row: four rows at a time, whole points loaded at once, sums kept in registers, minimum images only where a vector
is long enough to need one.

What rounding of the coordinates makes of a length is told for each row by its own two atoms: the coordinates of an atom
are off by at most ``base + factor 2^e``, where 2^e is the power of two below the largest of them, and the length by
sqrt(3) times the sum of both.
"""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from kcons.solvers.kernels.nearest_image import nearest_image
from kcons.solvers.kernels.two_and_four_wide import lane, load_quad, quad, quad_type, store_quad

#: Rows a block; what needs care is done again by blocks.
BLOCK = 256
#: Rows come in multiples of this; see `padded`.
LANES = 4

_FLAGS = ("contract", "arcp", "nsz")
_INT32 = ir.IntType(32)
_INT64 = ir.IntType(64)
_SINGLES = ir.VectorType(ir.FloatType(), 4)
_DOUBLES = ir.VectorType(ir.DoubleType(), 4)
_POINT = ir.Constant(ir.VectorType(ir.IntType(1), 4), [1, 1, 1, 0])
#: All bits of a single but its sign; those of its exponent alone, which are the power of two below it.
_UNSIGNED, _EXPONENT = np.int32(0x7FFFFFFF), np.int32(0x7F800000)
#: No powers of two, where all coordinates have the same rounding.
UNIFORM = np.zeros(0, dtype=np.float32)
_ROOT_THREE = np.sqrt(3.0)


def padded(pairs: Any, targets: Any) -> tuple[Any, Any]:
    """Tables for `lengths`: both atoms, shape (2, rows rounded up), and targets of that many rows.

    Rows that fill up measure from an atom of the first row to itself and hold 0; `filled` gives them infinite slack.
    """
    n = len(pairs)
    places = np.full((2, -(-n // LANES) * LANES), pairs[0, 0] if n else 0, dtype=np.uint32)
    places[:, :n] = np.asarray(pairs, dtype=np.int64).reshape(n, 2).T
    held = np.zeros(places.shape[1])
    held[:n] = targets
    return places, held


def filled(slack: Any) -> Any:
    """Slack for `lengths` of rows rounded up: rows that fill up are never off by more."""
    result = np.full(-(-len(slack) // LANES) * LANES, np.inf)
    result[: len(slack)] = slack
    return result


def _shuffled(builder: Any, left: Any, right: Any, mask: list[int]) -> Any:
    return builder.shuffle_vector(left, right, ir.Constant(ir.VectorType(_INT32, len(mask)), mask))


def _entry(builder: Any, table: Any, k: Any, n: int) -> Any:
    return builder.load(builder.gep(table, [builder.add(k, ir.Constant(_INT64, n))]))


def _point(builder: Any, x: Any, table: Any, k: Any, n: int) -> Any:
    """The point that the (k + n)-th entry of a table leads to, as four singles of which the last is 0."""
    load = cgutils.get_or_insert_function(
        builder.module,
        ir.FunctionType(_SINGLES, [ir.PointerType(_SINGLES), _INT32, _POINT.type, _SINGLES]),
        "llvm.masked.load.v4f32.p0v4f32",
    )
    # The fourth number of a vector is not read: it lies beyond the array for the last atom.
    atom = builder.zext(_entry(builder, table, k, n), _INT64)
    pointer = builder.gep(x, [builder.mul(atom, ir.Constant(_INT64, 3))], inbounds=True)
    wide = builder.bitcast(pointer, ir.PointerType(_SINGLES))
    return builder.call(load, [wide, _INT32(4), _POINT, ir.Constant(_SINGLES, [0.0] * 4)])


def _norms(builder: Any, vectors: list[Any]) -> Any:
    """Squares of the norms of four vectors of doubles, as one vector."""
    squares = [builder.fmul(d, d, flags=_FLAGS) for d in vectors]
    halves = [
        builder.fadd(_shuffled(builder, a, b, [0, 4, 2, 6]), _shuffled(builder, a, b, [1, 5, 3, 7]), flags=_FLAGS)
        for a, b in (squares[:2], squares[2:])
    ]
    return builder.fadd(
        _shuffled(builder, halves[0], halves[1], [0, 1, 4, 5]),
        _shuffled(builder, halves[0], halves[1], [2, 3, 6, 7]),
        flags=_FLAGS,
    )


def _four_squares(on_grid: bool) -> Any:
    """Squared distances of the four pairs from the k-th on; of coordinates rounded to multiples of `step`."""

    def squares_of(context, builder, array_types, arrays, k, step):  # type: ignore[no-untyped-def]
        tables = [
            context.make_array(kind)(context, builder, a).data for kind, a in zip(array_types, arrays, strict=True)
        ]
        if on_grid:
            one = builder.fdiv(ir.Constant(ir.DoubleType(), 1.0), step)
            steps, counts = (_everywhere(builder, value) for value in (step, one))
            kind = ir.FunctionType(_DOUBLES, [_DOUBLES])
            nearest = cgutils.get_or_insert_function(builder.module, kind, "llvm.rint.v4f64")

        def point(table: Any, n: int) -> Any:
            exact = builder.fpext(_point(builder, tables[0], table, k, n), _DOUBLES)
            if on_grid:
                exact = builder.fmul(builder.call(nearest, [builder.fmul(exact, counts)]), steps)
            return exact

        return _norms(builder, [builder.fsub(point(tables[1], n), point(tables[2], n), flags=_FLAGS) for n in range(4)])

    @intrinsic
    def function(typingctx, points, first, second, k, step):  # type: ignore[no-untyped-def]
        def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
            return squares_of(context, builder, sig.args[:3], args[:3], args[3], args[4])

        return quad_type(points, first, second, types.int64, types.float64), codegen

    return function


def _everywhere(builder: Any, value: Any) -> Any:
    one = builder.insert_element(ir.Constant(_DOUBLES, ir.Undefined), value, _INT32(0))
    return _shuffled(builder, one, one, [0, 0, 0, 0])


@intrinsic
def _sums_of_powers(typingctx, powers, first, second, k):  # type: ignore[no-untyped-def]
    """Of the four pairs from the k-th on, the numbers of both atoms together."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        data, *tables = (
            context.make_array(kind)(context, builder, a).data for kind, a in zip(sig.args[:3], args[:3], strict=True)
        )
        result = ir.Constant(_SINGLES, ir.Undefined)
        for n in range(4):
            one, other = (
                builder.load(builder.gep(data, [builder.zext(_entry(builder, table, args[3], n), _INT64)]))
                for table in tables
            )
            result = builder.insert_element(result, builder.fadd(one, other), _INT32(n))
        return builder.fpext(result, _DOUBLES)

    return quad_type(powers, first, second, types.int64), codegen


@intrinsic
def _clear(typingctx, rounding, limit):  # type: ignore[no-untyped-def]
    """1 where rounding does not exceed the limit, 0 elsewhere; 1 where it is no finite number, which others see."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        coarse = builder.and_(
            builder.fcmp_ordered(">", *args),
            builder.fcmp_ordered("<", args[0], ir.Constant(_DOUBLES, [float("inf")] * 4)),
        )
        return builder.select(coarse, ir.Constant(_DOUBLES, [0.0] * 4), ir.Constant(_DOUBLES, [1.0] * 4))

    return quad_type(quad_type, quad_type), codegen


_squares = _four_squares(False)
_squares_on_grid = _four_squares(True)


def _lanewise(name: str) -> Any:
    @intrinsic
    def function(typingctx, value):  # type: ignore[no-untyped-def]
        def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
            kind = ir.FunctionType(_DOUBLES, [_DOUBLES])
            return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v4f64"), args)

        return quad_type(quad_type), codegen

    return function


_root = _lanewise("sqrt")
_size = _lanewise("fabs")


@intrinsic
def _larger(typingctx, a, b):  # type: ignore[no-untyped-def]
    """The larger of two quads, lane by lane; a NaN in the first is not seen."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return builder.select(builder.fcmp_ordered(">", *args), *args)

    return quad_type(quad_type, quad_type), codegen


@intrinsic
def _record(typingctx, most, with_it, k, value, other):  # type: ignore[no-untyped-def]
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
def _all_below(typingctx, value, limit):  # type: ignore[no-untyped-def]
    """Whether all four numbers are below `limit`; False with a NaN."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        below = builder.fcmp_ordered("<", args[0], _everywhere(builder, args[1]))
        bits = builder.bitcast(below, ir.IntType(4))
        return builder.icmp_unsigned("==", bits, ir.Constant(ir.IntType(4), 15))

    return types.boolean(quad_type, types.float64), codegen


@nb.njit(inline="always")
def _sum(q):  # type: ignore[no-untyped-def]
    return (lane(q, 0) + lane(q, 1)) + (lane(q, 2) + lane(q, 3))


@nb.njit(inline="always")
def _largest(q):  # type: ignore[no-untyped-def]
    return max(max(lane(q, 0), lane(q, 1)), max(lane(q, 2), lane(q, 3)))


@nb.njit(cache=True, nogil=True)
def coordinate(x, place, step):  # type: ignore[no-untyped-def]
    """One number of a frame, as the file holds it."""
    value = np.float64(x[place])
    if step > 0.0:
        value = np.rint(value * (1.0 / step)) * step
    return value


@nb.njit(cache=True, nogil=True)
def difference(x, i, j, limit, lattice, step):  # type: ignore[no-untyped-def]
    """Vector from the atom at offset j to that at i; its shortest image where it is not shorter than the limit."""
    dx = coordinate(x, i, step) - coordinate(x, j, step)
    dy = coordinate(x, i + 1, step) - coordinate(x, j + 1, step)
    dz = coordinate(x, i + 2, step) - coordinate(x, j + 2, step)
    if not dx * dx + dy * dy + dz * dz < limit and limit < np.inf:
        dx, dy, dz = nearest_image(dx, dy, dz, lattice)
    return dx, dy, dz


@nb.njit(cache=True, nogil=True)
def _square(x, i, j, limit, lattice, step):  # type: ignore[no-untyped-def]
    i, j = 3 * np.int64(i), 3 * np.int64(j)
    dx, dy, dz = difference(x, i, j, limit, lattice, step)
    return dx * dx + dy * dy + dz * dz


@nb.njit(inline="always")
def _four(x, first, second, k, step):  # type: ignore[no-untyped-def]
    """Squared distances of four pairs as they lie."""
    return _squares_on_grid(x, first, second, k, step) if step > 0.0 else _squares(x, first, second, k, step)


@nb.njit(inline="always")
def _images(square, x, first, second, k, limit, lattice, step):  # type: ignore[no-untyped-def]
    """Squared distances of four pairs by their shortest images."""
    if _all_below(square, limit):
        return square
    return quad(
        _square(x, first[k], second[k], limit, lattice, step),
        _square(x, first[k + 1], second[k + 1], limit, lattice, step),
        _square(x, first[k + 2], second[k + 2], limit, lattice, step),
        _square(x, first[k + 3], second[k + 3], limit, lattice, step),
    )


@nb.njit(inline="always")
def _judged(square, rounding, targets, slack, k):  # type: ignore[no-untyped-def]
    """Deviations of four rows, by how much they exceed what is allowed, and 1 where anything can be told of them."""
    held, allowed = load_quad(targets, k), load_quad(slack, k)
    clear = _clear(rounding, _larger(held, allowed))
    off = (_root(square) - held) * clear
    return off, _size(off) - rounding - allowed, clear


@nb.njit(inline="always")
def _add(sums_by_row, k, off, known, clear):  # type: ignore[no-untyped-def]
    total, rounded, counted = sums_by_row[0], sums_by_row[1], sums_by_row[2]
    store_quad(total, k, load_quad(total, k) + off)
    store_quad(rounded, k, load_quad(rounded, k) + known)
    store_quad(counted, k, load_quad(counted, k) + clear)


@nb.njit(inline="always")
def _place(q, most, k):  # type: ignore[no-untyped-def]
    """Number of the first of four rows from the k-th on that reaches `most`; -1 if none does."""
    for n, value in enumerate((lane(q, 0), lane(q, 1), lane(q, 2), lane(q, 3))):
        if value >= most:
            return k + n
    return -1


@nb.njit(cache=True, nogil=True)
def powers_below(x, powers):  # type: ignore[no-untyped-def]
    """The power of two below the largest coordinate of each atom; infinity where that is no number.

    Parameters
    ----------
    x : ndarray of float32, shape (3 n_atoms,)
    powers : ndarray of float32, shape (n_atoms,)
        Filled.
    """
    bits, result = x.view(np.int32), powers.view(np.int32)
    for a in range(len(result)):
        one, two, three = bits[3 * a] & _UNSIGNED, bits[3 * a + 1] & _UNSIGNED, bits[3 * a + 2] & _UNSIGNED
        result[a] = max(max(one, two), three) & _EXPONENT


@nb.njit(cache=True, nogil=True)
def farthest(x):  # type: ignore[no-untyped-def]
    """Bits of the largest |x| of an array of float32; those of NaN exceed those of numbers."""
    bits = x.view(np.int32)
    most = np.int32(0)
    for a in range(len(bits)):
        most = max(most, bits[a] & _UNSIGNED)
    return most


@nb.njit(cache=True, nogil=True)
def lengths(  # type: ignore[no-untyped-def]
    x, places, targets, slack, limit, lattice, step, base, factor, powers, margins, largest, sums_by_row, summed
):
    """Deviations of all lengths in one frame.

    Rows of which rounding makes more than their target and their slack are left out: nothing can be told of them.

    Parameters
    ----------
    x : ndarray of float32, shape (3 n_atoms,)
    places, targets
        See `padded`.
    slack : ndarray, shape (rows,)
        What each row may be off by besides the rounding of its coordinates; see `filled`.
    limit : float
        Square of half the smallest width of the cell: shorter vectors are their own shortest images. Infinite
        without a cell.
    lattice : ndarray, shape (2, 3, 3)
        Cell and its inverse.
    step : float
        Grid of the coordinates in the file, such as 0.01 A of XTC; 0 if there is none.
    base, factor : float
        Rounding of coordinates, see the module.
    powers : ndarray of float32, shape (n_atoms,)
        See `powers_below`; `UNIFORM` where the factor does not matter.
    margins, largest : ndarray of float32, shape (rows,)
        Changed in place: the largest excess over rounding and slack (negative where there is none), by row, and the
        absolute deviation in the same frame.
    sums_by_row : ndarray, shape (3, rows)
        Changed in place if `summed`: sums of deviations, of roundings, and of frames, by row.
    summed : bool
        Sums by row cost memory traffic, so that large systems leave most frames out.

    Returns
    -------
    sum, sum of squares, largest absolute deviation, largest excess, its row, largest rounding, rows looked at
        The sums are NaN if any coordinate is. Rows that fill up are counted.
    """
    first, second = places[0], places[1]
    zero = quad(0.0, 0.0, 0.0, 0.0)
    low = quad(-np.inf, -np.inf, -np.inf, -np.inf)
    fixed, slope, uniform = 2 * _ROOT_THREE * base, _ROOT_THREE * factor, len(powers) == 0
    same = quad(fixed, fixed, fixed, fixed)
    rounding = same
    n = len(targets)
    sums, squares, seen, most, coarsest, worst = zero, zero, zero, zero, zero, -np.inf
    begin_of_worst = 0
    for begin in range(0, n, BLOCK):
        excess = low
        for k in range(begin, min(n, begin + BLOCK), 4):
            square = _four(x, first, second, k, step)
            if not uniform:
                rounding = _sums_of_powers(powers, first, second, k) * slope + same
            if not _all_below(square, limit):
                square = _images(square, x, first, second, k, limit, lattice, step)
            off, margin, clear = _judged(square, rounding, targets, slack, k)
            size, known = _size(off), rounding * clear
            sums, squares, seen = sums + off, squares + off * off, seen + clear
            most, coarsest = _larger(size, most), _larger(known, coarsest)
            excess = _larger(margin, excess)
            _record(margins, largest, k, margin, size)
            if summed:
                _add(sums_by_row, k, off, known, clear)
        m = _largest(excess)
        if m > worst:
            worst, begin_of_worst = m, begin
    row = -1
    for k in range(begin_of_worst, min(n, begin_of_worst + BLOCK), 4):
        square = _images(_four(x, first, second, k, step), x, first, second, k, limit, lattice, step)
        if not uniform:
            rounding = _sums_of_powers(powers, first, second, k) * slope + same
        _, margin, _ = _judged(square, rounding, targets, slack, k)
        row = _place(margin, worst, k)
        if row >= 0:
            break
    return _sum(sums), _sum(squares), _largest(most), worst, max(row, 0), _largest(coarsest), _sum(seen)


@nb.njit(cache=True, nogil=True)
def length_rates(x, v, places, n_rows, limit, lattice, step):  # type: ignore[no-untyped-def]
    """Rates of change of the lengths, u . (v_i - v_j): sum of squares, largest, its row."""
    first, second = places[0], places[1]
    squares, worst, row = 0.0, -1.0, 0
    for k in range(n_rows):
        i, j = 3 * np.int64(first[k]), 3 * np.int64(second[k])
        dx, dy, dz = difference(x, i, j, limit, lattice, step)
        along = dx * (np.float64(v[i]) - np.float64(v[j]))
        along += dy * (np.float64(v[i + 1]) - np.float64(v[j + 1]))
        along += dz * (np.float64(v[i + 2]) - np.float64(v[j + 2]))
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        rate = abs(along) / length if length > 0.0 else 0.0
        squares += rate * rate
        if rate > worst:
            worst, row = rate, k
    return squares, worst, row


@nb.njit(cache=True, nogil=True)
def kinetic(v, masses):  # type: ignore[no-untyped-def]
    """Twice the kinetic energy, and the total momentum, of one frame; `v` of shape (3 n_atoms,)."""
    twice, px, py, pz = 0.0, 0.0, 0.0, 0.0
    for a in range(len(masses)):
        m = masses[a]
        x, y, z = np.float64(v[3 * a]), np.float64(v[3 * a + 1]), np.float64(v[3 * a + 2])
        twice += m * (x * x + y * y + z * z)
        px, py, pz = px + m * x, py + m * y, pz + m * z
    return twice, px, py, pz


def coordinate_grid(x: Any, step: float) -> Any:
    """Coordinates of a frame in double precision, as the file holds them."""
    exact = np.asarray(x, dtype=np.float64)
    return np.rint(exact * (1.0 / step)) * step if step > 0 else exact


@nb.njit(cache=True, nogil=True)
def triangles(  # type: ignore[no-untyped-def]
    x, corners, targets, slack, limit, lattice, step, base, factor, powers, margins, largest, sums_by_row, summed
):
    """`lengths` of triangles, such as rigid water: each corner is loaded once.

    Parameters
    ----------
    corners : ndarray of uint32, shape (3, n)
        The corners a, b, c; n is a multiple of four.
    targets, slack, margins, largest : ndarray, shape (3, n)
        Of the sides ab, ac, bc.
    sums_by_row : ndarray, shape (3, 3, n)

    Returns
    -------
    sum, sum of squares, largest absolute deviation, largest excess, its side, its triangle, largest rounding, rows
    """
    a, b, c = corners[0], corners[1], corners[2]
    zero = quad(0.0, 0.0, 0.0, 0.0)
    low = quad(-np.inf, -np.inf, -np.inf, -np.inf)
    fixed, slope, uniform = 2 * _ROOT_THREE * base, _ROOT_THREE * factor, len(powers) == 0
    same = quad(fixed, fixed, fixed, fixed)
    of_ab, of_ac, of_bc = same, same, same
    n = targets.shape[1]
    sums, squares, seen, most, coarsest, worst = zero, zero, zero, zero, zero, -np.inf
    begin_of_worst = 0
    for begin in range(0, n, BLOCK):
        excess = low
        for k in range(begin, min(n, begin + BLOCK), 4):
            if step > 0.0:
                ab = _squares_on_grid(x, a, b, k, step)
                ac = _squares_on_grid(x, a, c, k, step)
                bc = _squares_on_grid(x, b, c, k, step)
            else:
                ab, ac, bc = _squares(x, a, b, k, step), _squares(x, a, c, k, step), _squares(x, b, c, k, step)
            if not uniform:
                of_ab = _sums_of_powers(powers, a, b, k) * slope + same
                of_ac = _sums_of_powers(powers, a, c, k) * slope + same
                of_bc = _sums_of_powers(powers, b, c, k) * slope + same
            if not _all_below(_larger(_larger(ab, ac), bc), limit):
                ab = _images(ab, x, a, b, k, limit, lattice, step)
                ac = _images(ac, x, a, c, k, limit, lattice, step)
                bc = _images(bc, x, b, c, k, limit, lattice, step)
            off_ab, margin_ab, clear_ab = _judged(ab, of_ab, targets[0], slack[0], k)
            off_ac, margin_ac, clear_ac = _judged(ac, of_ac, targets[1], slack[1], k)
            off_bc, margin_bc, clear_bc = _judged(bc, of_bc, targets[2], slack[2], k)
            size_ab, size_ac, size_bc = _size(off_ab), _size(off_ac), _size(off_bc)
            known_ab, known_ac, known_bc = of_ab * clear_ab, of_ac * clear_ac, of_bc * clear_bc
            most = _larger(_larger(size_ab, size_ac), _larger(size_bc, most))
            coarsest = _larger(_larger(known_ab, known_ac), _larger(known_bc, coarsest))
            excess = _larger(_larger(margin_ab, margin_ac), _larger(margin_bc, excess))
            sums = sums + (off_ab + off_ac) + off_bc
            seen = seen + (clear_ab + clear_ac) + clear_bc
            squares = squares + off_ab * off_ab
            squares = squares + off_ac * off_ac
            squares = squares + off_bc * off_bc
            _record(margins[0], largest[0], k, margin_ab, size_ab)
            _record(margins[1], largest[1], k, margin_ac, size_ac)
            _record(margins[2], largest[2], k, margin_bc, size_bc)
            if summed:
                _add(sums_by_row[:, 0], k, off_ab, known_ab, clear_ab)
                _add(sums_by_row[:, 1], k, off_ac, known_ac, clear_ac)
                _add(sums_by_row[:, 2], k, off_bc, known_bc, clear_bc)
        m = _largest(excess)
        if m > worst:
            worst, begin_of_worst = m, begin
    side, triangle = 0, -1
    for k in range(begin_of_worst, min(n, begin_of_worst + BLOCK), 4):
        for s in range(3):
            first, second = corners[1 if s == 2 else 0], corners[1 if s == 0 else 2]
            if triangle < 0:
                if not uniform:
                    of_ab = _sums_of_powers(powers, first, second, k) * slope + same
                square = _images(_four(x, first, second, k, step), x, first, second, k, limit, lattice, step)
                _, margin, _ = _judged(square, of_ab, targets[s], slack[s], k)
                side, triangle = s, _place(margin, worst, k)
    return _sum(sums), _sum(squares), _largest(most), worst, side, max(triangle, 0), _largest(coarsest), _sum(seen)
