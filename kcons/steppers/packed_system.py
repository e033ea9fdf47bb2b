"""What compiled steps know of a system: 1/m, spheres, how far is far, and its rows where kernels know all of them.

The tables are those of `solvers.addressable_solvers`: rigid triangles, chains and rows of all kinds at rest, each
with its solver, behind one array of numbers.
"""

from __future__ import annotations

from copy import copy
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.surface import Sphere
from kcons.constraints.target import FloatArray
from kcons.motion.motion import Motion
from kcons.solvers.addressable_solvers import AddressableSolver, pack_solver_tables, set_lattice
from kcons.solvers.chains import Chains
from kcons.solvers.cluster_solver import ClusterSolver
from kcons.solvers.rigid_triangles import RigidTriangles
from kcons.solvers.single_rows import SingleRows
from kcons.solvers.small_clusters import SmallClusters
from kcons.solvers.sparse.distances import SparseDistances
from kcons.solvers.sparse.mixed_rows import SparseRows
from kcons.solvers.sparse.row_functions import COUNT

#: Rows, besides those of triangles, up to which one kernel for all shapes is faster than the engine's for each shape.
MOST_ROWS = 96
#: Chains have a kernel of their own, which costs as much as that for all shapes on so many rows, and so many more a
#: slot of eight lanes; where others are held so that both are called, on more.
CHAIN_ROWS, CHAIN_ROWS_BESIDES, ROWS_A_SLOT = 20, 40, 2


#: Solvers of held distances.
OF_DISTANCES = RigidTriangles, SmallClusters, Chains, SparseDistances


class PackedSystem:
    """All rows of a system and its cell as the tables of compiled steps.

    Parameters
    ----------
    motion : Motion
    called : list of AddressableSolver
        Whom the kernels call by what stands in the tables; kept as long as these.
    tables : ndarray of float64
        From `pack_solver_tables`.
    more : tuple of ndarray
        What is behind the rows, see `System`.
    """

    def __init__(
        self, motion: Motion, called: list[AddressableSolver], tables: FloatArray, more: tuple[NDArray[Any], ...]
    ) -> None:
        self.motion, self.called, self._tables, self._more = motion, called, tables, more
        self._cell, self._sources = motion.cell, motion.sources
        self._lattice = motion.lattice
        #: Those that the engine was told of last; -1: of none.
        self.iterations = -1.0
        set_lattice(self._tables, self._lattice)

    def __reduce__(self) -> tuple[Any, ...]:
        return packed_system, (self.motion, *self._more)  # addresses are of no use elsewhere

    @property
    def tables(self) -> FloatArray:
        """What the kernels need to know, with the cell as it is now."""
        given, held = self._sources
        if held.lattice is not self._lattice or given.lattice is not self._lattice:
            self._lattice = self._cell()
            set_lattice(self._tables, self._lattice)
        return self._tables

    def refuse(self) -> None:
        """Raise what a Python function among the rows has raised, where a kernel reports that it could not go on."""
        for solver in self.called:
            solver.refuse()

    def took(self, iterations: float) -> None:
        """Let the engine report these iterations; a negative number forgets them."""
        self.iterations = iterations
        if iterations >= 0:
            self.motion.took(int(iterations))


def spheres_of(motion: Motion) -> FloatArray | None:
    """Center and radius of each atom where all rows keep one atom on a resting sphere, or at rest; otherwise None.

    The radius of atoms that are free is 0, of those at rest -1.
    """
    found, none = np.zeros((motion.n_atoms, 4)), np.zeros(0, dtype=np.int64)
    held, resting = [none], [none]
    for item in motion.constraint_set.constraints:
        if item.moving:
            return None
        if isinstance(item, Sphere):
            held.append(item.atoms[:, 0])
            found[held[-1], :3], found[held[-1], 3] = item.center, item.target_at(0.0)
        elif item.fixes_atoms:
            resting.append(item.atoms.ravel())
        else:
            return None
    atoms, still = np.concatenate(held), np.concatenate(resting)
    if not len(atoms) or len(np.unique(atoms)) != len(atoms) or np.isin(atoms, still).any():
        return None
    found[still, 3] = -1.0
    return found


def packed_system(motion: Motion, *more: NDArray[Any]) -> PackedSystem | None:
    """All rows, and `more`; None where there are rows that move, that the kernels do not know, or too many."""
    plan, held = motion.plan, motion.constraint_set
    if held.moving or any(plan.whole) or (plan.driven and held.target(0.0)[~held.holonomic].any()):
        return None
    # Where few atoms are held, the engine works on a copy of these, and counts only them.
    compact = plan.constraint_set is not held
    inverse_masses, pinned = plan.inverse_masses, plan.pinned
    if compact:
        inverse_masses = np.zeros(motion.n_atoms)
        inverse_masses[held.touched] = plan.inverse_masses
        pinned = held.touched[pinned]
    triangles: RigidTriangles | None = None
    chains: Chains | None = None
    rows: list[IntArray] = [np.zeros(0, dtype=np.int64)]
    mixed = [solver for solver in plan.solvers if not isinstance(solver, OF_DISTANCES)]
    for solver in plan.solvers:
        if isinstance(solver, OF_DISTANCES):
            if triangles is None and not compact and not mixed and isinstance(solver, RigidTriangles):
                triangles = solver
            elif chains is None and not mixed and isinstance(solver, Chains):
                chains = solver
            else:
                rows.append(solver.rows)
    if chains is not None:  # with other rows by the kernel for all shapes, where they are no faster by their own
        besides = sum(map(len, rows))
        least = (CHAIN_ROWS_BESIDES if besides else CHAIN_ROWS) + ROWS_A_SLOT * chains.slots
        if len(chains.rows) <= min(least, MOST_ROWS - besides):
            rows.append(chains.rows)
            chains = None
    others = np.concatenate(rows)
    if len(others) > MOST_ROWS or not all(isinstance(each, SparseRows | SingleRows) for each in mixed):
        return None
    if mixed and (held.images is not None or sum(len(each.rows) for each in mixed) > MOST_ROWS):
        return None
    # Solvers of their own, for the atoms of the whole system: those of the plan may be at work for another one.
    called: list[AddressableSolver] = [_solver_like(each, held, inverse_masses, plan.eliminate_last) for each in mixed]
    if len(others):
        pairs = np.array([held.row_atoms(int(row)) for row in others], dtype=np.int64)
        numbers, lengths = np.arange(len(others)), held.target(0.0)[others]
        called.append(SparseDistances(numbers, pairs, lengths, inverse_masses, plan.eliminate_last[others]))
    if triangles is not None:
        called.append(copy(triangles))
    if chains is not None:
        called.append(chains.renumbered(held.touched) if compact else copy(chains))
    tables = pack_solver_tables(called, pinned, plan.pinned_targets(None), *more)
    return PackedSystem(motion, called, tables, more)


def _solver_like(
    solver: ClusterSolver, held: ConstraintSet, inverse_masses: FloatArray, eliminate_last: NDArray[np.bool_]
) -> AddressableSolver:
    rows = np.sort(solver.rows)
    if isinstance(solver, SingleRows):
        return SingleRows(held, rows, inverse_masses)
    like = SparseRows(held, rows, inverse_masses, eliminate_last[rows])
    like.numbers[COUNT] = 1.0  # all positions here are the ends of flights
    return like
