"""Distance rows of any connectivity.

Works on relative quantities: displacements of the cluster's atoms, and bond vectors made from them. A row's line of
eight doubles holds its vectors r and s, the accumulated change of its pivot, and its right-hand side: r0 s0 r1 s1 r2 s2
change right. `links` ends with a row's two ends.
"""

from __future__ import annotations

from collections import namedtuple

import numpy as np
from numpy.typing import NDArray

from kcons.constraints.compilation import njit, plain_if_small
from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.solvers.addressable_solvers import Kernels
from kcons.solvers.distance_clusters import resolved
from kcons.solvers.kernels.aligned_memory import in_one_array, part_of, room
from kcons.solvers.kernels.array_views import at_first, at_piece, halves, integers, table_array
from kcons.solvers.kernels.lattices import OPEN, TRICLINIC, lattice_numbers, minimum_image
from kcons.solvers.kernels.two_and_four_wide import (
    dot,
    extract,
    first_vector,
    keep_loop_rolled,
    load_double,
    load_index,
    load_pair,
    load_point,
    load_quad,
    pair,
    quad,
    second_vector,
    settled,
    store_double,
    store_first,
    store_line,
    store_pair,
    store_quad,
    swapped,
)
from kcons.solvers.sparse import newton
from kcons.solvers.sparse.elimination import FAST, make_pattern, number_atoms
from kcons.solvers.sparse.newton import (
    SparseSolver,
    apply,
    common_pieces,
    eliminate_columns,
    solve_positions,
    solve_tangents,
    substitute_back,
    substitute_forward,
    update,
)
from kcons.solvers.tolerances import EPS, PIVOT_TOLERANCE, ROUNDING

#: Numbers in a row's line, and places of the two last.
LINE, CHANGE, RIGHT = 8, 6, 7
#: The pieces behind those that all tables have: inverse masses, couplings of entries and weights of rows, atoms and
#: lengths of rows, where rows began, and where atoms were.
_W, _COUPLINGS, _WEIGHTS, _PAIRS, _LENGTHS, _STARTS, _PLACES = range(newton.COMMON, newton.COMMON + 7)


class SparseDistances(SparseSolver):
    """Solver for distance rows in clusters of any shape.

    Parameters
    ----------
    rows : ndarray of int64, shape (n_rows,)
        Row numbers in the set; whole clusters only.
    pairs : ndarray of int64, shape (n_rows, 2)
    lengths : ndarray, shape (n_rows,)
    inverse_masses : ndarray, shape (n_atoms,)
        0 for atoms of infinite mass.
    eliminate_last : ndarray of bool, shape (n_rows,), optional
        Rows that depend on the others of their cluster, see `make_pattern`.
    """

    name = "SparseDistances"

    def __init__(
        self,
        rows: IntArray,
        pairs: IntArray,
        lengths: FloatArray,
        inverse_masses: FloatArray,
        eliminate_last: NDArray[np.bool_] | None = None,
    ) -> None:
        self._made_of = rows, pairs, lengths, inverse_masses, eliminate_last
        atoms, local = np.unique(pairs, return_inverse=True)
        local = local.reshape(pairs.shape)
        keep = inverse_masses[atoms][local] > 0
        row_start = np.concatenate([[0], np.cumsum(keep.sum(axis=1))])
        pattern = make_pattern(row_start, local[keep].astype(np.int64), len(atoms), eliminate_last)
        self.rows: IntArray = rows[pattern.order]
        pairs = pairs[pattern.order]
        numbered, atom_start, numbers = number_atoms(
            pairs.ravel(), np.arange(0, 2 * len(rows) + 1, 2), pattern.clusters, len(inverse_masses)
        )
        ends = numbers.reshape(-1, 2)
        w = inverse_masses[numbered]
        links = np.zeros((len(rows) + 1, 4), np.uint32)
        links[:, 0], links[:, 1], links[:-1, 2:] = pattern.start, pattern.target_start, ends
        couplings = plain_if_small(_couplings, len(pattern.columns))(pattern.start, pattern.columns, ends, w)
        n, n_entries, n_atoms = len(rows), len(pattern.columns), len(numbered)
        self.tables = in_one_array(
            (
                *(pattern.clusters, numbered, atom_start, room(4 * n_atoms), room(n), room(n), links.ravel()),
                *(pattern.columns, pattern.targets, room(LINE * n), room(4 * n_entries)),
                *(w, couplings, w[ends].sum(axis=1), pairs.astype(np.uint32).ravel(), lengths[pattern.order]),
                *(room(4 * n), room(4 * n_atoms)),
            )
        )
        self.kernels, self.numbers = Kernels(_positions, _tangents, apply, resolved=_resolved), np.zeros(3)
        self._solution = part_of(self.tables, newton.SOLUTION)
        self._bonds = part_of(self.tables, newton.STATE).reshape(-1, LINE)[:, 1:6:2]

    @property
    def lengths(self) -> FloatArray:
        """Lengths used where a request names none, in the order of `rows`."""
        lengths: FloatArray = part_of(self.tables, _LENGTHS)
        return lengths

    def _multipliers(self) -> FloatArray:
        # The kernels' are those of s . r, and not of |r| - d.
        found: FloatArray = np.sqrt(np.einsum("ki,ki->k", self._bonds, self._bonds))
        found *= self._solution
        return found


# -- elimination and substitution ----------------------------------------------------------------------------

_Pieces = namedtuple(  # type: ignore[misc]
    "_Pieces", newton.COMMON_NAMES + " w couplings weights starts places wanted x ref cell periodic driven"
)


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _eliminate(k, x, y, z, inverse, right, p):
    """Assemble entry k of a row (vectors x, y, z: s and r) and take it from its column; returns the entry."""
    l, state = LINE * load_index(p.columns, k), p.state
    both = x * load_pair(state, l) + y * load_pair(state, l + 2) + z * load_pair(state, l + 4)
    both = load_double(p.couplings, k) * both + load_pair(p.entries, 4 * k + 2)
    low, up = inverse * extract(both, 0), extract(both, 1)
    done = pair(low, up)
    store_quad(p.entries, 4 * k, settled(done))
    store_pair(state, l + CHANGE, load_pair(state, l + CHANGE) - low * pair(up, right))
    return done


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _factor(p, first, last):
    """Assemble and eliminate rows first to last, with forward substitution, in one sweep."""
    links, state, targets, entries = p.links, p.state, p.targets, p.entries
    begin, t = load_index(links, 4 * first), load_index(links, 4 * first + 1)
    for k in range(first, last):
        line = LINE * k
        x, y, z = swapped(load_pair(state, line)), swapped(load_pair(state, line + 2)), load_pair(state, line + 4)
        z = swapped(z)
        inner = extract(x, 0) * extract(x, 1) + extract(y, 0) * extract(y, 1) + extract(z, 0) * extract(z, 1)
        whole = load_double(p.weights, k) * inner
        d = whole + load_double(state, line + CHANGE)
        right = load_double(state, line + RIGHT)
        inverse = 1.0 / d if abs(d) > PIVOT_TOLERANCE * abs(whole) else 0.0
        store_double(p.pivots, k, inverse)
        end = load_index(links, 4 * k + 4)
        # Few entries are the rule; spelt out, their numbers stay in registers.
        count = end - begin
        if count == 1:
            _eliminate(begin, x, y, z, inverse, right, p)
        elif count == 2:
            one = _eliminate(begin, x, y, z, inverse, right, p)
            two = _eliminate(begin + 1, x, y, z, inverse, right, p)
            update(t, one, two, targets, entries)
            t += 1
        elif count == 3:
            one = _eliminate(begin, x, y, z, inverse, right, p)
            two = _eliminate(begin + 1, x, y, z, inverse, right, p)
            three = _eliminate(begin + 2, x, y, z, inverse, right, p)
            update(t, one, two, targets, entries)
            update(t + 1, one, three, targets, entries)
            update(t + 2, two, three, targets, entries)
            t += 3
        else:
            for e in range(begin, end):
                keep_loop_rolled()
                _eliminate(e, x, y, z, inverse, right, p)
            t = eliminate_columns(begin, end, t, targets, entries)
        begin = end


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _forward(p, first, last):
    substitute_forward(first, last, p.links, p.columns, p.state, p.entries, LINE)


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _backward(p, first, last):
    """Backward substitution; adds to the multipliers and moves the atoms along s in the same sweep."""
    links, moves = p.links, p.moves
    end = load_index(links, 4 * last)
    for back in range(last - first):
        k = last - 1 - back
        # The whole line is read before a part of it is written: the other way round the processor waits.
        s = second_vector(p.state, LINE * k)
        begin = load_index(links, 4 * k)
        step = substitute_back(k, begin, end, p.columns, p.state, p.entries, p.pivots, p.solution, LINE)
        end = begin
        i, j = 4 * load_index(links, 4 * k + 2), 4 * load_index(links, 4 * k + 3)
        store_quad(moves, i, load_quad(moves, i) + (step * load_double(moves, i + 3)) * s)
        store_quad(moves, j, load_quad(moves, j) - (step * load_double(moves, j + 3)) * s)


@njit(cache=True)
def _couplings(start, columns, ends, w):
    """c_kl with (A M^-1 A^T)_kl = c_kl s_k . s_l for each stored entry; 0 where there is only fill."""
    coupling = np.zeros(len(columns))
    for k in range(len(start) - 1):
        i, j = ends[k, 0], ends[k, 1]
        for e in range(start[k], start[k + 1]):
            l = columns[e]
            i2, j2 = ends[l, 0], ends[l, 1]
            total = 0.0
            if i == i2:
                total += w[i]
            if j == j2:
                total += w[j]
            if i == j2:
                total -= w[i]
            if j == i2:
                total -= w[j]
            coupling[e] = total
    return coupling


# -- what Newton's method asks for ---------------------------------------------------------------------------


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _image(vector, cell):
    x, y, z = minimum_image((extract(vector, 0), extract(vector, 1), extract(vector, 2)), cell, TRICLINIC)
    return quad(x, y, z, 0.0)


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _gather(p, first_atom, last_atom):
    """Where the atoms are, at the reference and now: as places and moves."""
    for a in range(first_atom, last_atom):
        g = 3 * load_index(p.atoms, a)
        store_quad(p.places, 4 * a, load_point(p.ref, g))
        store_quad(p.moves, 4 * a, load_point(p.x, g))


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _difference(points, k, links):
    """Between a row's two ends."""
    return load_quad(points, 4 * load_index(links, 4 * k + 2)) - load_quad(points, 4 * load_index(links, 4 * k + 3))


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _at_rest(p, first_atom, last_atom):
    for a in range(first_atom, last_atom):
        store_quad(p.moves, 4 * a, quad(0.0, 0.0, 0.0, load_double(p.w, a)))


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _begin(p, first, last, first_atom, last_atom):
    """Reference vectors s and current vectors q of a cluster, and the errors of these."""
    _gather(p, first_atom, last_atom)
    error, total = 0.0, 0.0
    for k in range(first, last):
        s, q = _difference(p.places, k, p.links), _difference(p.moves, k, p.links)
        if p.periodic:
            s, q = _image(s, p.cell), _image(q, p.cell)
        d2 = load_double(p.wanted, k) * load_double(p.wanted, k)
        miss = 0.5 * (d2 - dot(q, q))
        store_line(p.state, LINE * k, q, s, pair(0.0, miss))
        store_quad(p.starts, 4 * k, q)
        inverse = 1.0 / d2
        store_double(p.starts, 4 * k + 3, inverse)
        store_double(p.solution, k, 0.0)
        e = abs(miss) * inverse
        total += e
        error = max(error, e)
    _at_rest(p, first_atom, last_atom)
    return error, total


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _measure(p, first, last):
    """Current vectors and right-hand sides."""
    error, total = 0.0, 0.0
    for k in range(first, last):
        r = load_quad(p.starts, 4 * k) + _difference(p.moves, k, p.links)
        d2 = load_double(p.wanted, k) * load_double(p.wanted, k)
        miss = 0.5 * (d2 - dot(r, r))
        store_first(p.state, LINE * k, r, pair(0.0, miss))
        e = abs(miss) * load_double(p.starts, 4 * k + 3)
        total += e
        error = max(error, e)
    return error, total


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _size(p, k):
    return abs(load_double(p.state, LINE * k + RIGHT)) * load_double(p.starts, 4 * k + 3)


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _roundings(p, k):
    """|sigma| in parts of max(1e-14 d, 2 eps (|x_i| + |x_j|))."""
    one = load_quad(p.places, 4 * load_index(p.links, 4 * k + 2))
    two = load_quad(p.places, 4 * load_index(p.links, 4 * k + 3))
    reach, length = np.sqrt(dot(one, one)) + np.sqrt(dot(two, two)), load_double(p.wanted, k)
    return abs(load_double(p.state, LINE * k + RIGHT)) / (length * max(ROUNDING * length, 2 * EPS * reach))


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _turned(p, first, last, iteration):
    """The first bond that has turned by 90 degrees or more within the step; -1 if none has."""
    for k in range(first, last):
        if not (dot(first_vector(p.state, LINE * k), second_vector(p.state, LINE * k)) > 0.0):
            return k
    return -1


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _begin_tangents(p, first, last, first_atom, last_atom):
    """Vectors s, relative velocities u, and what is wanted of these along s."""
    _gather(p, first_atom, last_atom)
    largest, total = 0.0, 0.0
    for k in range(first, last):
        s, u = _difference(p.places, k, p.links), _difference(p.moves, k, p.links)
        if p.periodic:
            s = _image(s, p.cell)
        s2 = dot(s, s)
        goal = load_double(p.wanted, k) * np.sqrt(s2) if p.driven else 0.0
        miss = goal - dot(s, u) if s2 > 0.0 else np.inf
        store_line(p.state, LINE * k, s, s, pair(0.0, miss))
        store_quad(p.starts, 4 * k, u)
        store_double(p.starts, 4 * k + 3, goal)
        size = dot(u, u) * s2 + goal * goal
        largest = max(largest, size)
        total += size + abs(miss)
        store_double(p.solution, k, 0.0)
    _at_rest(p, first_atom, last_atom)
    return np.sqrt(largest), total


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _measure_tangents(p, first, last):
    error, total = 0.0, 0.0
    for k in range(first, last):
        u = load_quad(p.starts, 4 * k) + _difference(p.moves, k, p.links)
        miss = load_double(p.starts, 4 * k + 3) - dot(second_vector(p.state, LINE * k), u)
        store_double(p.state, LINE * k + RIGHT, miss)
        total += abs(miss)
        error = max(error, abs(miss))
    return error, total


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _speed(p, k):
    return abs(load_double(p.state, LINE * k + RIGHT))


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _pieces(tables, wanted, x, x_ref, lattice, kind, driven):
    t, h = tables, integers(tables)
    atoms, moves, solution, pivots, links, columns, targets, state, entries = common_pieces(tables)
    return _Pieces(
        atoms, moves, solution, pivots, links, columns, targets, state, entries, at_piece(t, h, _W),
        at_piece(t, h, _COUPLINGS), at_piece(t, h, _WEIGHTS), at_piece(t, h, _STARTS), at_piece(t, h, _PLACES), wanted,
        at_first(x), at_first(x_ref), lattice_numbers(lattice), kind != OPEN, driven,
    )  # fmt: skip


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _positions(alone, x_new, x_ref, velocities, inv_dt, wanted, lattice, kind, tables, numbers):
    lengths = at_first(wanted) if wanted.size else at_piece(tables, integers(tables), _LENGTHS)
    p = _pieces(tables, lengths, x_new, x_ref, lattice, kind, False)
    return solve_positions(
        alone, x_new, velocities, inv_dt, tables, p, _begin, _measure, _size, _roundings, _factor, _forward, _backward,
        _turned,
    )  # fmt: skip


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _tangents(alone, y, x, velocities, inv_dt, wanted, lattice, kind, tables, numbers):
    p = _pieces(tables, at_first(wanted), y, x, lattice, kind, wanted.size > 0)
    return solve_tangents(alone, y, tables, p, _begin_tangents, _measure_tangents, _speed, _factor, _forward, _backward)


@njit(cache=True, fastmath=FAST)
def _resolved(x, lattice, kind, tables):
    h = integers(tables)
    return resolved(x, table_array(halves(tables), h, _PAIRS), table_array(tables, h, _LENGTHS), lattice, kind)
