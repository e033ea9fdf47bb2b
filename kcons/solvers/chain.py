"""Open chains of held distances, of any length.

A chain is cut into eight pieces, one a lane, of equal length. The bond between
two pieces is a *separator*: once the separators' multipliers are known, the
pieces are independent. Each lane eliminates its tridiagonal piece and what
couples it to the separators at its two ends; a tridiagonal system of seven
separators remains. So the division that every pivot waits for is shared by
eight rows. Short chains take one lane each, eight chains at a time.

A sweep substitutes back along the pieces, and as it passes moves the bonds,
measures their residuals and eliminates for the next Newton step in the
opposite direction: a Newton step reads the chain once.

Displacements are summed per atom, not per multiplier: in a straight chain
multipliers are larger than displacements by the square of its length, and
their rounding would show.
"""

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from kcons.solvers.outcome import Outcome
from kcons.solvers.simd import (
    FASTMATH,
    MAX_ITERATIONS,
    NO_NUMBERS,
    NO_POINTS,
    OPEN,
    POSITION_TOLERANCE,
    TINY,
    WIDTH,
    absolute,
    all_within,
    dot,
    from_next,
    from_previous,
    gather,
    gather_points,
    keep_points,
    lattice_kind,
    lattice_numbers,
    load,
    minimum_image,
    scatter_points,
    splat,
    square_root,
    store,
    where_greater,
    where_zero,
)

SHORT = 32
"""Atoms of the longest chain that gets one lane instead of eight."""

TANGENT_TOLERANCE = 2e-15
"""Accepted ``|u·y_ij - c|``, relative to the root mean square of the chain's."""

# Fields of a slot: WIDTH doubles each, one a lane. Slot t of a lane holds its
# atom t and the bond to atom t + 1; the last slot's bond is the separator.
_S, _R, _D, _TARGET, _F, _C, _L, _TOTAL, _SIZE = 0, 3, 6, 9, 10, 11, 12, 13, 14
_FIELDS = 15
_SLOT = _FIELDS * WIDTH


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


@njit(fastmath=FASTMATH, error_model="numpy")
def _solve(work, weights, present, first, n_slots, tangent, limit, small):
    """Newton iteration on one strip of eight pieces.

    Returns whether it converged, whether all bonds kept their sense, the
    worst residual, its slot and lane, and the number of solves.
    """
    m = n_slots - 1
    seam = m * _SLOT
    zero = splat(0.0)
    shared = splat(0.0)  # multipliers of the separators, by lane on their left
    ok, finite, iteration, least = False, False, 0, zero
    for iteration in range(MAX_ITERATIONS + 1):
        upward = iteration % 2 == 0
        peak, peak_slot, least, total = splat(-1.0), zero, splat(1.0), zero
        zx, zy, zz = (
            load(work, seam + _S * WIDTH),
            load(work, seam + (_S + 1) * WIDTH),
            load(work, seam + (_S + 2) * WIDTH),
        )
        # Entry and exit: the side a piece is entered and left on in this sweep.
        if upward:
            px, py, pz, p = from_previous(zx), from_previous(zy), from_previous(zz), from_previous(shared)
            qx, qy, qz, q = zx, zy, zz, shared
            slot, stride, atom = 0, _SLOT, first
        else:
            px, py, pz, p = zx, zy, zz, shared
            qx, qy, qz, q = from_previous(zx), from_previous(zy), from_previous(zz), from_previous(shared)
            slot, stride, atom = (m - 1) * _SLOT, -_SLOT, first + (m - 1) * WIDTH
        sign = 1.0 if upward else -1.0
        step = WIDTH if upward else -WIDTH
        forward, backward = (WIDTH, 0) if upward else (0, WIDTH)
        # Slot fields of the atom on the exit side, relative to the row's.
        shift = _SLOT if upward else 0
        sx, sy, sz = (
            load(work, slot + _S * WIDTH),
            load(work, slot + (_S + 1) * WIDTH),
            load(work, slot + (_S + 2) * WIDTH),
        )
        now = load(work, slot + _F * WIDTH) - load(work, slot + _C * WIDTH) * p - load(work, slot + _L * WIDTH) * q
        w = load(weights, atom + backward)
        w_first = w
        ex, ey, ez = w * (sx * now - px * p), w * (sy * now - py * p), w * (sz * now - pz * p)
        entry = slot + (0 if upward else _SLOT)
        store(work, entry + _D * WIDTH, load(work, entry + _D * WIDTH) + sign * ex)
        store(work, entry + (_D + 1) * WIDTH, load(work, entry + (_D + 1) * WIDTH) + sign * ey)
        store(work, entry + (_D + 2) * WIDTH, load(work, entry + (_D + 2) * WIDTH) + sign * ez)
        fx, fy, fz, hx, hy, hz = ex, ey, ez, sx, sy, sz
        f, c, l = zero, zero, splat(-1.0)
        gamma, head_diagonal, head_right = splat(1.0), zero, zero
        w_exit = w
        for row in range(m):
            if row + 1 < m:
                ahead = slot + stride
                nx, ny, nz = (
                    load(work, ahead + _S * WIDTH),
                    load(work, ahead + (_S + 1) * WIDTH),
                    load(work, ahead + (_S + 2) * WIDTH),
                )
                then = (
                    load(work, ahead + _F * WIDTH)
                    - load(work, ahead + _C * WIDTH) * now
                    - load(work, ahead + _L * WIDTH) * q
                )
            else:
                nx, ny, nz, then = qx, qy, qz, q
            w_exit = load(weights, atom + forward)
            ox, oy, oz = (
                w_exit * (nx * then - sx * now),
                w_exit * (ny * then - sy * now),
                w_exit * (nz * then - sz * now),
            )
            place = slot + shift
            store(work, place + _D * WIDTH, load(work, place + _D * WIDTH) + sign * ox)
            store(work, place + (_D + 1) * WIDTH, load(work, place + (_D + 1) * WIDTH) + sign * oy)
            store(work, place + (_D + 2) * WIDTH, load(work, place + (_D + 2) * WIDTH) + sign * oz)
            rx = load(work, slot + _R * WIDTH) + (ex - ox)
            ry = load(work, slot + (_R + 1) * WIDTH) + (ey - oy)
            rz = load(work, slot + (_R + 2) * WIDTH) + (ez - oz)
            store(work, slot + _R * WIDTH, rx)
            store(work, slot + (_R + 1) * WIDTH, ry)
            store(work, slot + (_R + 2) * WIDTH, rz)
            store(work, slot + _TOTAL * WIDTH, load(work, slot + _TOTAL * WIDTH) + now)
            real = load(present, atom)
            target, size = load(work, slot + _TARGET * WIDTH), load(work, slot + _SIZE * WIDTH)
            rs = dot(rx, ry, rz, sx, sy, sz)
            if tangent:
                error = target - rs
                rx, ry, rz = sx, sy, sz
                rs = dot(sx, sy, sz, sx, sy, sz)
            else:
                error = 0.5 * (target - dot(rx, ry, rz, rx, ry, rz) * real)
            ratio = absolute(error) * size
            rs_real = where_zero(real, 1.0, rs)
            least = where_greater(least, rs_real, rs_real, least)
            total = total + ratio
            peak_slot = where_greater(ratio, peak, splat(float(slot)), peak_slot)
            peak = where_greater(ratio, peak, ratio, peak)
            both = w + w_exit
            back = w * dot(rx, ry, rz, px, py, pz)
            pivot = 1.0 / (where_zero(both * real, 1.0, both * rs) + back * c)
            c_next = -w_exit * dot(rx, ry, rz, nx, ny, nz) * pivot
            f = (error + back * f) * pivot
            l = back * l * pivot
            c = c_next
            store(work, slot + _F * WIDTH, f)
            store(work, slot + _C * WIDTH, c)
            store(work, slot + _L * WIDTH, l)
            head_diagonal = head_diagonal + gamma * l
            head_right = head_right + gamma * f
            gamma = -gamma * c
            px, py, pz, sx, sy, sz, now = sx, sy, sz, nx, ny, nz, then
            ex, ey, ez, w = ox, oy, oz, w_exit
            slot += stride
            atom += step
        # The separators: move, measure, and add what the pieces pass on.
        if upward:
            rx, ry, rz = ex - from_next(fx), ey - from_next(fy), ez - from_next(fz)
        else:
            rx, ry, rz = fx - from_next(ex), fy - from_next(ey), fz - from_next(ez)
        real = load(present, first + m * WIDTH)
        rx = load(work, seam + _R * WIDTH) + rx * sign * real
        ry = load(work, seam + (_R + 1) * WIDTH) + ry * sign * real
        rz = load(work, seam + (_R + 2) * WIDTH) + rz * sign * real
        store(work, seam + _R * WIDTH, rx)
        store(work, seam + (_R + 1) * WIDTH, ry)
        store(work, seam + (_R + 2) * WIDTH, rz)
        store(work, seam + _TOTAL * WIDTH, load(work, seam + _TOTAL * WIDTH) + shared)
        target, size = load(work, seam + _TARGET * WIDTH), load(work, seam + _SIZE * WIDTH)
        rs = dot(rx, ry, rz, zx, zy, zz)
        if tangent:
            error = target - rs
            rx, ry, rz = zx, zy, zz
            rs = dot(zx, zy, zz, zx, zy, zz)
        else:
            error = 0.5 * (target - dot(rx, ry, rz, rx, ry, rz) * real)
        ratio = absolute(error) * size
        rs_real = where_zero(real, 1.0, rs)
        least = where_greater(least, rs_real, rs_real, least)
        total = total + ratio
        peak_slot = where_greater(ratio, peak, splat(float(seam)), peak_slot)
        peak = where_greater(ratio, peak, ratio, peak)
        # Comparisons drop NaN, sums keep it.
        finite = all_within(total, 1e300)
        if iteration == 0:
            finite = finite and all_within(TINY, least)
        ok = finite and all_within(peak, limit)
        if ok or not finite or iteration == MAX_ITERATIONS:
            break
        left, right = load(weights, first + m * WIDTH), from_next(load(weights, first))
        both = left + right
        store(small, 0, where_zero(both * real, 1.0, both * rs))
        store(small, WIDTH, error)
        # Couplings of the rows at both ends of a lane: A(head, first), A(tail, last).
        if upward:
            hx, hy, hz = dot(from_previous(rx), from_previous(ry), from_previous(rz), hx, hy, hz), zero, zero
            tail = -w_exit * dot(rx, ry, rz, px, py, pz)
        else:
            hx, hy, hz = dot(rx, ry, rz, hx, hy, hz), zero, zero
            tail = -w_exit * dot(from_previous(rx), from_previous(ry), from_previous(rz), px, py, pz)
        head = -w_first * hx
        store(small, 2 * WIDTH, -head * head_diagonal)
        store(small, 3 * WIDTH, -head * head_right)
        store(small, 4 * WIDTH, head * gamma)
        store(small, 5 * WIDTH, -tail * c)
        store(small, 6 * WIDTH, -tail * f)
        store(small, 7 * WIDTH, -tail * l)
        _reduce(small.reshape(8, WIDTH), upward)
        shared = load(small, WIDTH)
    store(small, 0, peak)
    store(small, WIDTH, peak_slot)
    worst, lane = -1.0, 0
    for k in range(WIDTH):
        if small[k] > worst:
            worst, lane = small[k], k
    place = int(small[WIDTH + lane]) // _SLOT
    kept = all_within(TINY, least)
    if not (finite and kept):
        # NaN escapes comparisons, and a bond turned round has no residual: look.
        for k in range(n_slots * WIDTH):
            base = (k // WIDTH) * _SLOT + k % WIDTH
            inner = 0.0
            for axis in range(3):
                partner = (_S if tangent else _R) + axis
                inner += work[base + (_S + axis) * WIDTH] * work[base + partner * WIDTH]
                inner += 0.0 * work[base + (_R + axis) * WIDTH]
            inner += 0.0 * work[base + _TARGET * WIDTH]
            if present[first + k] > 0.0 and not inner > 0.0:
                worst, place, lane = np.inf, k // WIDTH, k % WIDTH
                break
    return ok and kept, worst, place * WIDTH + lane, iteration


@njit(fastmath=FASTMATH)
def _shift(points, atoms, owned, full, work, first, n_slots, factor, undo):
    """Add the displacements of a strip, keeping what was there.

    Slots without an atom repeat the last atom of their chain, so a slot is
    written by vectors only where no lane repeats one.
    """
    for t in range(n_slots):
        at, slot = first + t * WIDTH, t * _SLOT
        x, y, z = keep_points(points, atoms, at, undo, 3 * at)
        x = x + factor * load(work, slot + _D * WIDTH)
        y = y + factor * load(work, slot + (_D + 1) * WIDTH)
        z = z + factor * load(work, slot + (_D + 2) * WIDTH)
        if full[at // WIDTH]:
            scatter_points(points, atoms, at, x, y, z)
        else:
            for lane in range(WIDTH):
                if owned[at + lane]:
                    for axis in range(3):
                        shift = work[slot + (_D + axis) * WIDTH + lane]
                        points[atoms[at + lane] // 3, axis] += factor * shift


@njit(fastmath=FASTMATH)
def _restore(points, atoms, undo, end):
    """Write back what `_shift` kept of the slots before `end`."""
    # Backwards: slots that repeat an atom kept it as it was after its own slot.
    for at in range(end - WIDTH, -WIDTH, -WIDTH):
        x, y, z = load(undo, 3 * at), load(undo, 3 * at + WIDTH), load(undo, 3 * at + 2 * WIDTH)
        scatter_points(points, atoms, at, x, y, z)


@njit(fastmath=FASTMATH)
def _report(multipliers, rows, present, work, first, n_slots, sign):
    """Multipliers of unit gradients."""
    for k in range(n_slots * WIDTH):
        if present[first + k] > 0.0:
            base = (k // WIDTH) * _SLOT + k % WIDTH
            square = 0.0
            for axis in range(3):
                square += work[base + (_S + axis) * WIDTH] ** 2
            multipliers[rows[first + k]] = sign * work[base + _TOTAL * WIDTH] * np.sqrt(square)


@njit(cache=True, fastmath=FASTMATH, error_model="numpy")
def _positions(
    points,
    references,
    velocities,
    inverse_dt,
    starts,
    atoms,
    owned,
    full,
    rows,
    present,
    weights,
    lengths,
    lattice,
    kind,
    multipliers,
    work,
    undo,
):
    small = np.empty(8 * WIDTH)
    cell = lattice_numbers(lattice)
    zero = splat(0.0)
    worst, worst_row, most = 0.0, -1, 0
    for strip in range(starts.shape[0] - 1):
        first, n_slots = starts[strip], (starts[strip + 1] - starts[strip]) // WIDTH
        tx, ty, tz = gather_points(references, atoms, first)
        vx, vy, vz = gather_points(points, atoms, first)
        nx, ny, nz, mx, my, mz = tx, ty, tz, vx, vy, vz
        for t in range(n_slots):
            at, slot = first + t * WIDTH, t * _SLOT
            ax, ay, az, bx, by, bz = nx, ny, nz, mx, my, mz
            real = load(present, at)
            if t + 1 < n_slots:
                nx, ny, nz = gather_points(references, atoms, at + WIDTH)
                mx, my, mz = gather_points(points, atoms, at + WIDTH)
                sx, sy, sz = ax - nx, ay - ny, az - nz
                rx, ry, rz = bx - mx, by - my, bz - mz
            else:
                nx, ny, nz = from_next(tx), from_next(ty), from_next(tz)
                mx, my, mz = from_next(vx), from_next(vy), from_next(vz)
                sx, sy, sz = (ax - nx) * real, (ay - ny) * real, (az - nz) * real
                rx, ry, rz = (bx - mx) * real, (by - my) * real, (bz - mz) * real
            if kind != OPEN:
                sx, sy, sz = minimum_image(sx, sy, sz, cell, kind)
                rx, ry, rz = minimum_image(rx, ry, rz, cell, kind)
            store(work, slot + _S * WIDTH, sx)
            store(work, slot + (_S + 1) * WIDTH, sy)
            store(work, slot + (_S + 2) * WIDTH, sz)
            store(work, slot + _R * WIDTH, rx)
            store(work, slot + (_R + 1) * WIDTH, ry)
            store(work, slot + (_R + 2) * WIDTH, rz)
            length = gather(lengths, rows, at, 0)
            square = length * length
            store(work, slot + _TARGET * WIDTH, square * real)
            store(work, slot + _SIZE * WIDTH, real / square)
            for field in (_D, _D + 1, _D + 2, _F, _C, _L, _TOTAL):
                store(work, slot + field * WIDTH, zero)
        ok, residual, place, solves = _solve(work, weights, present, first, n_slots, False, POSITION_TOLERANCE, small)
        most = max(most, solves)
        if not (ok and residual <= worst):
            worst, worst_row = residual, rows[first + place]
        if not ok:
            _restore(points, atoms, undo, first)
            if velocities.shape[0] > 0:
                _restore(velocities, atoms, undo[3 * starts[-1] :], first)
            return False, worst, most, worst_row
        _shift(points, atoms, owned, full, work, first, n_slots, 1.0, undo)
        if velocities.shape[0] > 0:
            kept = undo[3 * starts[-1] :]
            _shift(velocities, atoms, owned, full, work, first, n_slots, inverse_dt, kept)
        if multipliers.shape[0] > 0:
            _report(multipliers, rows, present, work, first, n_slots, 1.0)
    return True, worst, most, worst_row


@njit(cache=True, fastmath=FASTMATH, error_model="numpy")
def _tangents(
    points,
    vectors,
    starts,
    atoms,
    owned,
    full,
    rows,
    present,
    weights,
    rates,
    lattice,
    kind,
    multipliers,
    work,
    undo,
):
    driven = rates.shape[0] > 0
    small = np.empty(8 * WIDTH)
    cell = lattice_numbers(lattice)
    zero = splat(0.0)
    worst, worst_row, most = 0.0, -1, 0
    for strip in range(starts.shape[0] - 1):
        first, n_slots = starts[strip], (starts[strip + 1] - starts[strip]) // WIDTH
        tx, ty, tz = gather_points(points, atoms, first)
        vx, vy, vz = gather_points(vectors, atoms, first)
        nx, ny, nz, mx, my, mz = tx, ty, tz, vx, vy, vz
        scale, count = zero, zero
        for t in range(n_slots):
            at, slot = first + t * WIDTH, t * _SLOT
            ax, ay, az, bx, by, bz = nx, ny, nz, mx, my, mz
            real = load(present, at)
            if t + 1 < n_slots:
                nx, ny, nz = gather_points(points, atoms, at + WIDTH)
                mx, my, mz = gather_points(vectors, atoms, at + WIDTH)
                sx, sy, sz = ax - nx, ay - ny, az - nz
                rx, ry, rz = bx - mx, by - my, bz - mz
            else:
                nx, ny, nz = from_next(tx), from_next(ty), from_next(tz)
                mx, my, mz = from_next(vx), from_next(vy), from_next(vz)
                sx, sy, sz = (ax - nx) * real, (ay - ny) * real, (az - nz) * real
                rx, ry, rz = (bx - mx) * real, (by - my) * real, (bz - mz) * real
            if kind != OPEN:
                sx, sy, sz = minimum_image(sx, sy, sz, cell, kind)
            store(work, slot + _S * WIDTH, sx)
            store(work, slot + (_S + 1) * WIDTH, sy)
            store(work, slot + (_S + 2) * WIDTH, sz)
            store(work, slot + _R * WIDTH, rx)
            store(work, slot + (_R + 1) * WIDTH, ry)
            store(work, slot + (_R + 2) * WIDTH, rz)
            length = square_root(dot(sx, sy, sz, sx, sy, sz))
            rate = zero
            if driven:
                rate = gather(rates, rows, at, 0) * real
            scale = scale + (dot(rx, ry, rz, rx, ry, rz) + rate * rate)
            count = count + real
            store(work, slot + _TARGET * WIDTH, rate * length)
            store(work, slot + _SIZE * WIDTH, real / where_zero(real, 1.0, length))
            for field in (_D, _D + 1, _D + 2, _F, _C, _L, _TOTAL):
                store(work, slot + field * WIDTH, zero)
        store(small, 0, scale)
        store(small, WIDTH, count)
        mean = small[:WIDTH].sum() / small[WIDTH : 2 * WIDTH].sum()
        limit = TANGENT_TOLERANCE * np.sqrt(mean)
        ok, residual, place, solves = _solve(work, weights, present, first, n_slots, True, limit, small)
        most = max(most, solves)
        if not (ok and residual <= worst):
            worst, worst_row = residual, rows[first + place]
        if not ok:
            _restore(vectors, atoms, undo, first)
            return False, worst, most, worst_row
        _shift(vectors, atoms, owned, full, work, first, n_slots, 1.0, undo)
        if multipliers.shape[0] > 0:
            _report(multipliers, rows, present, work, first, n_slots, -1.0)
    return True, worst, most, worst_row


_Strip = tuple[NDArray[np.int64], NDArray[np.bool_], NDArray[np.bool_], NDArray[np.int64]]


def _strip(
    begin: NDArray[np.int64], step: NDArray[np.int64], size: NDArray[np.int64], chain: NDArray[np.int64]
) -> _Strip:
    """Tables (slot, lane) of path atoms, which are real, and the same of rows.

    A slot beyond the end of a chain repeats its last atom. A chain begins at
    `begin` in the path; chain number c has c rows fewer before it than atoms.
    """
    last = size - 1
    place = begin + np.clip(step, 0, last)
    return place, step <= last, step < last, begin - chain + np.clip(step, 0, last - 1)


def _long_strip(begin: int, size: int, chain: int) -> _Strip:
    """One chain cut into eight pieces."""
    n_slots = -(-size // WIDTH)
    step = np.arange(WIDTH) * n_slots + np.arange(n_slots)[:, None]
    return _strip(np.asarray(begin), step, np.asarray(size), np.asarray(chain))


def _short_strip(bounds: NDArray[np.int64], sizes: NDArray[np.int64], chains: NDArray[np.int64]) -> _Strip:
    """Up to eight chains, a lane each; idle lanes stay behind the last chain's end."""
    lane_chain = chains[np.minimum(np.arange(WIDTH), len(chains) - 1)]
    idle = np.arange(WIDTH) >= len(chains)
    step = np.arange(sizes[chains].max())[:, None] + np.where(idle, sizes[lane_chain], 0)
    return _strip(bounds[lane_chain], step, sizes[lane_chain], lane_chain)


class Chains:
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
        Lengths used where a call passes none.
    inv_mass : array_like of float, shape (n_path_atoms,)
        Inverse masses along the paths; 0 for a pinned atom.
    """

    name = "chain"

    def __init__(
        self,
        rows: ArrayLike,
        offsets: ArrayLike,
        atoms: ArrayLike,
        lengths: ArrayLike,
        inv_mass: ArrayLike,
    ) -> None:
        self.rows: NDArray[np.int64] = np.array(rows, dtype=np.int64).reshape(-1)
        self.lengths = np.array(lengths, dtype=np.float64).reshape(-1)
        bounds = np.array(offsets, dtype=np.int64)
        path = np.array(atoms, dtype=np.int64)
        inverse = np.array(inv_mass, dtype=np.float64)
        sizes = np.diff(bounds)
        if (sizes < 2).any():
            raise ValueError("a chain has at least two atoms")
        strips = [_long_strip(bounds[c], sizes[c], c) for c in np.flatnonzero(sizes > SHORT)]
        short = np.flatnonzero(sizes <= SHORT)
        # Chains of similar length share a strip.
        short = short[np.argsort(-sizes[short], kind="stable")]
        strips += [_short_strip(bounds, sizes, short[k : k + WIDTH]) for k in range(0, len(short), WIDTH)]
        place, owned, present, row = (np.concatenate([strip[k].reshape(-1) for strip in strips]) for k in range(4))
        lanes = [strip[0].size for strip in strips]
        self._starts = np.concatenate([[0], np.cumsum(lanes)]).astype(np.int64)
        self._atoms = (3 * path[place]).astype(np.uint32)
        self._owned = owned
        self._full = owned.reshape(-1, WIDTH).all(axis=1)
        self._rows = row.astype(np.uint32)
        self._present = present.astype(np.float64)
        self._weights = np.where(owned, inverse[place], 0.0)
        self._longest = max(lanes) // WIDTH
        self._work = NO_NUMBERS
        self._undo = NO_NUMBERS

    def _room(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        if not len(self._work):
            self._work = np.empty(self._longest * _SLOT)
            self._undo = np.empty(6 * len(self._atoms))
        return self._work, self._undo

    def positions(
        self,
        x_new: NDArray[np.float64],
        x_ref: NDArray[np.float64],
        lengths: NDArray[np.float64] | None = None,
        lattice: NDArray[np.float64] | None = None,
        velocities: NDArray[np.float64] | None = None,
        inv_dt: float = 0.0,
        multipliers: NDArray[np.float64] | None = None,
    ) -> Outcome:
        """Move `x_new` along the gradients at `x_ref` onto the held lengths.

        Parameters
        ----------
        x_new, x_ref : ndarray, shape (n_atoms, 3)
            Positions to correct in place, and positions on the constraints.
        lengths : ndarray, shape (n_rows,), optional
            Held lengths now.
        lattice : ndarray, shape (2, 3, 3), optional
            Cell and its inverse; None without periodicity.
        velocities : ndarray, shape (n_atoms, 3), optional
            Receives the displacement times `inv_dt`.
        multipliers : ndarray, shape (n_rows,), optional
            Receives the multipliers of unit gradients.

        Returns
        -------
        Outcome
            Nothing has changed where it is not converged.
        """
        cell, kind = lattice_kind(lattice)
        work, undo = self._room()
        ok, residual, iterations, row = _positions(
            x_new,
            x_ref,
            NO_POINTS if velocities is None else velocities,
            inv_dt,
            self._starts,
            self._atoms,
            self._owned,
            self._full,
            self._rows,
            self._present,
            self._weights,
            self.lengths if lengths is None else lengths,
            cell,
            kind,
            NO_NUMBERS if multipliers is None else multipliers,
            work,
            undo,
        )
        return Outcome(ok, residual, iterations, row)

    def tangents(
        self,
        x: NDArray[np.float64],
        y: NDArray[np.float64],
        rates: NDArray[np.float64] | None = None,
        lattice: NDArray[np.float64] | None = None,
        multipliers: NDArray[np.float64] | None = None,
    ) -> Outcome:
        """Project `y` (velocities, or forces per mass) so that lengths change at `rates`.

        Parameters
        ----------
        x, y : ndarray, shape (n_atoms, 3)
            Positions, and the vectors to project in place.
        rates : ndarray, shape (n_rows,), optional
            Wanted ``u·(y_i - y_j)``; zero where None or empty.
        lattice, multipliers
            As in `positions`.
        """
        cell, kind = lattice_kind(lattice)
        work, undo = self._room()
        ok, residual, iterations, row = _tangents(
            x,
            y,
            self._starts,
            self._atoms,
            self._owned,
            self._full,
            self._rows,
            self._present,
            self._weights,
            NO_NUMBERS if rates is None else rates,
            cell,
            kind,
            NO_NUMBERS if multipliers is None else multipliers,
            work,
            undo,
        )
        return Outcome(ok, residual, iterations, row)
