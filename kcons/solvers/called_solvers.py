"""Solvers that other kernels call by the addresses of their functions.

A kernel that knew every solver would be compiled for each combination of them. Here a solver is data: its tables in one
array, the numbers of its rows in another, and three functions that all such solvers have alike. They are compiled for
the solver itself, and for nobody else again:

``_positions(careful, alone, x, x_ref, velocities, inv_dt, wanted, lattice, periodic, tables, numbers)``
    solves the SHAKE condition; ``_tangents(alone, x, y, wanted, ...)`` makes y tangent at x. Both return what an
    `Outcome` holds. An empty `wanted` stands for the targets found at set-up, and for no motion of the surface.
``_apply(x, factor, tables)``
    adds the last solution times `factor`. Solvers that are `alone` have done so with 1 for what they solve, and with
    inv_dt for velocities. Otherwise nothing is written until each of them has found its solution.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from kcons.constraints.compilation import njit
from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.solvers.cluster_solver import Outcome, Request
from kcons.solvers.kernels.array_views import view
from kcons.solvers.kernels.groups_of_eight import NO_LATTICE, NO_NUMBERS
from kcons.solvers.sparse.row_functions import GivenRows

_NUMBERS, _POINTS, _LATTICE = types.float64[::1], types.float64[:, ::1], types.float64[:, :, ::1]
_ALIKE = _NUMBERS, _LATTICE, types.boolean, _NUMBERS, _NUMBERS
_FOUND = types.Tuple((types.boolean, types.float64, types.int64, types.int64))
_POSITIONS = _FOUND(types.boolean, types.boolean, _POINTS, _POINTS, _POINTS, types.float64, *_ALIKE)
_TANGENTS = _FOUND(types.boolean, _POINTS, _POINTS, *_ALIKE)
_APPLY = types.none(_POINTS, types.float64, _NUMBERS)
#: Words that are kept of a solver: where its functions are, then where each array is and how many numbers it has.
WORDS = 7


class CalledSolver(ABC):
    """Base of these solvers, each a `ClusterSolver`.

    Attributes
    ----------
    rows : ndarray of int64
        Row numbers in the order of the kernels.
    tables : ndarray of float64
        What the kernels know of the rows, in one array.
    numbers : ndarray of float64
        What functions among the rows get and give; begins as `kcons.solvers.sparse.row_functions` says.
    """

    rows: IntArray
    tables: FloatArray
    #: Ways of solving for positions, one after the other until one arrives.
    ways: tuple[bool, ...] = (False,)
    _given: GivenRows
    _solution: FloatArray
    #: Whether rows take whole cells off positions.
    _moved = False

    @property
    @abstractmethod
    def kernels(self) -> tuple[Any, Any, Any]:
        """`_positions`, `_tangents` and `_apply`."""

    @property
    def numbers(self) -> FloatArray:
        return self._given.numbers

    def refuse(self) -> None:
        """Raise what a Python function among the rows has raised while a kernel ran."""
        self._given.refuse()

    def _take_off(self, moved: FloatArray | None) -> None:
        """Let rows with a place in space take these whole cells off the positions of their atoms."""

    def positions(self, request: Request, multipliers: FloatArray | None = None) -> Outcome:
        """Solve the SHAKE condition by true Newton, in place."""
        x, reference, wanted, lattice, time, reference_time, velocities, inv_dt, flight, moved = request
        if moved is not None or self._moved:
            self._take_off(moved)
        numbers = self._given.numbers
        numbers[:3] = time, reference_time, flight
        for careful in self.ways:
            found = self.kernels[0](
                careful, True, x, reference, x if velocities is None else velocities,
                0.0 if velocities is None else inv_dt, NO_NUMBERS if wanted is None else wanted[self.rows],
                NO_LATTICE if lattice is None else lattice, lattice is not None, self.tables, numbers,
            )  # fmt: skip
            self._given.refuse()
            if found[0]:
                break
        if found[0] and multipliers is not None:
            multipliers[:] = self._solution
        return Outcome(*found)

    def tangents(self, request: Request, multipliers: FloatArray | None = None) -> Outcome:
        """M-orthogonal projection of y onto A y = rates, in place."""
        y, x, wanted, lattice, time, _, _, _, _, moved = request
        if moved is not None or self._moved:
            self._take_off(moved)
        self._given.numbers[:3] = time, time, 1.0
        found = self.kernels[1](
            True, x, y, NO_NUMBERS if wanted is None else wanted[self.rows],
            NO_LATTICE if lattice is None else lattice, lattice is not None, self.tables, self._given.numbers,
        )  # fmt: skip
        self._given.refuse()
        if found[0] and multipliers is not None:
            np.negative(self._solution, out=multipliers)
        return Outcome(*found)


def words_of(solvers: Sequence[CalledSolver]) -> IntArray:
    """By what `solve_positions`, `solve_tangents` and `add` know solvers, to be kept as long as it is used."""
    words: list[int] = []
    for solver in solvers:
        words += [address_of(*each) for each in zip(solver.kernels, (_POSITIONS, _TANGENTS, _APPLY), strict=True)]
        for array in (solver.tables, solver.numbers):
            words += [array.ctypes.data, array.size]
    return np.array(words, dtype=np.int64)


def address_of(kernel: Any, signature: Any) -> int:
    """Where the compiled function is that a kernel has for a signature; it stays there as long as the kernel."""
    kernel.compile(signature.args)
    found = kernel.overloads[signature.args]
    return int(found.library.get_pointer_to_function(found.fndesc.llvm_func_name))


def caller_of(signature: Any) -> Any:
    """What calls, inside kernels, the function of this signature that is at an address, with a tuple of arguments."""

    @intrinsic
    def function(typingctx, address, given):  # type: ignore[no-untyped-def]
        def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
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


_call_positions, _call_tangents, _call_apply = (caller_of(kind) for kind in (_POSITIONS, _TANGENTS, _APPLY))


@intrinsic
def _borrowed(typingctx, address, size):  # type: ignore[no-untyped-def]
    """The array of doubles at an address."""

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        return view(context, builder, _NUMBERS, builder.inttoptr(args[0], ir.PointerType(ir.DoubleType())), args[1])

    return _NUMBERS(types.int64, types.int64), codegen


@njit(cache=True, nogil=True, inline="always")
def solve_positions(words, x, x_ref, v, inv_dt, none, lattice, periodic):  # type: ignore[no-untyped-def]
    """Bring `x` onto the constraints of all, and change `v` by that times `inv_dt`, if all arrive.

    Returns
    -------
    int
        The most iterations of one of them, or -1 with everything as it was.
    """
    most, alone = 0, words.size == WORDS
    for k in range(0, words.size, WORDS):
        tables, numbers = _borrowed(words[k + 3], words[k + 4]), _borrowed(words[k + 5], words[k + 6])
        given = (False, alone, x, x_ref, v, inv_dt, none, lattice, periodic, tables, numbers)
        found, _, iterations, _ = _call_positions(words[k], given)
        if not found:
            return -1
        most = max(most, iterations)
    if not alone:
        add(words, x, 1.0)
        add(words, v, inv_dt)
    return most


@njit(cache=True, nogil=True, inline="always")
def solve_tangents(words, y, x, none, lattice, periodic):  # type: ignore[no-untyped-def]
    """Make `y` tangent at `x` for all; whether they arrived, with everything as it was if not."""
    alone = words.size == WORDS
    for k in range(0, words.size, WORDS):
        tables, numbers = _borrowed(words[k + 3], words[k + 4]), _borrowed(words[k + 5], words[k + 6])
        given = (alone, x, y, none, lattice, periodic, tables, numbers)
        if not _call_tangents(words[k + 1], given)[0]:
            return False
    if not alone:
        add(words, y, 1.0)
    return True


@njit(cache=True, nogil=True, inline="always")
def add(words, x, factor):  # type: ignore[no-untyped-def]
    """Add `factor` times the solutions to `x`."""
    for k in range(0, words.size, WORDS):
        _call_apply(words[k + 2], (x, factor, _borrowed(words[k + 3], words[k + 4])))
