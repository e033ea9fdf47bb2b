"""Open chains of held distances, of any length.

A chain is cut into eight pieces, one a lane, of equal length. The bond between two pieces is a *separator*: once the
separators' multipliers are known, the pieces are independent. Each lane eliminates its tridiagonal piece and what
couples it to the separators at its two ends; a tridiagonal system of seven separators remains. So the division that
every pivot waits for is shared by eight rows. Short chains take one lane each, eight chains at a time.

A strip is a table of slots by lanes. A long chain is cut so that the bond from a piece to the next is the bond of its
last slot. A sweep substitutes back along the pieces, and as it passes moves the bonds, measures their residuals and
eliminates for the next Newton step in the opposite direction: a Newton step reads the chain once.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kcons.constraints.compilation import njit
from kcons.solvers.addressable_solvers import AddressableSolver, Kernels
from kcons.solvers.distance_clusters import dot, minus, plus, resolved, times
from kcons.solvers.kernels.aligned_memory import aligned, in_one_array, room
from kcons.solvers.kernels.array_views import at_first, halves, integers, octets, table_array
from kcons.solvers.kernels.eight_wide import (
    FASTMATH,
    WIDTH,
    absolute,
    all_within,
    from_next,
    from_previous,
    gather,
    gather_points,
    load,
    load_triple,
    product_difference,
    scatter_points,
    splat,
    square_root,
    store,
    store_triple,
    where_greater,
    where_zero,
)
from kcons.solvers.kernels.lattices import OPEN, lattice_numbers, minimum_image
from kcons.solvers.tolerances import CHAIN_SPEED_TOLERANCE, MAX_ITERATIONS, MAX_ROUNDS, NEWTON_TOLERANCE, TINY

# Fields of a slot: vectors of WIDTH doubles, one a lane. Slot t of a lane holds
# the bond from its atom t to t + 1; the last slot's bond is the separator.
_S, _R, _TARGET, _RIGHT, _AHEAD, _ASIDE, _FIRST, _LATER = (WIDTH * k for k in (0, 3, 6, 7, 8, 9, 10, 11))
SLOT = 12 * WIDTH
#: Of the pieces of the tables, those that are named.
_LENGTHS, _BONDS = 8, 9
#: Atoms of the longest chain that gets one lane instead of eight.
SHORT = 32


@njit(fastmath=FASTMATH, forceinline=True)
def flushed(value):
    """What couples far ends decays; as denormal numbers it would cost 300 cycles a row."""
    return where_greater(absolute(value), splat(1e-200), value, splat(0.0))


@njit(fastmath=FASTMATH)
def lane_sum(value, small):
    """Sum over the lanes."""
    store(small, 0, value)
    return small[:WIDTH].sum()


@njit(fastmath=FASTMATH)
def _reduce(small, upward):
    """Solve for the separators; `small` holds eight vectors of `WIDTH` numbers.

    0 diagonal, 1 right-hand side, and what each lane's elimination adds:
    2, 3, 4 to its head row's diagonal, right-hand side and coupling to its
    tail; 5, 6, 7 to its tail row's. The solution replaces vector 1.
    """
    head, tail = (1, 0) if upward else (0, 1)
    factor = 0.0
    for j in range(WIDTH - 1):
        small[0, j] += small[2, j + head] + small[5, j + tail]
        small[1, j] += small[3, j + head] + small[6, j + tail]
        if j > 0:
            # Lane j lies between the separators j - 1 and j.
            lower = small[7, j] if upward else small[4, j]
            upper = small[4, j] if upward else small[7, j]
            factor = lower / small[0, j - 1]
            small[0, j] -= factor * upper
            small[1, j] -= factor * small[1, j - 1]
    for j in range(WIDTH - 2, -1, -1):
        value = small[1, j]
        if j < WIDTH - 2:
            value -= (small[4, j + 1] if upward else small[7, j + 1]) * small[1, j + 1]
        small[1, j] = value / small[0, j]
    small[1, WIDTH - 1] = 0.0


@njit(fastmath=FASTMATH, forceinline=True)
def _length_error(r, s, square, real):
    """Right-hand side, gradient product, the same where there is a bond, relative residual."""
    error = 0.5 * (square - dot(r, r) * real)
    inner = dot(r, s)
    return error, inner, where_zero(real, 1.0, inner), absolute(error) / where_zero(real, 1.0, square)


@njit(fastmath=FASTMATH, forceinline=True)
def _rate_error(r, s, rate, real):
    """The same for relative velocities r; the residual is that along the unit bond."""
    error = rate - dot(r, s)
    inner = dot(s, s)
    positive = where_zero(real, 1.0, inner)
    return error, inner, positive, absolute(error) / square_root(positive)


@njit(fastmath=FASTMATH)
def _first_bad(work, present, first, n_slots, tangent):
    """The first bond that turned round or is not finite, where comparisons do not see it; -1 if there is none."""
    for k in range(n_slots * WIDTH):
        at = (k // WIDTH) * SLOT + k % WIDTH
        inner = 0.0
        for axis in range(0, 3 * WIDTH, WIDTH):
            s, r = work[at + _S + axis], work[at + _R + axis]
            inner += s * s + 0.0 * r if tangent is not None else s * r
        if present[first + k] > 0.0 and not inner > 0.0:
            return k
    return -1


# What follows is spliced into `_solve` as it stands: compiled apart it takes longer, and rounds otherwise.
#
# A row has its bond s, what is changed r, what is wanted of it (`target`), and `pull`, the step of its multiplier.
# The row before it in the order of a sweep has p and `behind`, the next one n and `next_pull`; z and `pulls` are those
# of the separators, q and `final` of that at which the sweep ends, h those of the first row. The sweep enters a row by
# an atom whose displacement is e (`weight` its inverse mass), and leaves by one of o (`leave`). Eliminated, a row says
# ``pull = right - ahead * next_pull - aside * final``; the eliminated rows of a lane add `head_diagonal`, `head_right`
# and `to_head` to the separator at which the sweep began.


@njit(fastmath=FASTMATH, inline="always")
def _next_bond(points, atoms, at, a, cell, kind, wrapped):
    """The bond from the atoms a to those at `at`, and these."""
    b = gather_points(points, atoms, at)
    n = minus(a, b)
    if kind != OPEN and wrapped:
        n = minimum_image(n, cell, kind)
    return n, b


@njit(fastmath=FASTMATH, inline="always")
def _seam_bond(points, atoms, first, end, real, cell, kind, wrapped):
    """The separators, from the last atoms of the lanes to the first ones of the next, and the first atoms."""
    a = gather_points(points, atoms, first)
    z = times(minus(gather_points(points, atoms, end), from_next(a)), real)
    if kind != OPEN and wrapped:
        z = minimum_image(z, cell, kind)
    return z, a


@njit(fastmath=FASTMATH, inline="always")
def _pull_of(work, slot, next_pull, final):
    """The step of a multiplier, by those with which its row was eliminated."""
    return load(work, slot + _RIGHT) - load(work, slot + _AHEAD) * next_pull - load(work, slot + _ASIDE) * final


@njit(fastmath=FASTMATH, inline="always")
def _add_up(work, slot, iteration, pull):
    """The first step of a multiplier, and the sum of all later ones."""
    if iteration == 1:
        store(work, slot + _FIRST, pull)
    elif iteration == 2:
        store(work, slot + _LATER, pull)
    elif iteration > 2:
        store(work, slot + _LATER, load(work, slot + _LATER) + pull)


@njit(fastmath=FASTMATH, inline="always")
def _judged(least, total, peak, peak_slot, positive, ratio, slot):
    """What is known of all rows of a sweep, with one row more."""
    least = where_greater(least, positive, positive, least)
    total = total + ratio
    peak_slot = where_greater(ratio, peak, splat(float(slot)), peak_slot)
    peak = where_greater(ratio, peak, ratio, peak)
    return least, total, peak, peak_slot


@njit(fastmath=FASTMATH, inline="always")
def _opened(work, slot, r, s, target, scale, tangent):
    """Keep the bond of a row and what is wanted of it; returns this, and squares added up."""
    scale = scale + (dot(r, r) + target * target)
    target = target * (square_root(dot(s, s)) if tangent is not None else target)
    store_triple(work, slot + _S, s)
    store(work, slot + _TARGET, target)
    return target, scale


@njit(fastmath=FASTMATH, inline="always")
def _measured(work, slot, r, s, target, real, tangent):
    """Keep r; its errors, and the gradient along it."""
    store_triple(work, slot + _R, r)
    if tangent is not None:
        error, inner, positive, ratio = _rate_error(r, s, target, real)
        r = s
    else:
        error, inner, positive, ratio = _length_error(r, s, target, real)
    return error, inner, positive, ratio, r


@njit(fastmath=FASTMATH, inline="always")
def _eliminated(work, slot, masses, lower, inner, error, leave, onward, right, ahead, aside):
    """Eliminate a row by the one before it."""
    pivot = 1.0 / (where_zero(masses, 1.0, masses * inner) + lower * ahead)
    right = (error + lower * right) * pivot
    aside = flushed(lower * aside * pivot)
    ahead = -leave * onward * pivot
    store_triple(work, slot + _RIGHT, (right, ahead, aside))
    return right, ahead, aside


@njit(fastmath=FASTMATH, inline="always")
def _sweep(
    origins, changed, table, rows, present, weights, given, room, cell, kind, tangent, driven, n_rows, whole, iteration,
    way, p, q, final, s, pull, e, weight, b, d, v, count, scale,
):  # fmt: skip
    """One row after another, from one separator to the next; what they add to these, and what is known of them."""
    slot, stride, atom, step, onward = way
    opening, zero, one = iteration == 0, splat(0.0), splat(1.0)
    right, ahead, aside = zero, zero, splat(-1.0)
    to_head, head_diagonal, head_right = one, zero, zero
    least, total, peak, peak_slot = one, zero, splat(-1.0), zero
    for row in range(n_rows):
        n, next_pull = q, final
        if opening:
            r = v
            real = load(present, atom)
            target = gather(given, rows, atom, 0) * real if driven else zero
            count = count + real
            target, scale = _opened(room, slot, r, s, target, scale, tangent)
            if row + 1 < n_rows:
                n, b = _next_bond(origins, table, atom + 2 * WIDTH, b, cell, kind, True)
                v, d = _next_bond(changed, table, atom + 2 * WIDTH, d, cell, kind, tangent is None)
        else:
            r = load_triple(room, slot + _R)
            target = load(room, slot + _TARGET)
            _add_up(room, slot, iteration, pull)
            real = one if atom < whole else load(present, atom)
            if row + 1 < n_rows:
                n = load_triple(room, slot + stride + _S)
                next_pull = _pull_of(room, slot + stride, pull, final)
        leave = load(weights, atom + onward)
        o = times(product_difference(n, next_pull, s, pull), leave)
        error, inner, positive, ratio, r = _measured(room, slot, plus(r, minus(e, o), 1.0), s, target, real, tangent)
        least, total, peak, peak_slot = _judged(least, total, peak, peak_slot, positive, ratio, slot)
        right, ahead, aside = _eliminated(
            room, slot, (weight + leave) * real, weight * dot(r, p), inner, error, leave, dot(r, n), right, ahead, aside
        )
        head_diagonal = head_diagonal + to_head * aside
        head_right = head_right + to_head * right
        to_head = flushed(-to_head * ahead)
        p, s, pull, e, weight = s, n, next_pull, o, leave
        slot += stride
        atom += step
    added, judged = (head_diagonal, head_right, to_head, ahead, right, aside), (least, total, peak, peak_slot)
    return added, p, e, weight, judged, count, scale


@njit(fastmath=FASTMATH, error_model="numpy")
def _solve(
    base, other, atoms, rows, present, weights, given, cell, kind, first, n_slots, whole, tangent, limit, work, small
):
    """Newton iteration on one strip of eight pieces.

    Bonds s come from the points `base`; r, from `other`, is what the multipliers change: bonds to bring to the lengths
    `given`, or relative velocities to bring to those rates along s. The slots before `whole` have a bond in every lane.
    Returns whether all is well, the worst residual, its place (slot and lane), and the number of solves.
    """
    n_rows = n_slots - 1
    end, seam = first + n_rows * WIDTH, n_rows * SLOT
    zero, driven = splat(0.0), given.shape[0] > 0
    # Arrays that are handed on inside the loop would cost reference counting.
    origins, changed, table, room = at_first(base), at_first(other), at_first(atoms), at_first(work)
    numbers, exists, heavy, goals = at_first(rows), at_first(present), at_first(weights), at_first(given)
    # The separators, and the bond that the first sweep begins with.
    real = load(present, end)
    z, a = _seam_bond(origins, table, first, end, real, cell, kind, True)
    u, b = _next_bond(origins, table, first + WIDTH, a, cell, kind, True)
    c, a = _seam_bond(changed, table, first, end, real, cell, kind, tangent is None)
    v, d = _next_bond(changed, table, first + WIDTH, a, cell, kind, tangent is None)
    store_triple(work, seam + _R, c)
    count, seam_target = real, gather(given, rows, end, 0) * real if driven else zero
    seam_target, scale = _opened(room, seam, c, z, seam_target, zero, tangent)

    pulls, ok, finite, iteration, least, peak, peak_slot = zero, False, False, 0, zero, zero, zero
    for iteration in range(MAX_ITERATIONS + 1):
        opening, upward = iteration == 0, iteration % 2 == 0
        # At first, what lies before a row is a separator; after the last row there is one again.
        p, behind, q, final = from_previous(z), from_previous(pulls), z, pulls
        slot, stride, atom, step, onward = 0, SLOT, first, WIDTH, WIDTH
        if not upward:
            p, behind, q, final = q, final, p, behind
            slot, stride, atom, step, onward = seam - SLOT, -SLOT, end - WIDTH, -WIDTH, 0
        sign = 1.0 if upward else -1.0
        if opening:
            s, pull = u, zero
        else:
            s = load_triple(work, slot + _S)
            pull = _pull_of(room, slot, behind, final)
        head_weight = load(weights, atom + WIDTH - onward)
        # Displacement, times sign, of the atom between two rows.
        h, f = s, times(product_difference(s, pull, p, behind), head_weight)
        added, p, e, weight, (least, total, peak, peak_slot), count, scale = _sweep(
            origins, changed, table, numbers, exists, heavy, goals, room, cell, kind, tangent, driven, n_rows, whole,
            iteration, (slot, stride, atom, step, onward), p, q, final, s, pull, f, head_weight, b, d, v, count, scale,
        )  # fmt: skip
        head_diagonal, head_right, to_head, ahead, right, aside = added
        # The separators: move, measure, and add what the pieces pass on.
        g, f = (e, from_next(f)) if upward else (f, from_next(e))
        r = plus(load_triple(work, seam + _R), minus(g, f), load(present, end) * sign)
        _add_up(room, seam, iteration, pulls)
        real = load(present, end)
        error, inner, positive, ratio, r = _measured(room, seam, r, z, seam_target, real, tangent)
        least, total, peak, peak_slot = _judged(least, total, peak, peak_slot, positive, ratio, seam)
        if tangent is not None and opening:
            limit = limit * np.sqrt(lane_sum(scale, small) / lane_sum(count, small))
        # Comparisons drop NaN, sums keep it.
        finite = all_within(total, 1e300)
        if opening:
            finite = finite and all_within(TINY, least)
        ok = finite and all_within(peak, limit)
        if ok or not finite or iteration == MAX_ITERATIONS:
            break
        masses = (load(weights, end) + from_next(load(weights, first))) * real
        # Couplings of the rows at both ends of a lane: A(head, first), A(tail, last).
        g, r = (r, from_previous(r)) if upward else (from_previous(r), r)
        head, tail = -head_weight * dot(r, h), -weight * dot(g, p)
        store(small, 0, where_zero(masses, 1.0, masses * inner))
        store(small, WIDTH, error)
        store_triple(small, 2 * WIDTH, (-head * head_diagonal, -head * head_right, head * to_head))
        store_triple(small, 5 * WIDTH, (-tail * ahead, -tail * right, -tail * aside))
        _reduce(small.reshape(8, WIDTH), upward)
        pulls = load(small, WIDTH)
    store(small, 0, peak)
    store(small, WIDTH, peak_slot)
    lane = np.argmax(small[:WIDTH])
    worst, place = small[lane], int(small[WIDTH + lane]) // SLOT * WIDTH + lane
    kept = all_within(TINY, least)
    if not (finite and kept):
        bad = _first_bad(work, present, first, n_slots, tangent)
        if bad >= 0:
            worst, place = np.inf, bad
    return ok and kept, worst, place, iteration


@njit(fastmath=FASTMATH)
def _shift(points, velocities, inverse_dt, atoms, owned, full, weights, work, first, n_slots, solves, undo, keep, move):
    """Add the displacements of a strip, keeping what was there.

    The first solve's part is repeated as the sweep computed it, number for number: multipliers of a straight chain are
    much larger than displacements, and the later solves corrected just this rounding.
    """
    seam = (n_slots - 1) * SLOT
    p = from_previous(load_triple(work, seam + _S))
    before, later_before = from_previous(load(work, seam + _FIRST)), splat(0.0)
    if solves > 1:
        later_before = from_previous(load(work, seam + _LATER))
    later = splat(0.0)
    for t in range(n_slots):
        at, slot = first + t * WIDTH, t * SLOT
        s = load_triple(work, slot + _S)
        now, w = load(work, slot + _FIRST), load(weights, at)
        d = times(product_difference(p, before, s, now), w)
        if solves > 1:
            later = load(work, slot + _LATER)
            d = minus(d, times(minus(times(s, later), times(p, later_before)), w))
        p, before, later_before = s, now, later
        x = gather_points(points, atoms, at)
        v = gather_points(velocities, atoms, at) if move else x
        if keep:
            store_triple(undo, 6 * at, x)
            store_triple(undo, 6 * at + 3 * WIDTH, v)
        x, v = minus(x, d), minus(v, times(d, inverse_dt))
        if full[at // WIDTH]:
            scatter_points(points, atoms, at, x)
            if move:
                scatter_points(velocities, atoms, at, v)
        else:
            # Slots beyond a chain's end repeat its last atom; only its own slot writes it.
            store_triple(work, slot + _R, x)
            store_triple(work, slot + _RIGHT, v)
            for lane in range(WIDTH):
                if owned[at + lane]:
                    target = atoms[at + lane] // 3
                    for axis in range(3):
                        points[target, axis] = work[slot + _R + axis * WIDTH + lane]
                        if move:
                            velocities[target, axis] = work[slot + _RIGHT + axis * WIDTH + lane]


@njit(fastmath=FASTMATH)
def _restore(points, atoms, undo, end, first):
    """Write back what `_shift` kept of the slots before `end`."""
    # Backwards: a slot that repeats an atom kept it as it was after its own slot.
    for at in range(end - WIDTH, -WIDTH, -WIDTH):
        scatter_points(points, atoms, at, load_triple(undo, 6 * at + first))


@njit(fastmath=FASTMATH)
def _report(multipliers, rows, present, work, first, n_slots, solves, sign):
    """Add the multipliers of unit gradients."""
    for k in range(n_slots * WIDTH):
        if present[first + k] > 0.0:
            at = (k // WIDTH) * SLOT + k % WIDTH
            square = work[at + _S] ** 2 + work[at + _S + WIDTH] ** 2 + work[at + _S + 2 * WIDTH] ** 2
            value = work[at + _FIRST] if solves > 0 else 0.0
            if solves > 1:
                value += work[at + _LATER]
            multipliers[rows[first + k]] += sign * value * np.sqrt(square)


@njit(cache=True, fastmath=FASTMATH, error_model="numpy")
def _project(tangent, points, references, velocities, inverse_dt, given, lattice, kind, tables, multipliers):
    """Project one strip after another; `distance_clusters` says what the arguments are."""
    t, h, u, b = tables, integers(tables), halves(tables), octets(tables)
    starts, atoms, owned, full = table_array(h, h, 0), table_array(u, h, 1), table_array(b, h, 2), table_array(b, h, 3)
    rows, present = table_array(u, h, 4), table_array(t, h, 5)
    weights, wholes = table_array(t, h, 6), table_array(h, h, 7)
    work, undo = table_array(t, h, 10), table_array(t, h, 11)
    small, move = np.empty(8 * WIDTH), tangent is None and inverse_dt != 0.0
    cell = lattice_numbers(lattice)
    worst, worst_row, most = 0.0, -1, 0
    last = starts.shape[0] - 2
    limit = CHAIN_SPEED_TOLERANCE if tangent is not None else NEWTON_TOLERANCE
    for strip in range(last + 1):
        first, n_slots = starts[strip], (starts[strip + 1] - starts[strip]) // WIDTH
        ok, residual, place, solves = _solve(
            references, points, atoms, rows, present, weights, given, cell, kind,
            first, n_slots, wholes[strip], tangent, limit, work, small,
        )  # fmt: skip
        most = max(most, solves)
        if not (ok and residual <= worst):
            worst, worst_row = residual, rows[first + place]
        if not ok:
            _restore(points, atoms, undo, first, 0)
            if move:
                _restore(velocities, atoms, undo, first, 3 * WIDTH)
            return False, worst, most, worst_row
        if solves > 0:
            _shift(
                points, velocities, inverse_dt, atoms, owned, full, weights, work,
                first, n_slots, solves, undo, strip < last, move,
            )  # fmt: skip
        elif strip < last:
            for at in range(first, starts[strip + 1], WIDTH):
                store_triple(undo, 6 * at, gather_points(points, atoms, at))
                if move:
                    store_triple(undo, 6 * at + 3 * WIDTH, gather_points(velocities, atoms, at))
        if multipliers.shape[0] > 0:
            _report(multipliers, rows, present, work, first, n_slots, solves, -1.0 if tangent is not None else 1.0)
    return True, worst, most, worst_row


@njit(cache=True)
def _positions(alone, x, x_ref, v, inv_dt, wanted, lattice, kind, tables, numbers):
    """As `kcons.solvers.addressable_solvers` says, with a last look at the positions themselves.

    The multipliers of a long stretched chain can be so large that their rounding shows in the positions although the
    bond vectors of the iteration were exact; another round from there takes it away.
    """
    h = integers(tables)
    lengths = wanted if wanted.size else table_array(tables, h, _LENGTHS)
    numbers[:] = 0.0
    found = _project(None, x, x_ref, v, inv_dt, lengths, lattice, kind, tables, numbers)
    for _ in range(MAX_ROUNDS):
        if not (alone and found[0]) or resolved(x, table_array(halves(tables), h, _BONDS), lengths, lattice, kind):
            break
        if not _project(None, x, x_ref, v, inv_dt, lengths, lattice, kind, tables, numbers)[0]:
            break
    return found


@njit(cache=True)
def _tangents(alone, y, x, v, inv_dt, wanted, lattice, kind, tables, numbers):
    numbers[:] = 0.0
    return _project((), y, x, v, inv_dt, wanted, lattice, kind, tables, numbers)


@njit(cache=True, nogil=True)
def _resolved(x, lattice, kind, tables):
    h = integers(tables)
    return resolved(x, table_array(halves(tables), h, _BONDS), table_array(tables, h, _LENGTHS), lattice, kind)


def _strip(
    bounds: NDArray[np.int64], sizes: NDArray[np.int64], chains: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.bool_], NDArray[np.bool_], NDArray[np.int64]]:
    """Tables (slot, lane) of path atoms and which of them are real, and of bonds that there are and their rows.

    One long chain is cut into eight pieces; of up to eight short ones each takes a lane, and idle lanes stay behind the
    last chain's end. A slot beyond the end of a chain repeats its last atom. Chain number c has c rows fewer before it
    than atoms.
    """
    lanes = np.arange(WIDTH)
    chain = chains[np.minimum(lanes, len(chains) - 1)]
    slots = sizes[chains].max()
    begin = np.where(lanes < len(chains), 0, sizes[chain])
    if slots > SHORT:
        slots = -(-slots // WIDTH)
        begin = slots * lanes
    step = begin + np.arange(slots)[:, None]
    first, last = bounds[chain], sizes[chain] - 1
    return first + np.clip(step, 0, last), step <= last, step < last, first - chain + np.clip(step, 0, last - 1)


def _whole_slots(present: NDArray[np.bool_]) -> int:
    """Where the slots begin that lack a bond in some lane; the separators' do not count."""
    lacking = np.flatnonzero(~present[:-1].all(axis=1))
    return WIDTH * int(lacking[0] if len(lacking) else len(present) - 1)


class Chains(AddressableSolver):
    """Open paths of held distances, one after another.

    Parameters
    ----------
    rows : array_like of int, shape (n_rows,)
        Global row numbers, chain by chain, in the order of the path.
    offsets : array_like of int, shape (n_chains + 1,)
        Where each chain begins in `atoms`; the last entry is their number.
    atoms : array_like of int, shape (n_path_atoms,)
        Atoms of the paths, at least two each.
    lengths : array_like of float, shape (n_rows,)
        Lengths used where a request names none.
    inv_mass : array_like of float, shape (n_path_atoms,)
        Inverse masses along the paths; 0 for a pinned atom.

    Attributes
    ----------
    slots : int
        Groups of eight lanes that a sweep goes through.
    """

    name = "Chains"
    kernels = Kernels(_positions, _tangents, resolved=_resolved)

    def __init__(
        self, rows: ArrayLike, offsets: ArrayLike, atoms: ArrayLike, lengths: ArrayLike, inv_mass: ArrayLike
    ) -> None:
        self._made_of = rows, offsets, atoms, lengths, inv_mass
        self.rows = np.array(rows, dtype=np.int64)
        bounds = np.array(offsets, dtype=np.int64)
        path = np.array(atoms, dtype=np.int64)
        inverse = np.array(inv_mass, dtype=np.float64)
        sizes = np.diff(bounds)
        long, short = np.flatnonzero(sizes > SHORT), np.flatnonzero(sizes <= SHORT)
        # Chains of similar length share a strip.
        short = short[np.argsort(-sizes[short], kind="stable")]
        shares = [*long[:, None], *(short[k : k + WIDTH] for k in range(0, len(short), WIDTH))]
        strips = [_strip(bounds, sizes, share) for share in shares]
        place, owned, present, row = (np.concatenate([strip[k].reshape(-1) for strip in strips]) for k in range(4))
        starts = np.concatenate([[0], np.cumsum([strip[0].size for strip in strips])]).astype(np.int64)
        lane_atoms, lane_rows = (3 * path[place]).astype(np.uint32), row.astype(np.uint32)
        # Numbers of one byte, which can be views of other arrays.
        full = np.asarray(owned.reshape(-1, WIDTH).all(axis=1), dtype=np.uint8)
        bonds, weights = aligned(len(place)), aligned(len(place))
        bonds[:] = present
        weights[:] = np.where(owned, inverse[place], 0.0)
        wholes = np.array([_whole_slots(strip[2]) for strip in strips]) + starts[:-1]
        ends = np.column_stack((np.delete(path, bounds[1:] - 1), np.delete(path, bounds[:-1]))).astype(np.uint32)
        self.slots = int(starts[-1]) // WIDTH
        self.tables = in_one_array(
            (
                *(starts, lane_atoms, np.asarray(owned, dtype=np.uint8), full, lane_rows, bonds, weights, wholes),
                *(np.array(lengths, dtype=np.float64), ends.ravel()),
                # To work in, and to undo with: the last strip is written once everything is known.
                *(room(int(np.diff(starts).max()) // WIDTH * SLOT), room(6 * int(starts[-2]))),
            )
        )

    def renumbered(self, numbers: NDArray[np.int64]) -> "Chains":
        """The same for atoms with other numbers: `numbers` by those here."""
        rows, offsets, atoms, *more = self._made_of
        return Chains(rows, offsets, numbers[atoms], *more)
