"""Elimination and substitution for distance rows: the sweeps over one cluster, and the steps of Newton's method.

A row's line of eight doubles holds its vectors r and s, the accumulated change of its pivot, and its
right-hand side: r0 s0 r1 s1 r2 s2 change right. An entry's line of four doubles holds A_lk / pivot and A_kl
(k < l) and their accumulated changes, which are left at zero for the next time. `links` holds, row by row,
where its entries and its targets begin and its two ends; atoms are quads (move, inverse mass).
"""

from __future__ import annotations

from kcons.constraints.compilation import njit
from kcons.solvers.kernels.two_and_four_wide import (
    extract,
    keep_loop_rolled,
    load_double,
    load_index,
    load_pair,
    load_quad,
    pair,
    second_vector,
    settled,
    store_double,
    store_pair,
    store_quad,
    swapped,
)
from kcons.solvers.sparse.elimination import FAST
from kcons.solvers.tolerances import MAX_ITERATIONS, NEWTON_TOLERANCE, PIVOT_TOLERANCE, ROUNDINGS

#: Places of the two last numbers in a row's line.
CHANGE, RIGHT = 6, 7


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _eliminate(p, x, y, z, inverse, right, columns, couplings, state, entries):  # type: ignore[no-untyped-def]
    """Assemble entry p of a row (vectors x, y, z: s and r) and take it from its column; returns the entry."""
    l = 8 * load_index(columns, p)
    both = x * load_pair(state, l) + y * load_pair(state, l + 2) + z * load_pair(state, l + 4)
    both = load_double(couplings, p) * both + load_pair(entries, 4 * p + 2)
    low, up = inverse * extract(both, 0), extract(both, 1)
    done = pair(low, up)
    store_quad(entries, 4 * p, settled(done))
    store_pair(state, l + CHANGE, load_pair(state, l + CHANGE) - low * pair(up, right))
    return done


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def update(t, one, two, targets, entries):  # type: ignore[no-untyped-def]
    """Take the product of two entries of a row, to columns l and m, from A_ml and A_lm."""
    e = 4 * load_index(targets, t) + 2
    store_pair(entries, e, load_pair(entries, e) - swapped(one) * two)


@njit(cache=True, fastmath=FAST, error_model="numpy")
def factor(first, last, links, columns, targets, couplings, weights, state, entries, pivots):  # type: ignore[no-untyped-def]
    """Assemble and eliminate rows first to last, with forward substitution, in one sweep."""
    begin, t = load_index(links, 4 * first), load_index(links, 4 * first + 1)
    for k in range(first, last):
        x, y, z = swapped(load_pair(state, 8 * k)), swapped(load_pair(state, 8 * k + 2)), load_pair(state, 8 * k + 4)
        z = swapped(z)
        inner = extract(x, 0) * extract(x, 1) + extract(y, 0) * extract(y, 1) + extract(z, 0) * extract(z, 1)
        whole = load_double(weights, k) * inner
        d = whole + load_double(state, 8 * k + CHANGE)
        right = load_double(state, 8 * k + RIGHT)
        inverse = 1.0 / d if abs(d) > PIVOT_TOLERANCE * abs(whole) else 0.0
        store_double(pivots, k, inverse)
        end = load_index(links, 4 * k + 4)
        # Few entries are the rule; spelt out, their numbers stay in registers.
        count = end - begin
        if count == 1:
            _eliminate(begin, x, y, z, inverse, right, columns, couplings, state, entries)
        elif count == 2:
            one = _eliminate(begin, x, y, z, inverse, right, columns, couplings, state, entries)
            two = _eliminate(begin + 1, x, y, z, inverse, right, columns, couplings, state, entries)
            update(t, one, two, targets, entries)
            t += 1
        elif count == 3:
            one = _eliminate(begin, x, y, z, inverse, right, columns, couplings, state, entries)
            two = _eliminate(begin + 1, x, y, z, inverse, right, columns, couplings, state, entries)
            three = _eliminate(begin + 2, x, y, z, inverse, right, columns, couplings, state, entries)
            update(t, one, two, targets, entries)
            update(t + 1, one, three, targets, entries)
            update(t + 2, two, three, targets, entries)
            t += 3
        else:
            for p in range(begin, end):
                keep_loop_rolled()
                _eliminate(p, x, y, z, inverse, right, columns, couplings, state, entries)
            for p in range(begin, end - 1):
                keep_loop_rolled()
                mine = load_pair(entries, 4 * p)
                for q in range(p + 1, end):
                    keep_loop_rolled()
                    update(t, mine, load_pair(entries, 4 * q), targets, entries)
                    t += 1
        begin = end


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _eliminate_symmetric(p, sx, sy, sz, inverse, right, columns, couplings, state, entries):  # type: ignore[no-untyped-def]
    l = 8 * load_index(columns, p)
    inner = sx * load_double(state, l + 1) + sy * load_double(state, l + 3) + sz * load_double(state, l + 5)
    up = load_double(couplings, p) * inner + load_double(entries, 4 * p + 2)
    low = up * inverse
    store_quad(entries, 4 * p, settled(pair(low, up)))
    store_pair(state, l + CHANGE, load_pair(state, l + CHANGE) - low * pair(up, right))
    return low, up


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def _update_symmetric(t, low, up, targets, entries):  # type: ignore[no-untyped-def]
    e = 4 * load_index(targets, t) + 2
    store_double(entries, e, load_double(entries, e) - low * up)


@njit(cache=True, fastmath=FAST, error_model="numpy")
def factor_symmetric(first, last, links, columns, targets, couplings, weights, state, entries, pivots):  # type: ignore[no-untyped-def]
    """`factor` for r = s: half the work."""
    begin, t = load_index(links, 4 * first), load_index(links, 4 * first + 1)
    for k in range(first, last):
        sx, sy, sz = load_double(state, 8 * k + 1), load_double(state, 8 * k + 3), load_double(state, 8 * k + 5)
        whole = load_double(weights, k) * (sx * sx + sy * sy + sz * sz)
        d = whole + load_double(state, 8 * k + CHANGE)
        right = load_double(state, 8 * k + RIGHT)
        inverse = 1.0 / d if d > PIVOT_TOLERANCE * whole else 0.0
        store_double(pivots, k, inverse)
        end = load_index(links, 4 * k + 4)
        count = end - begin
        if count == 1:
            _eliminate_symmetric(begin, sx, sy, sz, inverse, right, columns, couplings, state, entries)
        elif count == 2:
            low, _up = _eliminate_symmetric(begin, sx, sy, sz, inverse, right, columns, couplings, state, entries)
            _low2, up2 = _eliminate_symmetric(begin + 1, sx, sy, sz, inverse, right, columns, couplings, state, entries)
            _update_symmetric(t, low, up2, targets, entries)
            t += 1
        elif count == 3:
            low, _up = _eliminate_symmetric(begin, sx, sy, sz, inverse, right, columns, couplings, state, entries)
            low2, up2 = _eliminate_symmetric(begin + 1, sx, sy, sz, inverse, right, columns, couplings, state, entries)
            _low3, up3 = _eliminate_symmetric(begin + 2, sx, sy, sz, inverse, right, columns, couplings, state, entries)
            _update_symmetric(t, low, up2, targets, entries)
            _update_symmetric(t + 1, low, up3, targets, entries)
            _update_symmetric(t + 2, low2, up3, targets, entries)
            t += 3
        else:
            for p in range(begin, end):
                keep_loop_rolled()
                _eliminate_symmetric(p, sx, sy, sz, inverse, right, columns, couplings, state, entries)
            for p in range(begin, end - 1):
                keep_loop_rolled()
                low = load_double(entries, 4 * p)
                for q in range(p + 1, end):
                    keep_loop_rolled()
                    _update_symmetric(t, low, load_double(entries, 4 * q + 1), targets, entries)
                    t += 1
        begin = end


@njit(cache=True, fastmath=FAST, error_model="numpy")
def forward(first, last, links, columns, state, entries):  # type: ignore[no-untyped-def]
    """Forward substitution with the factor kept from before."""
    begin = load_index(links, 4 * first)
    for k in range(first, last):
        right = load_double(state, 8 * k + RIGHT)
        end = load_index(links, 4 * k + 4)
        for p in range(begin, end):
            keep_loop_rolled()
            l = 8 * load_index(columns, p) + RIGHT
            store_double(state, l, load_double(state, l) - load_double(entries, 4 * p) * right)
        begin = end


@njit(cache=True, fastmath=FAST, error_model="numpy")
def backward(first, last, links, columns, state, entries, pivots, moves, solution):  # type: ignore[no-untyped-def]
    """Backward substitution; adds to the multipliers and moves the atoms along s in the same sweep."""
    end = load_index(links, 4 * last)
    for back in range(last - first):
        k = last - 1 - back
        # The whole line is read before a part of it is written: the other way round the processor waits.
        s = second_vector(state, 8 * k)
        step = load_double(state, 8 * k + RIGHT)
        begin = load_index(links, 4 * k)
        for p in range(begin, end):
            keep_loop_rolled()
            step -= load_double(entries, 4 * p + 1) * load_double(state, 8 * load_index(columns, p) + RIGHT)
        end = begin
        step *= load_double(pivots, k)
        store_double(state, 8 * k + RIGHT, step)
        store_double(solution, k, load_double(solution, k) + step)
        i, j = 4 * load_index(links, 4 * k + 2), 4 * load_index(links, 4 * k + 3)
        store_quad(moves, i, load_quad(moves, i) + (step * load_double(moves, i + 3)) * s)
        store_quad(moves, j, load_quad(moves, j) - (step * load_double(moves, j + 3)) * s)


# -- control of the steps, whatever the rows are; a step may reuse the factor of the one before ---------------

# Spliced into the loops: what is called there from them, with arrays, costs small clusters a sixth of their time.


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def hopeless(iteration, error, previous):  # type: ignore[no-untyped-def]
    """Whether Newton runs away, or has had its time."""
    return iteration >= MAX_ITERATIONS or error > 1e6 * max(previous, 1.0)


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def stalled(iteration, error, previous, excess, n_rows):  # type: ignore[no-untyped-def]
    """Whether nothing is to be gained, where the largest residual is `excess` roundings."""
    return iteration > 4 and error > 0.1 * previous and excess * excess <= ROUNDINGS * ROUNDINGS * n_rows


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def factor_serves(factored, error, previous):  # type: ignore[no-untyped-def]
    """Whether a step with the factor there is gains enough for its lower price."""
    ratio = error / previous
    return factored and (error * ratio <= NEWTON_TOLERANCE or ratio < 1e-4)


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def refines(iteration, error, previous, allowed):  # type: ignore[no-untyped-def]
    """Whether one refinement of tangents more is worth it: as long as it helps; the least error is accepted."""
    return not (error <= allowed or iteration > 8 or not (error < 0.5 * previous))
