"""The projections of `RigidTriangles` and `SmallClusters` inside other kernels.

A call from Python to a kernel costs as much as its work on ten molecules, so that kernels that do all of a stage are
worth having. Such a kernel closes over one whole number, the kind of its solver, and calls `land` and `level` with it;
Numba finds the solver's kernel while it compiles. (A kernel that closes over another one is never found again in
Numba's cache on disk.)
"""

from __future__ import annotations

from typing import Any

from numba.core import types
from numba.core.errors import TypingError
from numba.extending import overload
from numpy.typing import NDArray

from kcons.solvers.lanes import SmallClusters, lane_kernels
from kcons.solvers.water import RigidTriangles, triangle_positions, triangle_tangents

#: The kind of `RigidTriangles`; that of `SmallClusters` is the number of rows in a cluster.
TRIANGLES = 0

Tables = tuple[NDArray[Any], ...]


def kind_and_tables(solver: Any) -> tuple[int, Tables] | None:
    """The kind of a solver and the arrays that its kernels work on; None if it is of neither kind."""
    if isinstance(solver, RigidTriangles):
        return TRIANGLES, solver.tables()
    if isinstance(solver, SmallClusters):
        tables = solver.tables()
        return len(tables[2]) // 2, tables
    return None


def land(solver, x, reference, v, inverse_dt, lattice, image, tables):  # type: ignore[no-untyped-def]
    """Bring `x` onto held lengths along gradients at `reference`, and correct `v`; for compiled code only.

    Parameters
    ----------
    solver : int
        Kind of the solver, a constant.
    lattice, image
        As `kcons.solvers.groups.lattice_kind` gives them.
    tables : tuple
        As `kind_and_tables` gives them.

    Returns
    -------
    int
        Iterations; -1 if it did not converge, and nothing has changed.
    """
    raise NotImplementedError


def level(solver, x, y, lattice, image, tables):  # type: ignore[no-untyped-def]
    """Project the vectors `y` at `x` onto held lengths at rest; whether it converged, else nothing has changed."""
    raise NotImplementedError


def _number(solver: Any) -> int:
    if not isinstance(solver, types.IntegerLiteral):
        raise TypingError("the kind of the solver must be a constant")
    return int(solver.literal_value)


@overload(land, prefer_literal=True)
def _land(solver, x, reference, v, inverse_dt, lattice, image, tables):  # type: ignore[no-untyped-def]
    number = _number(solver)
    if number == TRIANGLES:

        def triangles(solver, x, reference, v, inverse_dt, lattice, image, tables):  # type: ignore[no-untyped-def]
            atoms, slots, lengths, inv_mass, undo = tables
            converged, _, iterations, _ = triangle_positions(
                x, reference, v, inverse_dt, atoms, slots, lengths, inv_mass, lattice, image, v[:0], undo
            )
            return iterations if converged else -1

        return triangles
    positions = lane_kernels(number)[0]

    def lanes(solver, x, reference, v, inverse_dt, lattice, image, tables):  # type: ignore[no-untyped-def]
        atoms, slots, ends, weights, couplings, lengths, undo = tables
        converged, _, iterations, _ = positions(
            x, reference, v, inverse_dt, atoms, slots, ends, weights, couplings, lengths, lattice, image, undo[:0], undo
        )
        return iterations if converged else -1

    return lanes


@overload(level, prefer_literal=True)
def _level(solver, x, y, lattice, image, tables):  # type: ignore[no-untyped-def]
    number = _number(solver)
    if number == TRIANGLES:

        def triangles(solver, x, y, lattice, image, tables):  # type: ignore[no-untyped-def]
            atoms, slots, _, inv_mass, undo = tables
            return triangle_tangents(x, y, atoms, slots, y[:0], inv_mass, lattice, image, y[:0], undo)[0]

        return triangles
    tangents = lane_kernels(number)[1]

    def lanes(solver, x, y, lattice, image, tables):  # type: ignore[no-untyped-def]
        atoms, slots, ends, weights, couplings, _, undo = tables
        none = undo[:0]
        return tangents(x, y, atoms, slots, ends, weights, couplings, none, lattice, image, none, undo)[0]

    return lanes
