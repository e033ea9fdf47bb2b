"""Operations of a time step in one compiled call, as many as there are until Python is needed.

A call from Python to a kernel costs as much as the kernel's work on ten molecules of water or more. `perform` therefore
goes through a program, a row of numbers for each operation (`operations.Program`), and comes back where forces are
to be evaluated, where an operation is one of Python, or where rows are left to the engine: those that kernels do not
know, and those that a kernel found no solution for, where the engine has more means, and names the row.

A step of order 6 moves the atoms up to a hundred times, and each move rounds positions and velocities. Programs of
several flights keep both in pairs of numbers, the value and what rounding took from it, of which only the last rounding
of a step remains.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numba
import numpy as np
from numba import types
from numba.extending import intrinsic

from kcons.constraints.compilation import njit
from kcons.constraints.target import FloatArray
from kcons.errors import NonFiniteError
from kcons.solvers.addressable_solvers import MORE, caller_of, packed_positions, packed_tangents
from kcons.solvers.kernels.array_views import bits, flat, integers, table_array, view
from kcons.solvers.tolerances import MANY_ITERATIONS

#: What a row tells the kernel to do: nothing, since it is for Python; take the kick, which all do; fly; fly along great
#: circles; project velocities; call a function; end a step.
PYTHON, KICK, FLY, CIRCLE, PROJECT, CALL, END = range(7)
#: What is where in a row: one of these; which array has the positions before and after (0: those where forces were last
#: evaluated, 1: those where they will be next, 2: those that nobody sees); the length of the flight, or of the time
#: that the function is over, and the kick before it, as fractions of the step; whose forces; the function's address.
VERB, HERE, THERE, LENGTH, PUSH, GROUP, ADDRESS = range(7)
WIDTH = 7
#: What a room begins with: whether what rounding takes is kept, whether rows are left to the engine, the iterations of
#: the last flight, whether all was far from the origin at the end of the last step, and how many operations there are.
PAIRS, ENGINE, ITERATIONS, FAR, COUNT, ROOM = range(6)

#: Sums may be taken in any order, so that they are compiled to vector instructions; NaN stays NaN.
SUMS = {"reassoc", "contract", "arcp", "nsz"}

_POINTS, _NUMBERS = numba.float64[:, ::1], numba.float64[::1]
#: Of functions that programs call, (x, v, forces, time, numbers, tables): 0, or what else than 0 says that nothing has
#: been done. `numbers` are what a room ends with.
FUNCTION = numba.int64(_POINTS, _POINTS, _NUMBERS, numba.float64, _NUMBERS, _NUMBERS)
#: Of flights along great circles, which are compiled where there are any: as `fly`, with spheres; 0 for bad forces.
CIRCLES = numba.int64(
    *(_POINTS, _NUMBERS, _POINTS, _POINTS, numba.float64, _NUMBERS, _NUMBERS, numba.float64, _POINTS, _NUMBERS)
)
_call, _fly_circles = caller_of(FUNCTION), caller_of(CIRCLES)
_PERFORM = (*(numba.int64, numba.boolean, numba.float64, _POINTS, _POINTS, _POINTS, _POINTS, _NUMBERS, _NUMBERS),)


@cache
def kernel() -> Any:
    """`perform` without Numba's dispatcher.

    That asks for the type of each argument, which takes as long as a dozen bonds. Here each has one type, and has to
    have it: contiguous arrays of doubles.
    """
    return perform.compile(_PERFORM)


@cache
def tangents() -> Any:
    """`packed_tangents` in the same way."""
    return packed_tangents.compile((_POINTS, _POINTS, _NUMBERS))


@njit(cache=True, nogil=True)
def perform(at, more, dt, x, out, v, forces, room, tables):  # type: ignore[no-untyped-def]
    """Make operations from number `at` on.

    Parameters
    ----------
    at : int
    more : bool
        Whether another step may follow at the end of this one.
    dt : float
    x, out : ndarray, shape (n_atoms, 3)
        Where forces were evaluated last, which is not written to, and room for where they will be next.
    v : ndarray, shape (n_atoms, 3)
        Changed in place.
    forces : ndarray, shape (n_groups n_atoms, 3)
    room : ndarray, flat
        `ROOM` numbers, `WIDTH` for each operation, with pairs three arrays of the size of v (what rounding took from
        positions and from velocities, and room for positions), and numbers of the functions that the program calls.
    tables : ndarray
        Of `kcons.steppers.packed_system`.

    Returns
    -------
    int
        Number of the operation that is left to Python, since it is Python's, the end of a march, or has a kick by
        forces that are not finite; -1 less this where only its solve is left: kick and flight are done.
    """
    header, n = integers(tables), v.size
    weights, held = table_array(tables, header, MORE), table_array(header, header, MORE + 1)
    forces, room = flat(forces), flat(room)
    x, out, v = _points(flat(x), 0, n), _points(flat(out), 0, n), _points(flat(v), 0, n)
    first = ROOM + WIDTH * int(room[COUNT])
    program, pairs, engine, low, push, spare = room[ROOM:first], room[PAIRS] != 0.0, room[ENGINE] != 0.0, weights, v, v
    if pairs:
        low, push, spare = room[first : first + n], _points(room, first + n, n), _points(room, first + 2 * n, n)
        first += 3 * n
    numbers, k = room[first:], at
    while True:
        row = WIDTH * k
        verb = int(program[row])
        here = _place(program[row + HERE], x, out, spare)
        if verb == END:
            far = held.size and beyond(here, held, held[0], table_array(tables, header, MORE + 2)[0])
            room[FAR] = 1.0 if far else 0.0
            if far or not more or program[row + HERE] != 0.0:
                return k
            if pairs:
                low[:] = 0.0
            more, k = False, 0
            continue
        h, kick, begin = program[row + LENGTH] * dt, program[row + PUSH] * dt, int(program[row + GROUP]) * n
        f = forces[begin : begin + n] if kick != 0.0 else weights
        if verb in (FLY, CIRCLE):
            there = _place(program[row + THERE], x, out, spare)
            if verb == CIRCLE:
                given = (here, low, v, push, kick, f, weights, h, there, table_array(tables, header, MORE + 3))
                sound = _fly_circles(int(program[row + ADDRESS]), given) != 0
            elif pairs:
                sound = fly(here, low, v, push, kick, f, weights, h, there)
            else:
                sound = fly_once(here, v, kick, f, weights, h, there)
            if not sound:
                return k
            if verb == FLY:
                took = -1 if engine else packed_positions(there, here, push, 1.0 / h, tables)
                room[ITERATIONS] = took
                if not 0 <= took <= MANY_ITERATIONS:
                    return -1 - k
        else:
            sound = True
            if verb != PYTHON or h != 0.0:  # not between a flight and the forces after it
                sound = land(v, push, kick, f, weights) if pairs else add_kick(v, kick, f, weights)
            if verb == PYTHON or not sound:
                return k
            if verb == PROJECT:
                if engine or not (all_finite(here) and packed_tangents(here, v, tables) and all_finite(v)):
                    return -1 - k
            elif verb == CALL:
                f = forces[begin : begin + n]
                if _call(int(program[row + ADDRESS]), (here, v, f, h, numbers, tables)) != 0:
                    return -1 - k
        k += 1


@intrinsic
def _borrowed(typingctx, numbers, first, size):  # type: ignore[no-untyped-def]
    """Numbers in a row as points, shape (size / 3, 3), which are not counted among the users of their memory."""
    kind = types.Array(types.float64, 2, "C")

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        three = context.get_constant(types.intp, 3)
        return view(context, builder, kind, builder.gep(data, [args[1]]), builder.sdiv(args[2], three), three)

    return kind(numbers, types.int64, types.int64), codegen


_points: Any = _borrowed


@njit(cache=True, nogil=True, inline="always")
def _place(number, x, out, spare):  # type: ignore[no-untyped-def]
    place = x
    if number == 1.0:
        place = out
    elif number == 2.0:
        place = spare
    return place


# Flat loops over few arrays: only these are compiled to vector instructions. All say whether the force of the kick is
# finite: one more call for that, after a long calculation of forces, costs what the engine takes for ten molecules.


@njit(cache=True, nogil=True)
def all_finite(values):  # type: ignore[no-untyped-def]
    """Whether no number is NaN or infinite."""
    # The largest exponent is that of NaN and infinities; integers, so that the loop becomes vector instructions.
    numbers = bits(values)
    worst = np.int64(0)
    for i in range(numbers.size):
        worst = max(worst, numbers[i] & 0x7FF0000000000000)
    return worst != 0x7FF0000000000000


def check_finite(values: FloatArray, item: str, step: int) -> None:
    """Raise `NonFiniteError` unless every number is finite."""
    if all_finite(values):
        return
    atom = int(np.argmax(~np.isfinite(values).all(axis=1)))
    raise NonFiniteError(
        f"non-finite {item} at step {step} on atom {atom}: {values[atom]}. The state before this step is intact; "
        "check the geometry and the force function there, or use a smaller time step",
        item=item,
        atom=atom,
        step=step,
    )


@njit(cache=True, nogil=True, fastmath=SUMS)
def square_sum(u, masses):  # type: ignore[no-untyped-def]
    """u^T M u."""
    a, m = flat(u), flat(masses)
    uu = 0.0
    for i in range(a.size):
        uu += m[i] * a[i] * a[i]
    return uu


@njit(cache=True, nogil=True)
def add_kick(v, kick, f, weights):  # type: ignore[no-untyped-def]
    """v += kick M^-1 f."""
    sound = kick == 0.0 or all_finite(f)
    b, g, w = flat(v), flat(f), flat(weights)
    if kick != 0.0:
        for i in range(b.size):
            b[i] += kick * w[i] * g[i]
    return sound


@njit(cache=True, nogil=True)
def land(v, push, kick, f, weights):  # type: ignore[no-untyped-def]
    """v += push + kick M^-1 f, and forget what rounding took: push = 0."""
    sound = kick == 0.0 or all_finite(f)
    b, p, g, w = flat(v), flat(push), flat(f), flat(weights)
    for i in range(b.size):
        b[i] += p[i] + kick * w[i] * g[i]
        p[i] = 0.0
    return sound


@njit(cache=True, nogil=True, fastmath={"contract"})
def fly(x, x_low, v, push, kick, f, weights, h, out):  # type: ignore[no-untyped-def]
    """Take the kick and `push` into the velocity, then out = x + h v; sums by Dekker's addition.

    It is exact where the change is the smaller number. Where a coordinate crosses 0 it is not; the error is then one
    of the rounding of the change, not of the coordinate.
    """
    sound = kick == 0.0 or all_finite(f)
    a, a_low, b, p, c = flat(x), flat(x_low), flat(v), flat(push), flat(out)
    g, w = flat(f), flat(weights)
    for i in range(a.size):
        change = p[i] + kick * w[i] * g[i]
        total = b[i] + change
        low = change - (total - b[i])
        b[i] = total
        p[i] = low
        change = h * total + (h * low + a_low[i])
        there = a[i] + change
        a_low[i] = change - (there - a[i])
        c[i] = there
    return sound


@njit(cache=True, nogil=True, fastmath={"contract"})
def fly_once(x, v, kick, f, weights, h, out):  # type: ignore[no-untyped-def]
    """The same where a step has one flight, and there is nothing to add up."""
    sound = kick == 0.0 or all_finite(f)
    a, b, c, g, w = flat(x), flat(v), flat(out), flat(f), flat(weights)
    for i in range(a.size):
        b[i] += kick * w[i] * g[i]
        c[i] = a[i] + h * b[i]
    return sound


@njit(cache=True, nogil=True)
def fly_circles(x, x_low, v, push, kick, f, weights, h, out, spheres):  # type: ignore[no-untyped-def]
    """The same in free flight, with atoms of spheres on great circles: exact, without iteration or a limit on h.

    n = (x - c)/R turns in the plane of n and v by |v| h/R: x1 = c + R (n cos + e sin), v1 = |v| (e cos - n sin), with
    e = v/|v|. `spheres` has c and R of each atom; R is 0 for atoms that are free, and -1 for those at rest.

    References
    ----------
    Leimkuhler and Matthews, Proc. R. Soc. A 472, 20160138 (2016).
    """
    sound = kick == 0.0 or all_finite(f)
    a, a_low, b, p, c = flat(x), flat(x_low), flat(v), flat(push), flat(out)
    g, w = flat(f), flat(weights)
    for i in range(a.size):
        change = p[i] + kick * w[i] * g[i]
        total = b[i] + change
        p[i] = change - (total - b[i])
        b[i] = total
    for i in range(0, a.size, 3):
        r = spheres[4 * (i // 3) + 3]
        d0 = (a[i] - spheres[4 * (i // 3)]) + a_low[i]
        d1 = (a[i + 1] - spheres[4 * (i // 3) + 1]) + a_low[i + 1]
        d2 = (a[i + 2] - spheres[4 * (i // 3) + 2]) + a_low[i + 2]
        length = math.sqrt(d0 * d0 + d1 * d1 + d2 * d2) if r > 0.0 else 1.0
        outward = (d0 * b[i] + d1 * b[i + 1] + d2 * b[i + 2]) / length
        across = 0.0
        for k, d in enumerate((d0, d1, d2)):
            across += (b[i + k] - outward * (d / length)) ** 2
        speed = math.sqrt(across)
        angle = speed * h / r if r > 0.0 else 0.0
        # sin(angle)/speed and cos(angle) - 1, also for atoms at rest.
        sine = h / r * (math.sin(angle) / angle) if angle != 0.0 else h / max(r, 1e-300)
        less = -2.0 * math.sin(0.5 * angle) ** 2
        for k, d in enumerate((d0, d1, d2)):
            j, n = i + k, d / length
            change = h * b[j] + (h * p[j] + a_low[j])
            if r > 0.0:
                u = b[j] - outward * n
                change = a_low[j] + ((r * n - d) + r * (n * less + u * sine))
                p[j] += u * less - n * (across * sine) - outward * n
            there = a[j] + change
            a_low[j] = change - (there - a[j])
            if r < 0.0:
                there, a_low[j] = a[j], 0.0
            c[j] = there
    return 1 if sound else 0


@njit(cache=True, nogil=True)
def beyond(x, atoms, anchor, ratio):  # type: ignore[no-untyped-def]
    """Whether the anchor is farther from the origin than `ratio` times any atom is from the anchor."""
    a, b = flat(x), 3 * anchor
    far = max(abs(a[b]), abs(a[b + 1]), abs(a[b + 2])) / ratio
    for n in range(3 * atoms.size):
        k = n % 3
        if not abs(a[3 * atoms[n // 3] + k] - a[b + k]) < far:
            return False
    return True
