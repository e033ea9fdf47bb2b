"""Lengths in one frame of a trajectory: coordinates in single precision, statistics in double.

A frame is read once and looked at once, so that what counts is memory traffic and the number of instructions a
row: four rows at a time, whole points loaded at once, sums kept in registers, minimum images only where a vector
is long enough to need one.
"""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from kcons.solvers.lattice import nearest_image
from kcons.solvers.narrow import lane, load_quad, quad, quad_type, store_quad

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


def padded(pairs: Any, targets: Any) -> tuple[Any, Any]:
    """Tables for `lengths`: offsets of both atoms, shape (2, rows rounded up), and targets of that many rows.

    Rows that fill up measure from atom 0 to itself, and hold 0.
    """
    n = len(pairs)
    places = np.zeros((2, -(-n // LANES) * LANES), dtype=np.uint32)
    places[:, :n] = 3 * np.asarray(pairs, dtype=np.int64).reshape(n, 2).T
    held = np.zeros(places.shape[1])
    held[:n] = targets
    return places, held


def _shuffled(builder: Any, left: Any, right: Any, mask: list[int]) -> Any:
    return builder.shuffle_vector(left, right, ir.Constant(ir.VectorType(_INT32, len(mask)), mask))


def _four_squares(on_grid: bool) -> Any:
    """Squared distances of the four pairs from the k-th on; of coordinates rounded to multiples of `step`."""

    def squares_of(context, builder, array_types, arrays, k, step):  # type: ignore[no-untyped-def]
        tables = [
            context.make_array(kind)(context, builder, a).data for kind, a in zip(array_types, arrays, strict=True)
        ]
        load = cgutils.get_or_insert_function(
            builder.module,
            ir.FunctionType(_SINGLES, [ir.PointerType(_SINGLES), _INT32, _POINT.type, _SINGLES]),
            "llvm.masked.load.v4f32.p0v4f32",
        )
        if on_grid:
            one = builder.fdiv(ir.Constant(ir.DoubleType(), 1.0), step)
            steps, counts = (_everywhere(builder, value) for value in (step, one))
            kind = ir.FunctionType(_DOUBLES, [_DOUBLES])
            nearest = cgutils.get_or_insert_function(builder.module, kind, "llvm.rint.v4f64")

        def point(table: Any, n: int) -> Any:
            # The fourth number of a vector is not read: it lies beyond the array for the last atom.
            place = builder.load(builder.gep(table, [builder.add(k, ir.Constant(_INT64, n))]))
            pointer = builder.gep(tables[0], [builder.zext(place, _INT64)], inbounds=True)
            wide = builder.bitcast(pointer, ir.PointerType(_SINGLES))
            loaded = builder.call(load, [wide, _INT32(4), _POINT, ir.Constant(_SINGLES, [0.0] * 4)])
            exact = builder.fpext(loaded, _DOUBLES)
            if on_grid:
                exact = builder.fmul(builder.call(nearest, [builder.fmul(exact, counts)]), steps)
            return exact

        squares = []
        for n in range(4):
            d = builder.fsub(point(tables[1], n), point(tables[2], n), flags=_FLAGS)
            squares.append(builder.fmul(d, d, flags=_FLAGS))
        halves = [
            builder.fadd(_shuffled(builder, a, b, [0, 4, 2, 6]), _shuffled(builder, a, b, [1, 5, 3, 7]), flags=_FLAGS)
            for a, b in (squares[:2], squares[2:])
        ]
        return builder.fadd(
            _shuffled(builder, *halves, [0, 1, 4, 5]), _shuffled(builder, *halves, [2, 3, 6, 7]), flags=_FLAGS
        )

    @intrinsic
    def function(typingctx, points, first, second, k, step):  # type: ignore[no-untyped-def]
        def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
            return squares_of(context, builder, sig.args[:3], args[:3], args[3], args[4])

        return quad_type(points, first, second, types.int64, types.float64), codegen

    return function


def _everywhere(builder: Any, value: Any) -> Any:
    one = builder.insert_element(ir.Constant(_DOUBLES, ir.Undefined), value, _INT32(0))
    return _shuffled(builder, one, one, [0, 0, 0, 0])


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
def _enlarge(typingctx, table, k, value):  # type: ignore[no-untyped-def]
    """Raise four numbers of a float32 array to those of a quad that are larger."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        place = builder.bitcast(builder.gep(data, [args[1]], inbounds=True), ir.PointerType(_SINGLES))
        new, old = builder.fptrunc(args[2], _SINGLES), builder.load(place, align=4)
        builder.store(builder.select(builder.fcmp_ordered(">", new, old), new, old), place, align=4)
        return context.get_dummy_value()

    return types.void(table, types.int64, quad_type), codegen


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
    dx, dy, dz = difference(x, i, j, limit, lattice, step)
    return dx * dx + dy * dy + dz * dz


@nb.njit(cache=True, nogil=True)
def lengths(x, places, targets, limit, lattice, step, largest, total, summed):  # type: ignore[no-untyped-def]
    """Deviations of all lengths in one frame.

    Parameters
    ----------
    x : ndarray of float32, shape (3 n_atoms,)
    places, targets
        See `padded`.
    limit : float
        Square of half the smallest width of the cell: shorter vectors are their own shortest images. Infinite
        without a cell.
    lattice : ndarray, shape (2, 3, 3)
        Cell and its inverse.
    step : float
        Grid of the coordinates in the file, such as 0.01 A of XTC; 0 if there is none.
    largest : ndarray of float32, shape (rows,)
        Changed in place: largest absolute deviation, by row.
    total : ndarray, shape (rows,)
        Changed in place if `summed`: sum of deviations, by row.
    summed : bool
        Sums by row cost memory traffic, so that large systems leave most frames out.

    Returns
    -------
    sum, sum of squares, largest absolute deviation, its row
        The sums are NaN if any coordinate is.
    """
    first, second = places[0], places[1]
    zero = quad(0.0, 0.0, 0.0, 0.0)
    n = len(targets)
    sums, squares, worst = zero, zero, -1.0
    begin_of_worst = 0
    for begin in range(0, n, BLOCK):
        most = zero
        for k in range(begin, min(n, begin + BLOCK), 4):
            square = _squares_on_grid(x, first, second, k, step) if step > 0.0 else _squares(x, first, second, k, step)
            if not _all_below(square, limit):
                square = quad(
                    _square(x, first[k], second[k], limit, lattice, step),
                    _square(x, first[k + 1], second[k + 1], limit, lattice, step),
                    _square(x, first[k + 2], second[k + 2], limit, lattice, step),
                    _square(x, first[k + 3], second[k + 3], limit, lattice, step),
                )
            off = _root(square) - load_quad(targets, k)
            size = _size(off)
            most = _larger(size, most)
            sums = sums + off
            squares = squares + off * off
            _enlarge(largest, k, size)
            if summed:
                store_quad(total, k, load_quad(total, k) + off)
        m = _largest(most)
        if m > worst:
            worst, begin_of_worst = m, begin
    row, most_of_row = begin_of_worst, -1.0
    for k in range(begin_of_worst, min(n, begin_of_worst + BLOCK)):
        off_k = abs(np.sqrt(_square(x, first[k], second[k], limit, lattice, step)) - targets[k])
        if off_k > most_of_row:
            most_of_row, row = off_k, k
    return _sum(sums), _sum(squares), worst, row


@nb.njit(cache=True, nogil=True)
def length_rates(x, v, places, n_rows, limit, lattice, step):  # type: ignore[no-untyped-def]
    """Rates of change of the lengths, u . (v_i - v_j): sum of squares, largest, its row."""
    first, second = places[0], places[1]
    squares, worst, row = 0.0, -1.0, 0
    for k in range(n_rows):
        i, j = first[k], second[k]
        dx, dy, dz = difference(x, i, j, limit, lattice, step)
        along = dx * (np.float64(v[i]) - np.float64(v[j]))
        along += dy * (np.float64(v[i + 1]) - np.float64(v[j + 1]))
        along += dz * (np.float64(v[i + 2]) - np.float64(v[j + 2]))
        rate = abs(along) / np.sqrt(dx * dx + dy * dy + dz * dz)
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


@nb.njit(cache=True, nogil=True)
def triangles(x, corners, targets, limit, lattice, step, largest, total, summed):  # type: ignore[no-untyped-def]
    """`lengths` of triangles, such as rigid water: each corner is loaded once.

    Parameters
    ----------
    corners : ndarray of uint32, shape (3, n)
        Offsets of the corners a, b, c; n is a multiple of four.
    targets, largest, total : ndarray, shape (3, n)
        Of the sides ab, ac, bc.

    Returns
    -------
    sum, sum of squares, largest absolute deviation, side, triangle
    """
    a, b, c = corners[0], corners[1], corners[2]
    zero = quad(0.0, 0.0, 0.0, 0.0)
    n = targets.shape[1]
    sums, squares, worst = zero, zero, -1.0
    begin_of_worst = 0
    for begin in range(0, n, BLOCK):
        most = zero
        for k in range(begin, min(n, begin + BLOCK), 4):
            if step > 0.0:
                ab = _squares_on_grid(x, a, b, k, step)
                ac = _squares_on_grid(x, a, c, k, step)
                bc = _squares_on_grid(x, b, c, k, step)
            else:
                ab, ac, bc = _squares(x, a, b, k, step), _squares(x, a, c, k, step), _squares(x, b, c, k, step)
            if not _all_below(_larger(_larger(ab, ac), bc), limit):
                ab = _images(ab, x, a, b, k, limit, lattice, step)
                ac = _images(ac, x, a, c, k, limit, lattice, step)
                bc = _images(bc, x, b, c, k, limit, lattice, step)
            off_ab = _root(ab) - load_quad(targets[0], k)
            off_ac = _root(ac) - load_quad(targets[1], k)
            off_bc = _root(bc) - load_quad(targets[2], k)
            size_ab, size_ac, size_bc = _size(off_ab), _size(off_ac), _size(off_bc)
            most = _larger(_larger(size_ab, size_ac), _larger(size_bc, most))
            sums = sums + (off_ab + off_ac) + off_bc
            squares = squares + off_ab * off_ab
            squares = squares + off_ac * off_ac
            squares = squares + off_bc * off_bc
            _enlarge(largest[0], k, size_ab)
            _enlarge(largest[1], k, size_ac)
            _enlarge(largest[2], k, size_bc)
            if summed:
                store_quad(total[0], k, load_quad(total[0], k) + off_ab)
                store_quad(total[1], k, load_quad(total[1], k) + off_ac)
                store_quad(total[2], k, load_quad(total[2], k) + off_bc)
        m = _largest(most)
        if m > worst:
            worst, begin_of_worst = m, begin
    side, triangle, most_of_row = 0, begin_of_worst, -1.0
    for k in range(begin_of_worst, min(n, begin_of_worst + BLOCK)):
        for s in range(3):
            i, j = corners[1 if s == 2 else 0, k], corners[1 if s == 0 else 2, k]
            size = abs(np.sqrt(_square(x, i, j, limit, lattice, step)) - targets[s, k])
            if size > most_of_row:
                most_of_row, side, triangle = size, s, k
    return _sum(sums), _sum(squares), worst, side, triangle
