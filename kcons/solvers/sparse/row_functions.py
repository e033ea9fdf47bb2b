"""Rows whose value and gradient are functions that the kernels call by their addresses.

A kernel that knew every family would be compiled for all of them, and again for each of a user's own. Here a family is
data: its function ``row(r, p, t, out)``, see `Constraint.row`, is compiled alone when it is first used. Python
functions come in by the same door; their only parameter is the number of the row in its object.

A row that is linear in the velocities, a(r, t) . v, is a function of where a flight ends: a . d, at the middle r of the
way d, which stands behind r. Its gradient by the end is a + (da/dr)^T d/2, of which only a has to be exact, and where d
is 0 it is a. Steps without the second part take more iterations.

Of many rows of one atom each, a block is taken by one function with a loop over the rows, of which the compiler makes
vector code where the family's function allows it. Positions stand as all x, all y and all z; what is put out stands row
by row. Rows may share their parameters, or have them one after another.

All parameters lie in one array. It begins with two times, now and at the reference, with whether rows of velocities
count (1) or not (0), and with room for what functions get and give, from `ROOM` on; then come those of each row, and
for a function before them its address and its period.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Callable
from typing import Any

import numba as nb
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import is_jitted, register_jitable

from kcons.constraints.compilation import cfunc, has_a_file
from kcons.constraints.constraint import Constraint, IntArray, RowKind
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.functions.custom import Custom
from kcons.constraints.target import FloatArray
from kcons.solvers.kernels.any_width import DOUBLE, INT64, instruction, place
from kcons.solvers.sparse.elimination import FAST

FUNCTION = int(RowKind.FUNCTION)
#: A function of positions relative to the first atom.
RELATIVE_FUNCTION = FUNCTION + 1
#: From here on rows of velocities, of absolute positions and of differences.
VELOCITY = int(RowKind.VELOCITY)
#: The most rows that are taken at once.
BLOCK = 32
#: And the fewest for which this is worth the call.
FEWEST = 8
#: Where it stands whether rows of velocities count, and the first of the numbers that a function gets and gives.
COUNT, ROOM = 2, 3
_NUMBERS = types.CPointer(types.float64)
ROW = types.void(_NUMBERS, _NUMBERS, types.float64, _NUMBERS)
_ROWS = types.void(types.int64, _NUMBERS, _NUMBERS, types.int64, types.float64, _NUMBERS)
_C_ROW = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_double, ctypes.c_void_p)


_INDEX = types.int64


@instruction(types.void, None, _INDEX, _INDEX, _INDEX, types.float64, _INDEX)
def call_row(builder, numbers, function, r, p, time, out):
    """Call the function whose address is number `function`; r, p and out are places among the same numbers."""
    function, r, p, out = (place(builder, numbers, at) for at in (function, r, p, out))
    kind = ir.FunctionType(ir.VoidType(), [r.type, r.type, DOUBLE, r.type])
    address = builder.load(builder.bitcast(function, ir.PointerType(INT64)), align=8)
    builder.call(builder.inttoptr(address, ir.PointerType(kind)), [r, p, time, out])


@instruction(types.void, None, *(5 * (_INDEX,)), types.float64, _INDEX)
def call_rows(builder, numbers, address, n, r, p, stride, time, out):
    """Call the function at `address` for n rows; r, p and out are places among the numbers."""
    r, p, out = (place(builder, numbers, at) for at in (r, p, out))
    kind = ir.FunctionType(ir.VoidType(), [INT64, r.type, r.type, INT64, DOUBLE, r.type])
    builder.call(builder.inttoptr(address, ir.PointerType(kind)), [n, r, p, stride, time, out])


@instruction(_NUMBERS, _NUMBERS, _INDEX)
def _from(builder, numbers, start):
    """The numbers behind the first `start`."""
    return place(builder, numbers, start)


@functools.cache
def _compiled(function: Callable[..., None]) -> Any:
    return cfunc(ROW, cache=has_a_file(function), fastmath=FAST, error_model="numpy")(function)


@functools.cache
def _of_jitted(value: Any, gradient: Any, width: int) -> Any:
    """A row of two functions that Numba has compiled, or will."""
    shape = (width, 3)

    @cfunc(ROW)
    def row(r, p, t, out):
        x = nb.carray(r, shape)
        out[0] = value(x)
        slope = gradient(x)
        for i in range(width):
            for j in range(3):
                out[1 + 3 * i + j] = slope[i, j]

    return row


@functools.cache
def rows_at_once(function: Callable[..., None]) -> Any:
    """Of ``row(r, p, t, out)`` for one atom, compiled; has an `address`."""
    # Not compiled apart: what Numba keeps is found again by the function's name, and by no name that it gives itself.
    row = register_jitable(fastmath=FAST, error_model="numpy")(function)

    def rows(n, r, p, stride, t, out):
        if stride == 0:
            for i in range(n):
                row((r[i], r[BLOCK + i], r[2 * BLOCK + i]), p, t, _from(out, 4 * i))
        else:
            for i in range(n):
                row((r[i], r[BLOCK + i], r[2 * BLOCK + i]), _from(p, stride * i), t, _from(out, 4 * i))

    rows.__qualname__ = f"rows_at_once.{function.__qualname__}"  # each family has a file of its own
    return cfunc(_ROWS, cache=has_a_file(function), fastmath=FAST, error_model="numpy")(rows)


class CalledRows:
    """The rows of one object whose functions are Python's; what these raise is kept until the kernel has ended.

    Beside a function that takes a microsecond everything done here shows.
    """

    def __init__(self, item: Custom, numbers: FloatArray) -> None:
        self.error: BaseException | None = None
        width, count = item.width, 3 * item.width
        start = numbers.ctypes.data
        row = _function_of(item)
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
                    places[r] = piece(r, count).reshape(width, 3)
                if p not in rows:
                    rows[p] = int(piece(p, 1)[0])
                if out not in values:
                    values[out] = piece(out, 1), piece(out + 8, count).reshape(width, 3)
                value, slope = values[out]
                value[0], slope[...] = row(rows[p], places[r])
            except BaseException as error:
                self.error = self.error or error
                piece(out, 1 + count)[:] = np.nan

        self._function = _C_ROW(called)
        self.address = ctypes.cast(self._function, ctypes.c_void_p).value


def _function_of(item: Custom) -> Callable[[int, FloatArray], tuple[float, FloatArray]]:
    """Its rows; of a place that comes twice running, as the end of a step and the start of the next, one gradient.

    The value is found again, and the gradient with it where the value is another: what the function reads besides may
    have changed.
    """
    last: dict[int, tuple[bytes, float, FloatArray]] = {}

    def row(k: int, place: FloatArray) -> tuple[float, FloatArray]:
        # A copy: the function may keep what it sees.
        r = place.copy()
        r.setflags(False)  # type: ignore[call-arg]  # write, which by name takes three times as long
        here, value, before = r.tobytes(), item.row_value(k, r), last.get(k)
        if before is not None and before[0] == here and before[1] == value:
            return value, before[2]
        slope = item.row_gradient(k, r)
        last[k] = here, value, slope.copy()
        return value, slope

    return row


def row_function(item: Constraint, numbers: FloatArray) -> Any:
    """What has the `address` of the function of an object's rows, to be kept as long as that is used.

    `numbers` are those among which the function will find its arguments.
    """
    if item.row is not None:
        return _compiled(item.row)
    assert isinstance(item, Custom)
    gradient = item.gradient_function
    if gradient is not None and is_jitted(item.function) and is_jitted(gradient):
        return _of_jitted(item.function, gradient, item.width)
    return CalledRows(item, numbers)


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
            mine = fit & (self._items[first] == k)
            if mine.any() and item.row is not None and item.width == 1 and item.holonomic:
                runs[mine, 0], runs[mine, 1] = rows_at_once(item.row).address, apart[first[mine]]
        return runs

    @property
    def python(self) -> list[CalledRows]:
        return [each for each in self.functions if isinstance(each, CalledRows)]

    def refuse(self) -> None:
        """Raise what a Python function has raised while a kernel ran."""
        for each in self.functions:
            if isinstance(each, CalledRows) and each.error is not None:
                error, each.error = each.error, None
                raise error
