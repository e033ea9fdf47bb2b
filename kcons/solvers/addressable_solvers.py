"""Solvers as data: what kernels know of one is tables in one array, and functions that are called by their addresses.

A kernel that is called from Python pays for each array that it is given, and one that knows solvers of many kinds is
compiled for each of their combinations. Here a solver's functions are compiled for the solver itself, and for nobody
else again. They are alike for all of them; `kind` says which minimum image the lattice needs (`kernels.lattices`):

``_positions(alone, x, x_ref, velocities, inv_dt, wanted, lattice, kind, tables, numbers)``
    solves the SHAKE condition; ``_tangents(alone, y, x, ...)``, with the same arguments, makes y tangent at x, where
    velocities do not count. Both return what an `Outcome` holds. An empty `wanted` stands for the targets found at
    set-up, and for no motion of the surface.
``_apply(x, factor, tables)``
    adds the last solution times `factor`. A solver that is `alone` has done so with 1 for what it solves, and with
    inv_dt for velocities. Otherwise nothing is written until each of several has found its solution.
``_undo(x, tangents, velocities, tables)``
    of solvers that write at once instead: puts back points, or (`tangents` and `velocities` say which) velocities.
    Multipliers that are asked for they put into `numbers`.
``_resolved(x, lattice, kind, tables)``
    whether positions show what was found, where multipliers may be so large that their own rounding does not.

`pack_solver_tables` puts several behind one array, for `packed_positions` and `packed_tangents`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from kcons.constraints.compilation import njit
from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.solvers.cluster_solver import Outcome, Request
from kcons.solvers.kernels.aligned_memory import in_one_array
from kcons.solvers.kernels.array_views import at_piece, halves, integers, lattice_piece, table_array, view
from kcons.solvers.kernels.lattices import NO_LATTICE, lattice_kind
from kcons.solvers.kernels.two_and_four_wide import load_double, load_index, store_double
from kcons.solvers.tolerances import MAX_ROUNDS

NO_NUMBERS = np.zeros(0)
_NUMBERS, _POINTS, _LATTICE = types.float64[::1], types.float64[:, ::1], types.float64[:, :, ::1]
_ALIKE = _NUMBERS, _LATTICE, types.int64, _NUMBERS, _NUMBERS
_FOUND = types.Tuple((types.boolean, types.float64, types.int64, types.int64))
_SOLVE = _FOUND(types.boolean, _POINTS, _POINTS, _POINTS, types.float64, *_ALIKE)
_APPLY = types.none(_POINTS, types.float64, _NUMBERS)
_UNDO = types.none(_POINTS, types.boolean, types.boolean, _NUMBERS)
_RESOLVED = types.boolean(_POINTS, _LATTICE, types.int64, _NUMBERS)
_SIGNATURES = _SOLVE, _SOLVE, _APPLY, _UNDO, _RESOLVED
#: Words that are kept of a solver: where its functions are (0 for none), then where each array is and how many numbers
#: it has.
WORDS = 9


class Kernels(NamedTuple):
    """The functions of a solver, as the module describes them; None where it has none."""

    positions: Any
    tangents: Any
    apply: Any = None
    undo: Any = None
    resolved: Any = None


class AddressableSolver:
    """Base of the solvers that all kernels can call, each a `ClusterSolver`.

    Attributes
    ----------
    rows : ndarray of int64
        Row numbers in the order of the kernels.
    kernels : Kernels
    tables : ndarray of float64
        What the kernels know of the rows, in one array.
    numbers : ndarray of float64
        What functions among the rows get and give; begins as `kcons.solvers.sparse.row_functions` says. Empty for
        solvers that put multipliers there.
    """

    name: str
    rows: IntArray
    kernels: Kernels
    tables: FloatArray
    numbers: FloatArray = NO_NUMBERS
    #: Arguments that make the same solver again.
    _made_of: tuple[Any, ...]
    _solution: FloatArray
    #: Whether rows take whole cells off positions.
    _moved = False
    #: The last lattice, an array that nobody writes to, as the kernels take it.
    _lattice: FloatArray | None = None
    _cell, _kind = lattice_kind(None)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), self._made_of  # addresses are of no use elsewhere

    @property
    def pivots(self) -> FloatArray:
        """Of the last tangents, by row: 0 for rows that depend on others, where the solver has a cut for these."""
        return np.ones(len(self.rows))

    def refuse(self) -> None:
        """Raise what a Python function among the rows has raised while a kernel ran."""

    def _take_off(self, moved: FloatArray | None) -> None:
        """Let rows with a place in space take these whole cells off the positions of their atoms."""

    def _multipliers(self) -> FloatArray:
        """The last solution, by unit steps in what rows measure."""
        return self._solution

    def positions(self, request: Request, multipliers: FloatArray | None = None) -> Outcome:
        """Solve the SHAKE condition by true Newton, in place."""
        return self._solved(0, request, multipliers)

    def tangents(self, request: Request, multipliers: FloatArray | None = None) -> Outcome:
        """M-orthogonal projection of y onto A y = rates, in place."""
        return self._solved(1, request, multipliers)

    def _solved(self, kernel: int, request: Request, multipliers: FloatArray | None) -> Outcome:
        changed, reference, given, lattice, time, reference_time, velocities, inv_dt, flight, moved = request
        if moved is not None or self._moved:
            self._take_off(moved)
        if lattice is not self._lattice:
            self._lattice, (self._cell, self._kind) = lattice, lattice_kind(lattice)
        wanted = NO_NUMBERS if given is None else given[self.rows]
        numbers = self.numbers
        if numbers is not NO_NUMBERS:
            numbers[:3] = time, time if kernel else reference_time, flight or kernel
        elif multipliers is not None:
            numbers = multipliers
        if velocities is None:
            velocities, inv_dt = changed, 0.0
        found = self.kernels[kernel](
            True, changed, reference, velocities, inv_dt, wanted, self._cell, self._kind, self.tables, numbers
        )
        if self.numbers is not NO_NUMBERS:
            self.refuse()
            if found[0] and multipliers is not None:
                np.multiply(self._multipliers(), -1.0 if kernel else 1.0, out=multipliers)
        return tuple.__new__(Outcome, found)  # as `Outcome(*found)`, in a third of its time

    def rank(self, here: Request) -> int:
        """Independent rows at `here.reference`: those whose pivot does not vanish."""
        return int(np.count_nonzero(self.pivots)) if self.tangents(here).converged else len(self.rows)


def address_of(kernel: Any, signature: Any) -> int:
    """Where the compiled function is that a kernel has for a signature; it stays there as long as the kernel."""
    kernel.compile(signature.args)
    found = kernel.overloads[signature.args]
    return int(found.library.get_pointer_to_function(found.fndesc.llvm_func_name))


def caller_of(signature: Any) -> Any:
    """What calls, inside kernels, the function of this signature that is at an address, with a tuple of arguments."""

    @intrinsic
    def function(typingctx, address, given):
        def codegen(context, builder, sig, args):
            convention = context.call_conv
            kind = convention.get_function_type(signature.return_type, signature.args)
            pointer = builder.inttoptr(args[0], ir.PointerType(kind))
            values = cgutils.unpack_tuple(builder, args[1], len(signature.args))
            status, result = convention.call_function(builder, pointer, signature.return_type, signature.args, values)
            with cgutils.if_unlikely(builder, status.is_error):
                convention.return_status_propagate(builder, status)
            return result

        return signature.return_type(types.int64, types.Tuple(signature.args)), codegen

    return function


_call_solve, _call_apply, _call_undo, _call_resolved = map(caller_of, (_SOLVE, _APPLY, _UNDO, _RESOLVED))


@intrinsic
def _borrowed(typingctx, address, size):
    """The array of doubles at an address."""

    def codegen(context, builder, sig, args):
        return view(context, builder, _NUMBERS, builder.inttoptr(args[0], ir.PointerType(ir.DoubleType())), args[1])

    return _NUMBERS(types.int64, types.int64), codegen


# -- several behind one array ---------------------------------------------------------------------------------

#: Pieces: words of the solvers, fixed atoms and their places, the cell, and those of the caller.
_SOLVERS, _PINNED, _PLACES, _KIND, _CELL, MORE = range(6)


def words_of(solvers: Sequence[AddressableSolver]) -> IntArray:
    """By what kernels know solvers, to be kept as long as it is used."""
    words: list[int] = []
    for solver in solvers:
        pairs = zip(solver.kernels, _SIGNATURES, strict=True)
        words += [0 if kernel is None else address_of(kernel, signature) for kernel, signature in pairs]
        for array in (solver.tables, solver.numbers):
            words += [array.ctypes.data, array.size]
    return np.array(words, dtype=np.int64)


def pack_solver_tables(
    solvers: Sequence[AddressableSolver], pinned: IntArray, places: FloatArray, *more: NDArray[Any]
) -> FloatArray:
    """What `packed_positions` and `packed_tangents` need to know.

    Parameters
    ----------
    solvers : sequence of AddressableSolver
        Those that write at once come last, and of these those without `undo`.
    pinned : ndarray of int
        Fixed atoms.
    places : ndarray, shape (n_pinned, 3)
    *more : ndarray of float64, int64 or uint32, flat
        Pieces number `MORE` and on, for the caller's own kernels.

    Returns
    -------
    ndarray of float64
        Begins with where each piece starts and ends, as integers.
    """
    held = pinned.astype(np.uint32), places.ravel(), np.zeros(1, dtype=np.int64), NO_LATTICE.ravel()
    return in_one_array((words_of(solvers), *held, *more))


def set_lattice(tables: FloatArray, lattice: FloatArray | None) -> None:
    """Change the periodic cell, shape (2, 3, 3) with its inverse, in tables of `pack_solver_tables`."""
    values, kind = lattice_kind(lattice)
    header = tables.view(np.int64)
    tables[header[2 * _CELL] : header[2 * _CELL + 1]] = values.ravel()
    header[header[2 * _KIND]] = kind


@njit(cache=True, nogil=True, inline="always")
def _arrays(words, k):
    return _borrowed(words[k + 5], words[k + 6]), _borrowed(words[k + 7], words[k + 8])


@njit(cache=True, nogil=True)
def packed_positions(x, x_ref, v, inv_dt, tables):
    """Bring `x` onto the rows along the gradients at `x_ref`, and change `v` by that times `inv_dt`.

    Returns
    -------
    int
        The most iterations of a solver; -1 where one finds no solution, with `x` and `v` as they were but for fixed
        atoms.
    """
    t, h, u = tables, integers(tables), halves(tables)
    pinned, places = at_piece(u, h, _PINNED), at_piece(t, h, _PLACES)
    for k in range(3 * (h[2 * _PINNED + 1] - h[2 * _PINNED])):
        store_double(x, 3 * load_index(pinned, k // 3) + k % 3, load_double(places, k))
    words, none = table_array(h, h, _SOLVERS), _borrowed(0, 0)
    lattice, kind = lattice_piece(t, h, _CELL), h[h[2 * _KIND]]
    most = 0
    for k in range(0, words.size, WORDS):
        mine, numbers = _arrays(words, k)
        alike = x, x_ref, v, inv_dt, none, lattice, kind, mine, numbers
        found, _, iterations, _ = _call_solve(words[k], (False, *alike))
        if not found:
            for j in range(0, k, WORDS):
                if words[j + 3] != 0:
                    _call_undo(words[j + 3], (x, False, False, _arrays(words, j)[0]))
                    _call_undo(words[j + 3], (v, False, True, _arrays(words, j)[0]))
            return -1
        most = max(most, iterations)
    for k in range(0, words.size, WORDS):
        mine, numbers = _arrays(words, k)
        alike = x, x_ref, v, inv_dt, none, lattice, kind, mine, numbers
        # Large multipliers have a rounding that shows in the positions; another round takes it away.
        for again in range(MAX_ROUNDS + 1):
            if words[k + 2] != 0:
                _call_apply(words[k + 2], (x, 1.0, mine))
                _call_apply(words[k + 2], (v, inv_dt, mine))
            if words[k + 4] == 0 or again == MAX_ROUNDS or _call_resolved(words[k + 4], (x, lattice, kind, mine)):
                break
            found, _, iterations, _ = _call_solve(words[k], (False, *alike))
            if not found:
                break
            most = max(most, iterations)
    return most


@njit(cache=True, nogil=True)
def packed_tangents(x, v, tables):
    """Project `v` so that no row changes; whether that was possible, `v` otherwise as it was."""
    t, h, u = tables, integers(tables), halves(tables)
    pinned = at_piece(u, h, _PINNED)
    for k in range(3 * (h[2 * _PINNED + 1] - h[2 * _PINNED])):
        store_double(v, 3 * load_index(pinned, k // 3) + k % 3, 0.0)
    words, none = table_array(h, h, _SOLVERS), _borrowed(0, 0)
    lattice, kind = lattice_piece(t, h, _CELL), h[h[2 * _KIND]]
    for k in range(0, words.size, WORDS):
        mine, numbers = _arrays(words, k)
        if not _call_solve(words[k + 1], (False, v, x, v, 0.0, none, lattice, kind, mine, numbers))[0]:
            for j in range(0, k, WORDS):
                if words[j + 3] != 0:
                    _call_undo(words[j + 3], (v, True, False, _arrays(words, j)[0]))
            return False
    for k in range(0, words.size, WORDS):
        if words[k + 2] != 0:
            _call_apply(words[k + 2], (v, 1.0, _arrays(words, k)[0]))
    return True
