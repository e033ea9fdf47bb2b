"""Lengths in one frame of a trajectory: coordinates in single precision, statistics in double.

A frame is read once and looked at once, so that what counts is memory traffic and the number of instructions a
row: four rows at a time, whole points loaded at once, sums kept in registers, minimum images only where a vector
is long enough to need one.

What rounding of the coordinates makes of a length is told for each row by its own two atoms: the coordinates of an atom
are off by at most ``base + factor 2^e``, where 2^e is the power of two below the largest of them, and the length by
sqrt(3) times the sum of both.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from kcons.constraints.compilation import njit
from kcons.mdanalysis.check.frames.four_rows import (
    all_below,
    four_squares,
    four_squares_on_grid,
    larger_of,
    not_coarse,
    record,
    roots,
    sizes,
    sums_of_powers,
)
from kcons.solvers.kernels.nearest_image import nearest_image
from kcons.solvers.kernels.two_and_four_wide import lane, load_quad, quad, store_quad

#: Rows a block; what needs care is done again by blocks.
BLOCK = 256
#: Rows come in multiples of this; see `padded`.
LANES = 4

#: All bits of a single but its sign; those of its exponent alone, which are the power of two below it.
_UNSIGNED, _EXPONENT = np.int32(0x7FFFFFFF), np.int32(0x7F800000)
#: No powers of two, where all coordinates have the same rounding.
UNIFORM = np.zeros(0, dtype=np.float32)
_ROOT_THREE = np.sqrt(3.0)


class Lengths(NamedTuple):
    """Rows that are lengths, one by one or as triangles; the arrays of `triangles` have one axis more, the sides.

    Attributes
    ----------
    places : ndarray of uint32, shape (2, rows) or (3, triangles)
        Both atoms, see `padded`; or the corners a, b, c, their number a multiple of four.
    targets : ndarray, shape (rows,) or (3, triangles)
        Of triangles those of the sides ab, ac, bc.
    slack : ndarray, shape (rows,) or (3, triangles)
        What each row may be off by besides the rounding of its coordinates; see `filled`.
    margins, largest : ndarray of float32, shape (rows,) or (3, triangles)
        Changed in place: the largest excess over rounding and slack (negative where there is none), by row, and the
        absolute deviation in the same frame.
    sums : ndarray, shape (3, rows) or (3, 3, triangles)
        Changed in place where a frame counts in the sums: those of deviations, of roundings, and of frames, by row.
    """

    places: Any
    targets: Any
    slack: Any
    margins: Any
    largest: Any
    sums: Any


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


@njit(inline="always")
def _sum(q):  # type: ignore[no-untyped-def]
    return (lane(q, 0) + lane(q, 1)) + (lane(q, 2) + lane(q, 3))


@njit(inline="always")
def _largest(q):  # type: ignore[no-untyped-def]
    return max(max(lane(q, 0), lane(q, 1)), max(lane(q, 2), lane(q, 3)))


@njit(cache=True, nogil=True)
def coordinate(x, place, step):  # type: ignore[no-untyped-def]
    """One number of a frame, as the file holds it."""
    value = np.float64(x[place])
    if step > 0.0:
        value = np.rint(value * (1.0 / step)) * step
    return value


@njit(cache=True, nogil=True)
def difference(x, i, j, limit, lattice, step):  # type: ignore[no-untyped-def]
    """Vector from the atom at offset j to that at i; its shortest image where it is not shorter than the limit."""
    dx = coordinate(x, i, step) - coordinate(x, j, step)
    dy = coordinate(x, i + 1, step) - coordinate(x, j + 1, step)
    dz = coordinate(x, i + 2, step) - coordinate(x, j + 2, step)
    if not dx * dx + dy * dy + dz * dz < limit and limit < np.inf:
        dx, dy, dz = nearest_image(dx, dy, dz, lattice)
    return dx, dy, dz


@njit(cache=True, nogil=True)
def _square(x, i, j, limit, lattice, step):  # type: ignore[no-untyped-def]
    i, j = 3 * np.int64(i), 3 * np.int64(j)
    dx, dy, dz = difference(x, i, j, limit, lattice, step)
    return dx * dx + dy * dy + dz * dz


@njit(inline="always")
def _four(x, first, second, k, step):  # type: ignore[no-untyped-def]
    """Squared distances of four pairs as they lie."""
    return four_squares_on_grid(x, first, second, k, step) if step > 0.0 else four_squares(x, first, second, k, step)


@njit(inline="always")
def _images(square, x, first, second, k, limit, lattice, step):  # type: ignore[no-untyped-def]
    """Squared distances of four pairs by their shortest images."""
    if all_below(square, limit):
        return square
    return quad(
        _square(x, first[k], second[k], limit, lattice, step),
        _square(x, first[k + 1], second[k + 1], limit, lattice, step),
        _square(x, first[k + 2], second[k + 2], limit, lattice, step),
        _square(x, first[k + 3], second[k + 3], limit, lattice, step),
    )


@njit(inline="always")
def _judged(square, rounding, targets, slack, k):  # type: ignore[no-untyped-def]
    """Deviations of four rows, by how much they exceed what is allowed, and 1 where anything can be told of them."""
    held, allowed = load_quad(targets, k), load_quad(slack, k)
    clear = not_coarse(rounding, larger_of(held, allowed))
    off = (roots(square) - held) * clear
    return off, sizes(off) - rounding - allowed, clear


@njit(inline="always")
def _add(sums_by_row, k, off, known, clear):  # type: ignore[no-untyped-def]
    total, rounded, counted = sums_by_row[0], sums_by_row[1], sums_by_row[2]
    store_quad(total, k, load_quad(total, k) + off)
    store_quad(rounded, k, load_quad(rounded, k) + known)
    store_quad(counted, k, load_quad(counted, k) + clear)


@njit(inline="always")
def _place(q, most, k):  # type: ignore[no-untyped-def]
    """Number of the first of four rows from the k-th on that reaches `most`; -1 if none does."""
    for n, value in enumerate((lane(q, 0), lane(q, 1), lane(q, 2), lane(q, 3))):
        if value >= most:
            return k + n
    return -1


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def farthest(x):  # type: ignore[no-untyped-def]
    """Bits of the largest |x| of an array of float32; those of NaN exceed those of numbers."""
    bits = x.view(np.int32)
    most = np.int32(0)
    for a in range(len(bits)):
        most = max(most, bits[a] & _UNSIGNED)
    return most


@njit(cache=True, nogil=True)
def lengths(x, rows, cell, rounding, powers, summed):  # type: ignore[no-untyped-def]
    """Deviations of all lengths in one frame.

    Rows of which rounding makes more than their target and their slack are left out: nothing can be told of them.

    Parameters
    ----------
    x : ndarray of float32, shape (3 n_atoms,)
    rows : Lengths
    cell : (ndarray, float)
        Cell and its inverse, shape (2, 3, 3), and the square of half its smallest width: shorter vectors are their own
        shortest images. Infinite without a cell.
    rounding : (float, float, float)
        Grid of the coordinates in the file, such as 0.01 A of XTC, 0 if there is none; base and factor, see the module.
    powers : ndarray of float32, shape (n_atoms,)
        See `powers_below`; `UNIFORM` where the factor does not matter.
    summed : bool
        Sums by row cost memory traffic, so that large systems leave most frames out.

    Returns
    -------
    sum, sum of squares, largest absolute deviation, largest excess, its row, largest rounding, rows looked at
        The sums are NaN if any coordinate is. Rows that fill up are counted.
    """
    lattice, limit = cell
    step, base, factor = rounding
    targets, slack = rows.targets, rows.slack
    first, second = rows.places[0], rows.places[1]
    zero = quad(0.0, 0.0, 0.0, 0.0)
    low = quad(-np.inf, -np.inf, -np.inf, -np.inf)
    fixed, slope, uniform = 2 * _ROOT_THREE * base, _ROOT_THREE * factor, len(powers) == 0
    same = quad(fixed, fixed, fixed, fixed)
    known_to = same
    n = len(targets)
    sums, squares, seen, most, coarsest, worst = zero, zero, zero, zero, zero, -np.inf
    begin_of_worst = 0
    for begin in range(0, n, BLOCK):
        excess = low
        for k in range(begin, min(n, begin + BLOCK), 4):
            square = _four(x, first, second, k, step)
            if not uniform:
                known_to = sums_of_powers(powers, first, second, k) * slope + same
            if not all_below(square, limit):
                square = _images(square, x, first, second, k, limit, lattice, step)
            off, margin, clear = _judged(square, known_to, targets, slack, k)
            size, known = sizes(off), known_to * clear
            sums, squares, seen = sums + off, squares + off * off, seen + clear
            most, coarsest = larger_of(size, most), larger_of(known, coarsest)
            excess = larger_of(margin, excess)
            record(rows.margins, rows.largest, k, margin, size)
            if summed:
                _add(rows.sums, k, off, known, clear)
        m = _largest(excess)
        if m > worst:
            worst, begin_of_worst = m, begin
    row = -1
    for k in range(begin_of_worst, min(n, begin_of_worst + BLOCK), 4):
        square = _images(_four(x, first, second, k, step), x, first, second, k, limit, lattice, step)
        if not uniform:
            known_to = sums_of_powers(powers, first, second, k) * slope + same
        _, margin, _ = _judged(square, known_to, targets, slack, k)
        row = _place(margin, worst, k)
        if row >= 0:
            break
    return _sum(sums), _sum(squares), _largest(most), worst, max(row, 0), _largest(coarsest), _sum(seen)


@njit(cache=True, nogil=True)
def length_rates(x, v, places, n_rows, cell, step):  # type: ignore[no-untyped-def]
    """Rates of change of the lengths, u . (v_i - v_j): sum of squares, largest, its row."""
    lattice, limit = cell
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


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def triangles(x, rows, cell, rounding, powers, summed):  # type: ignore[no-untyped-def]
    """`lengths` of triangles, such as rigid water: each corner is loaded once.

    Returns
    -------
    sum, sum of squares, largest absolute deviation, largest excess, its side, its triangle, largest rounding, rows
    """
    lattice, limit = cell
    step, base, factor = rounding
    targets, slack, margins, largest, corners = rows.targets, rows.slack, rows.margins, rows.largest, rows.places
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
                ab = four_squares_on_grid(x, a, b, k, step)
                ac = four_squares_on_grid(x, a, c, k, step)
                bc = four_squares_on_grid(x, b, c, k, step)
            else:
                ab, ac, bc = (
                    four_squares(x, a, b, k, step),
                    four_squares(x, a, c, k, step),
                    four_squares(x, b, c, k, step),
                )
            if not uniform:
                of_ab = sums_of_powers(powers, a, b, k) * slope + same
                of_ac = sums_of_powers(powers, a, c, k) * slope + same
                of_bc = sums_of_powers(powers, b, c, k) * slope + same
            if not all_below(larger_of(larger_of(ab, ac), bc), limit):
                ab = _images(ab, x, a, b, k, limit, lattice, step)
                ac = _images(ac, x, a, c, k, limit, lattice, step)
                bc = _images(bc, x, b, c, k, limit, lattice, step)
            off_ab, margin_ab, clear_ab = _judged(ab, of_ab, targets[0], slack[0], k)
            off_ac, margin_ac, clear_ac = _judged(ac, of_ac, targets[1], slack[1], k)
            off_bc, margin_bc, clear_bc = _judged(bc, of_bc, targets[2], slack[2], k)
            size_ab, size_ac, size_bc = sizes(off_ab), sizes(off_ac), sizes(off_bc)
            known_ab, known_ac, known_bc = of_ab * clear_ab, of_ac * clear_ac, of_bc * clear_bc
            most = larger_of(larger_of(size_ab, size_ac), larger_of(size_bc, most))
            coarsest = larger_of(larger_of(known_ab, known_ac), larger_of(known_bc, coarsest))
            excess = larger_of(larger_of(margin_ab, margin_ac), larger_of(margin_bc, excess))
            sums = sums + (off_ab + off_ac) + off_bc
            seen = seen + (clear_ab + clear_ac) + clear_bc
            squares = squares + off_ab * off_ab
            squares = squares + off_ac * off_ac
            squares = squares + off_bc * off_bc
            record(margins[0], largest[0], k, margin_ab, size_ab)
            record(margins[1], largest[1], k, margin_ac, size_ac)
            record(margins[2], largest[2], k, margin_bc, size_bc)
            if summed:
                _add(rows.sums[:, 0], k, off_ab, known_ab, clear_ab)
                _add(rows.sums[:, 1], k, off_ac, known_ac, clear_ac)
                _add(rows.sums[:, 2], k, off_bc, known_bc, clear_bc)
        m = _largest(excess)
        if m > worst:
            worst, begin_of_worst = m, begin
    side, triangle = 0, -1
    for k in range(begin_of_worst, min(n, begin_of_worst + BLOCK), 4):
        for s in range(3):
            first, second = corners[1 if s == 2 else 0], corners[1 if s == 0 else 2]
            if triangle < 0:
                if not uniform:
                    of_ab = sums_of_powers(powers, first, second, k) * slope + same
                square = _images(_four(x, first, second, k, step), x, first, second, k, limit, lattice, step)
                _, margin, _ = _judged(square, of_ab, targets[s], slack[s], k)
                side, triangle = s, _place(margin, worst, k)
    return _sum(sums), _sum(squares), _largest(most), worst, side, max(triangle, 0), _largest(coarsest), _sum(seen)


@njit(cache=True, nogil=True)
def _gather(words, begin, points, powers):  # type: ignore[no-untyped-def]
    """Coordinates of a frame, atom by atom; see `powers_below`."""
    n = len(points)
    values = words.view(np.float32)
    x, y, z = values[begin + 1 :], values[begin + n + 3 :], values[begin + 2 * n + 5 :]
    for a in range(n):
        points[a, 0], points[a, 1], points[a, 2] = x[a], y[a], z[a]
    powers_below(points.reshape(-1), powers)


@njit(cache=True, nogil=True)
def look_at(words, begin, points, powers, counts, cells, rounding, corners, singles, found):  # type: ignore[no-untyped-def]
    """`triangles` and `lengths` of all frames of a block.

    Parameters
    ----------
    words, begin
        See `kcons.mdanalysis.check.files.plain_dcd.Block`.
    points : ndarray of float32, shape (n_atoms, 3)
        Room; on return the last frame that was looked at.
    powers : ndarray of float32, shape (n_atoms,)
        Room.
    counts : (int, int, int, int)
        Place of the first frame; one frame in how many counts in the sums by row, and in the reach; number of frames.
    cells : (ndarray, ndarray), shape (n_frames, 2, 3, 3), (n_frames,)
        As the cell of `lengths`; limits are NaN where the cell is.
    rounding : (float, float, float)
        See `lengths`.
    corners, singles : Lengths
    found : (ndarray, ndarray, ndarray, ndarray)
        Filled: what `lengths` returns, but the row, shape (6, n_frames); the side of the worst row, -1 where it is a
        single one, and its number; bits of the largest coordinate, see `farthest`, of frames where it counts.

    Returns
    -------
    int
        Frames until the first that is not finite.
    """
    x = points.reshape(-1)
    first, summed_every, reach_every, n_all = counts
    lattices, limits = cells
    by_frame, side, place, far = found
    has_triangles, has_singles = corners.targets.shape[1] > 0, len(singles.targets) > 0
    for f in range(len(words)):
        k = first + f
        _gather(words[f], begin, points, powers)
        summed = k % summed_every == 0
        if np.isnan(limits[f]):
            return f
        cell = (lattices[f], limits[f])
        sums, squares, worst, excess, coarsest, seen = 0.0, 0.0, 0.0, -np.inf, 0.0, 0.0
        side[f], place[f] = -1, 0
        if has_triangles:
            sums, squares, worst, excess, side[f], place[f], coarsest, seen = triangles(
                x, corners, cell, rounding, powers, summed
            )
        if has_singles:
            more, more_squares, most, more_excess, row, coarse, more_seen = lengths(
                x, singles, cell, rounding, powers, summed
            )
            sums, squares, seen = sums + more, squares + more_squares, seen + more_seen
            worst, coarsest = max(worst, most), max(coarsest, coarse)
            if more_excess > excess:
                excess, side[f], place[f] = more_excess, -1, row
        if not squares < np.inf:
            return f
        by_frame[0, f], by_frame[1, f], by_frame[2, f] = sums, squares, worst
        by_frame[3, f], by_frame[4, f], by_frame[5, f] = excess, coarsest, seen
        if k % reach_every == 0 or k == n_all - 1:
            far[f] = farthest(x)
    return len(words)
