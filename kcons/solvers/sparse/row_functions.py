"""Rows whose value and gradient are functions that the kernels call by their addresses.

A kernel that knew every family would be compiled for all of them, and again for each of a user's own. Here a family is
data: a function ``row(r, p, t, out)`` of the positions r of a row's atoms, its parameters p and the time t puts the
value into ``out[0]`` and the gradient behind it, x, y, z by atom. It is compiled alone when it is first used. Python
functions come in by the same door; their only parameter is the number of the row in its object.

A row that is linear in the velocities, a(r, t) . v, is a function of where a flight ends: a . d, at the middle r of the
way d, which stands behind r. Its gradient by the end is a + (da/dr)^T d/2, of which only a has to be exact, and where d
is 0 it is a. Steps without the second part take more iterations.

All parameters lie in one array. It begins with two times, now and at the reference, with whether rows of velocities
count (1) or not (0), and with room for what functions get and give, from `ROOM` on; then come those of each row, and
for a function before them its address and its period.
"""

from __future__ import annotations

import ctypes
import functools
import math
from collections.abc import Callable
from typing import Any

import numba as nb
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic, is_jitted

from kcons.constraints.compilation import cfunc, njit
from kcons.constraints.constraint import Constraint, IntArray, RowKind
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.functions.custom import FunctionRows
from kcons.constraints.functions.formula import Formula
from kcons.constraints.target import FloatArray
from kcons.constraints.velocity import CustomVelocity
from kcons.solvers.kernels.any_width import pointer
from kcons.solvers.sparse.elimination import FAST
from kcons.solvers.sparse.rows_at_once import FEWEST, rows_at_once

FUNCTION = int(RowKind.FUNCTION)
#: A function of positions relative to the first atom.
RELATIVE_FUNCTION = FUNCTION + 1
#: From here on rows of velocities, of absolute positions and of differences.
VELOCITY = int(RowKind.VELOCITY)
#: Where it stands whether rows of velocities count, and the first of the numbers that a function gets and gives.
COUNT, ROOM = 2, 3
_NUMBERS = types.CPointer(types.float64)
ROW = types.void(_NUMBERS, _NUMBERS, types.float64, _NUMBERS)
_C_ROW = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_double, ctypes.c_void_p)


@intrinsic
def call_row(typingctx, numbers, function, r, p, time, out):
    """Call the function whose address is number `function`; r, p and out are places among the same numbers."""

    def codegen(context, builder, sig, args):
        places = [pointer(context, builder, sig.args[0], args[0], args[k]) for k in (1, 2, 3, 5)]
        integer = ir.IntType(64)
        address = builder.load(builder.bitcast(places[0], ir.PointerType(integer)), align=8)
        double = ir.DoubleType()
        there = ir.PointerType(double)
        kind = ir.FunctionType(ir.VoidType(), [there, there, double, there])
        function = builder.inttoptr(address, ir.PointerType(kind))
        builder.call(function, [places[1], places[2], args[4], places[3]])
        return context.get_dummy_value()

    place = types.int64
    return types.void(numbers, place, place, place, types.float64, place), codegen


# -- families -----------------------------------------------------------------------------------------------


def dihedral(r, p, t, out):
    """Of i, j, k, l from f = i - j, g = j - k, h = l - k. Blondel & Karplus, J. Comput. Chem. 17, 1132 (1996)."""
    fx, fy, fz = r[0] - r[3], r[1] - r[4], r[2] - r[5]
    gx, gy, gz = r[3] - r[6], r[4] - r[7], r[5] - r[8]
    hx, hy, hz = r[9] - r[6], r[10] - r[7], r[11] - r[8]
    ax, ay, az = fy * gz - fz * gy, fz * gx - fx * gz, fx * gy - fy * gx
    bx, by, bz = hy * gz - hz * gy, hz * gx - hx * gz, hx * gy - hy * gx
    size = math.sqrt(gx * gx + gy * gy + gz * gz)
    a2 = ax * ax + ay * ay + az * az
    b2 = bx * bx + by * by + bz * bz
    sx, sy, sz = by * az - bz * ay, bz * ax - bx * az, bx * ay - by * ax
    out[0] = math.atan2((sx * gx + sy * gy + sz * gz) / size, ax * bx + ay * by + az * bz)
    ga, gb = size / a2, size / b2
    fa = (fx * gx + fy * gy + fz * gz) / (a2 * size)
    hb = (hx * gx + hy * gy + hz * gz) / (b2 * size)
    tx, ty, tz = fa * ax - hb * bx, fa * ay - hb * by, fa * az - hb * bz
    out[1], out[2], out[3] = -ga * ax, -ga * ay, -ga * az
    out[4], out[5], out[6] = tx + ga * ax, ty + ga * ay, tz + ga * az
    out[7], out[8], out[9] = -tx - gb * bx, -ty - gb * by, -tz - gb * bz
    out[10], out[11], out[12] = gb * bx, gb * by, gb * bz


def _plane(r, p, t, out):
    """p . r."""
    out[0], out[1], out[2], out[3] = p[0] * r[0] + p[1] * r[1] + p[2] * r[2], p[0], p[1], p[2]


def _sphere(r, p, t, out):
    """Distance from the point p."""
    x, y, z = r[0] - p[0], r[1] - p[1], r[2] - p[2]
    q = math.sqrt(x * x + y * y + z * z)
    out[0], out[1], out[2], out[3] = q, x / q, y / q, z / q


def _cylinder(r, p, t, out):
    """Distance from the axis along p[3:6] through p[0:3]."""
    x, y, z = r[0] - p[0], r[1] - p[1], r[2] - p[2]
    along = x * p[3] + y * p[4] + z * p[5]
    x, y, z = x - along * p[3], y - along * p[4], z - along * p[5]
    q = math.sqrt(x * x + y * y + z * z)
    out[0], out[1], out[2], out[3] = q, x / q, y / q, z / q


def _ellipsoid(r, p, t, out):
    """s (|y| - 1), y = B (r - c); p holds s, c and B = D^-1 R^T by rows."""
    x, y, z = r[0] - p[1], r[1] - p[2], r[2] - p[3]
    a = p[4] * x + p[5] * y + p[6] * z
    b = p[7] * x + p[8] * y + p[9] * z
    c = p[10] * x + p[11] * y + p[12] * z
    length = math.sqrt(a * a + b * b + c * c)
    out[0] = p[0] * (length - 1.0)
    f = p[0] / length
    a, b, c = f * a, f * b, f * c
    out[1] = p[4] * a + p[7] * b + p[10] * c
    out[2] = p[5] * a + p[8] * b + p[11] * c
    out[3] = p[6] * a + p[9] * b + p[12] * c


def _torus(r, p, t, out):
    """Distance from the circle of radius p[6] around p[0:3], normal to p[3:6]."""
    x, y, z = r[0] - p[0], r[1] - p[1], r[2] - p[2]
    up = x * p[3] + y * p[4] + z * p[5]
    x, y, z = x - up * p[3], y - up * p[4], z - up * p[5]
    rho = math.sqrt(x * x + y * y + z * z)
    h = rho - p[6]
    q = math.sqrt(h * h + up * up)
    f, g = h / (rho * q), up / q
    out[0] = q
    out[1] = f * x + g * p[3]
    out[2] = f * y + g * p[4]
    out[3] = f * z + g * p[5]


def _distance_difference(r, p, t, out):
    """sum w |r_i - r_j|; p holds the number of atoms, that of pairs, and of each pair i, j and w."""
    for k in range(3 * int(p[0])):
        out[1 + k] = 0.0
    q = 0.0
    for n in range(int(p[1])):
        i, j, w = 3 * int(p[2 + 3 * n]), 3 * int(p[3 + 3 * n]), p[4 + 3 * n]
        x, y, z = r[i] - r[j], r[i + 1] - r[j + 1], r[i + 2] - r[j + 2]
        d = math.sqrt(x * x + y * y + z * z)
        q += w * d
        f = w / d
        x, y, z = f * x, f * y, f * z
        out[1 + i], out[2 + i], out[3 + i] = out[1 + i] + x, out[2 + i] + y, out[3 + i] + z
        out[1 + j], out[2 + j], out[3 + j] = out[1 + j] - x, out[2 + j] - y, out[3 + j] - z
    out[0] = q


def _center_distance(r, p, t, out):
    """|sum w_i r_i|; p holds the number of atoms and the signed weights."""
    n = int(p[0])
    x, y, z = 0.0, 0.0, 0.0
    for i in range(n):
        w = p[1 + i]
        x, y, z = x + w * r[3 * i], y + w * r[3 * i + 1], z + w * r[3 * i + 2]
    q = math.sqrt(x * x + y * y + z * z)
    out[0] = q
    x, y, z = x / q, y / q, z / q
    for i in range(n):
        w = p[1 + i]
        out[1 + 3 * i], out[2 + 3 * i], out[3 + 3 * i] = w * x, w * y, w * z


def _radius_of_gyration(r, p, t, out):
    """(sum w_i |r_i - C|^2)^1/2; p holds the number of atoms and the weights."""
    n = int(p[0])
    x, y, z = 0.0, 0.0, 0.0
    for i in range(n):
        w = p[1 + i]
        x, y, z = x + w * r[3 * i], y + w * r[3 * i + 1], z + w * r[3 * i + 2]
    square = 0.0
    for i in range(n):
        a, b, c = r[3 * i] - x, r[3 * i + 1] - y, r[3 * i + 2] - z
        square += p[1 + i] * (a * a + b * b + c * c)
    q = math.sqrt(square)
    out[0] = q
    for i in range(n):
        f = p[1 + i] / q
        out[1 + 3 * i] = f * (r[3 * i] - x)
        out[2 + 3 * i] = f * (r[3 * i + 1] - y)
        out[3 + 3 * i] = f * (r[3 * i + 2] - z)


def _linear_velocity(r, p, t, out):
    """p holds how many coefficients there are, and them."""
    n, speed = int(p[0]), 0.0
    for i in range(n):
        speed += p[1 + i] * r[n + i]
        out[1 + i] = p[1 + i]
    out[0] = speed


def _knife_edge(r, p, t, out):
    """(1 - s) l.d_back + s l.d_front, l = n x e, e along the blade in the plane; p holds n and s."""
    bx, by, bz = r[3] - r[0], r[4] - r[1], r[5] - r[2]
    up = bx * p[0] + by * p[1] + bz * p[2]
    bx, by, bz = bx - up * p[0], by - up * p[1], bz - up * p[2]
    length = math.sqrt(bx * bx + by * by + bz * bz)
    bx, by, bz = bx / length, by / length, bz / length
    lx, ly, lz = p[1] * bz - p[2] * by, p[2] * bx - p[0] * bz, p[0] * by - p[1] * bx
    s = p[3]
    gx, gy, gz = r[6] + s * (r[9] - r[6]), r[7] + s * (r[10] - r[7]), r[8] + s * (r[11] - r[8])
    out[0] = lx * gx + ly * gy + lz * gz
    # The blade turns by l.(change of the front less that of the back)/length, and l by that towards -e.
    half = 0.5 * (bx * gx + by * gy + bz * gz) / length
    f, g = 1.0 - s + half, s - half
    out[1], out[2], out[3] = f * lx, f * ly, f * lz
    out[4], out[5], out[6] = g * lx, g * ly, g * lz


def _rolling(r, p, t, out):
    """h.d_hub - R w.d, of s and d from hub to rim, w = [(s.n) h - (s.h) n]/rho^2; p holds R, h and n."""
    sx, sy, sz = r[3] - r[0], r[4] - r[1], r[5] - r[2]
    dx, dy, dz = r[9] - r[6], r[10] - r[7], r[11] - r[8]
    ahead, up = sx * p[1] + sy * p[2] + sz * p[3], sx * p[4] + sy * p[5] + sz * p[6]
    forth, rise = dx * p[1] + dy * p[2] + dz * p[3], dx * p[4] + dy * p[5] + dz * p[6]
    f = p[0] / (ahead * ahead + up * up)
    turn = f * (up * forth - ahead * rise)
    out[0] = r[6] * p[1] + r[7] * p[2] + r[8] * p[3] - turn
    # R w, and half of what R w.d changes by with s: both have parts along h and n only.
    g = turn * f / p[0]
    a = f * up - 0.5 * f * rise - g * ahead
    b = -f * ahead + 0.5 * f * forth - g * up
    x, y, z = a * p[1] + b * p[4], a * p[2] + b * p[5], a * p[3] + b * p[6]
    out[1], out[2], out[3] = p[1] + x, p[2] + y, p[3] + z
    out[4], out[5], out[6] = -x, -y, -z


FAMILIES: dict[str, Callable[..., None]] = {
    "Dihedral": dihedral,
    "Plane": _plane,
    "Sphere": _sphere,
    "Cylinder": _cylinder,
    "Ellipsoid": _ellipsoid,
    "Torus": _torus,
    "DistanceDifference": _distance_difference,
    "CenterDistance": _center_distance,
    "RadiusOfGyration": _radius_of_gyration,
    "LinearVelocity": _linear_velocity,
    "KnifeEdge": _knife_edge,
    "Rolling": _rolling,
}


@functools.cache
def _compiled(function: Callable[..., None]) -> Any:
    return cfunc(ROW, cache=True, fastmath=FAST, error_model="numpy")(function)


@functools.cache
def _of_jitted(function: Any, gradient: Any, width: int, timed: bool) -> Any:
    """A row of two functions that Numba has compiled, or will."""
    shape = (width, 3)
    if timed:

        @cfunc(ROW)
        def row(r, p, t, out):
            x = nb.carray(r, shape)
            out[0] = function(x, t)
            slope = gradient(x, t)
            for i in range(width):
                for j in range(3):
                    out[1 + 3 * i + j] = slope[i, j]
    else:

        @cfunc(ROW)
        def row(r, p, t, out):
            x = nb.carray(r, shape)
            out[0] = function(x)
            slope = gradient(x)
            for i in range(width):
                for j in range(3):
                    out[1 + 3 * i + j] = slope[i, j]

    return row


@functools.cache
def _of_jitted_coefficients(coefficients: Any, width: int, timed: bool, step: float) -> Any:
    """A row of velocities whose coefficients Numba has compiled, or will; `step` is that of differences."""
    shape = (width, 3)
    if timed:

        @njit
        def found(x, t):
            return coefficients(x, t)
    else:

        @njit
        def found(x, t):
            return coefficients(x)

    @cfunc(ROW)
    def row(r, p, t, out):
        x, way = nb.carray(r, shape), 0.0
        slope = np.ascontiguousarray(found(x, t)).copy()
        out[0] = 0.0
        for i in range(width):
            for j in range(3):
                d = r[3 * (width + i) + j]
                out[0] += slope[i, j] * d
                out[1 + 3 * i + j] = slope[i, j]
                way += abs(d)
        if way > 0.0:
            for k in range(3 * width):
                middle = r[k]
                r[k] = middle + step
                near = found(x, t)
                change = 0.0
                for i in range(width):
                    for j in range(3):
                        change += (near[i, j] - slope[i, j]) * r[3 * (width + i) + j]
                r[k] = middle
                out[1 + k] += 0.5 * change / step

    return row


class PythonRows:
    """The rows of one object whose functions are Python's; what these raise is kept until the kernel has ended.

    Beside a function that takes a microsecond everything done here shows.
    """

    def __init__(self, item: FunctionRows | CustomVelocity, numbers: FloatArray) -> None:
        self.error: BaseException | None = None
        width, count = item.width, 3 * item.width
        start = numbers.ctypes.data
        row = _velocity_row(item) if isinstance(item, CustomVelocity) else _position_row(item)
        shape = (width, 3) if item.holonomic else (2, width, 3)
        # By address: places, rows, values, gradients.
        places: dict[int, FloatArray] = {}
        rows: dict[int, int] = {}
        values: dict[int, tuple[FloatArray, FloatArray]] = {}

        def piece(address: int, size: int) -> FloatArray:
            first = (address - start) >> 3
            return numbers[first : first + size]

        def called(r: int, p: int, time: float, out: int) -> None:
            try:
                if r not in places:
                    places[r] = piece(r, math.prod(shape)).reshape(shape)
                if p not in rows:
                    rows[p] = int(piece(p, 1)[0])
                if out not in values:
                    values[out] = piece(out, 1), piece(out + 8, count).reshape(width, 3)
                value, slope = values[out]
                value[0], slope[...] = row(rows[p], places[r], time)
            except BaseException as error:
                self.error = self.error or error
                piece(out, 1 + count)[:] = np.nan

        self._function = _C_ROW(called)
        self.address = ctypes.cast(self._function, ctypes.c_void_p).value


def _position_row(item: FunctionRows) -> Callable[[int, FloatArray, float], tuple[float, FloatArray]]:
    """Its rows; of a place that comes twice running, as the end of a step and the start of the next, one gradient.

    The value is found again, and the gradient with it where the value is another: what the function reads besides may
    have changed.
    """
    last: dict[int, tuple[bytes, float, float, FloatArray]] = {}

    def row(k: int, place: FloatArray, time: float) -> tuple[float, FloatArray]:
        # A copy: the function may keep what it sees.
        r = place.copy()
        r.setflags(False)  # type: ignore[call-arg]  # write, which by name takes three times as long
        here, value, before = r.tobytes(), item.row_value(k, r, time), last.get(k)
        if before is not None and before[0] == here and before[1] == time and before[2] == value:
            return value, before[3]
        slope = item.row_gradient(k, r, time)
        last[k] = here, time, value, slope.copy()
        return value, slope

    return row


def _velocity_row(item: CustomVelocity) -> Callable[[int, FloatArray, float], tuple[float, FloatArray]]:
    """Its rows as functions of the end of a way; coefficients of a place that comes twice running are found once."""
    last: dict[int, tuple[bytes, float, FloatArray]] = {}

    def row(k: int, place_and_way: FloatArray, time: float) -> tuple[float, FloatArray]:
        place = place_and_way[0]
        here, before = place.tobytes(), last.get(k)
        if before is None or before[0] != here or before[1] != time:
            before = last[k] = here, time, item.row(k, place.copy(), time).copy()
        return float(np.vdot(before[2], place_and_way[1])), before[2]

    return row


def row_function(item: Constraint, numbers: FloatArray) -> Any:
    """What has the `address` of the function of an object's rows, to be kept as long as that is used.

    `numbers` are those among which the function will find its arguments.
    """
    plain = plain_row(item)
    if plain is not None:
        return _compiled(plain)
    if isinstance(item, FunctionRows):
        gradient = item.gradient_function
        if item.by_row and gradient is not None and is_jitted(item.function) and is_jitted(gradient):
            return _of_jitted(item.function, gradient, item.width, item.time_dependent)
        return PythonRows(item, numbers)
    assert isinstance(item, CustomVelocity)
    if is_jitted(item.coefficients):
        return _of_jitted_coefficients(item.coefficients, item.width, item.time_dependent, 1e-6 * item.length)
    return PythonRows(item, numbers)


def plain_row(item: Constraint) -> Callable[..., None] | None:
    """``row(r, p, t, out)`` of a family or a formula."""
    return item.code().row if isinstance(item, Formula) else FAMILIES.get(item.family)


class GivenRows:
    """What kernels are given of rows besides their atoms.

    Attributes
    ----------
    kinds : ndarray of uint32, shape (n,)
        Of each row, those of functions of differences included.
    numbers : ndarray of float64
        All parameters, as the module says.
    starts : ndarray of int64, shape (n,)
        First parameter of each row.
    """

    def __init__(self, constraint_set: ConstraintSet, rows: IntArray, room: int) -> None:
        """`rows` of the set in the order of the kernels; `room` is for the numbers that functions get and give."""
        kinds, starts = np.zeros(constraint_set.n_rows, np.uint32), np.zeros(constraint_set.n_rows, np.int64)
        order = np.full(constraint_set.n_rows, -1)
        order[rows] = np.arange(len(rows))
        items = np.zeros(constraint_set.n_rows, np.int64)
        end = ROOM + room
        tables: list[tuple[Constraint, int, FloatArray]] = []
        for item, first in zip(constraint_set.constraints, constraint_set.starts, strict=False):
            mine = slice(first, first + item.n_rows)
            here = np.flatnonzero(order[mine] >= 0)
            if not len(here):
                continue
            here = here[np.argsort(order[mine][here])]
            table = item.parameters().reshape(item.n_rows, -1)[here]
            kinds[mine], items[mine] = item.kind, len(tables)
            if item.kind in (FUNCTION, VELOCITY):
                kinds[mine] += item.relative
                numbered = [here[:, None]] if item.functions else []
                table = np.hstack([np.tile([0.0, item.period or 0.0], (len(here), 1)), table, *numbered])
            if np.all(table == table[0]):
                table = table[:1]  # rows that are alike read the same numbers
            count, size = table.shape
            starts[first + here] = end + (np.arange(len(here)) * size if count > 1 else 0)
            tables.append((item, end, table))
            end += table.size
        self.kinds, self.starts, self._items = kinds[rows], starts[rows], items[rows]
        self._tables = [item for item, _, _ in tables]
        self.numbers = np.zeros(end)
        self.functions = []
        for item, first, table in tables:
            self.numbers[first : first + table.size] = table.ravel()
            if item.kind in (FUNCTION, VELOCITY):
                self.functions.append(row_function(item, self.numbers))
                self.numbers.view(np.int64)[first : first + table.size : table.shape[1]] = self.functions[-1].address

    def at_once(self, block: int) -> IntArray:
        """Of each `block` of rows the address of the function for all, and how far apart their parameters are.

        0 and 0 where rows are called one by one: few, of several atoms or objects, functions of Python. Shape (n, 2).
        """
        n = len(self.starts)
        first = np.arange(0, n, block)
        size = np.minimum(block, n - first)
        apart = np.diff(self.starts, append=0)
        alike = (apart == np.repeat(apart[first], size)) & (np.diff(self._items, append=-1) == 0)
        alike[first + size - 1] = True
        fit = np.logical_and.reduceat(alike, first) & (size >= FEWEST) if n else np.zeros(0, bool)
        runs = np.zeros((len(first), 2), np.int64)
        for k, item in enumerate(self._tables):
            mine, row = fit & (self._items[first] == k), plain_row(item)
            if mine.any() and row is not None and item.width == 1 and item.holonomic:
                runs[mine, 0], runs[mine, 1] = rows_at_once(row).address, apart[first[mine]]
        return runs

    @property
    def python(self) -> list[PythonRows]:
        return [each for each in self.functions if isinstance(each, PythonRows)]

    def refuse(self) -> None:
        """Raise what a Python function has raised while a kernel ran."""
        for each in self.functions:
            if isinstance(each, PythonRows) and each.error is not None:
                error, each.error = each.error, None
                raise error
