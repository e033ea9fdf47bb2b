"""Held distances of every shape behind one contract."""

from __future__ import annotations

import numpy as np

from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.solvers.chains.open_chains import Chains
from kcons.solvers.cluster_solver import DistanceSolver, Outcome
from kcons.solvers.sparse.distances import SparseDistances, lengths_resolved

#: Rounds of Newton that a chain may take until its stored positions show the lengths.
MAX_ROUNDS = 4


class DistanceClusters:
    """A solver of distance rows, as a `ClusterSolver`: picks its rows out of arrays over the whole set."""

    def __init__(self, solver: DistanceSolver, targets: FloatArray) -> None:
        self.name = solver.name
        self.rows = solver.rows.ravel()
        self.solver = solver
        self._lengths = np.ascontiguousarray(targets[self.rows])

    def positions(
        self,
        x_new: FloatArray,
        x_ref: FloatArray,
        targets: FloatArray | None,
        lattice: FloatArray | None,
        velocities: FloatArray | None,
        inv_dt: float,
        multipliers: FloatArray | None,
        time: float,
        reference_time: float,
    ) -> Outcome:
        lengths = self._lengths if targets is None else targets[self.rows]
        return self.solver.positions(x_new, x_ref, lengths, lattice, velocities, inv_dt, multipliers)

    def tangents(
        self,
        x: FloatArray,
        y: FloatArray,
        rates: FloatArray | None,
        lattice: FloatArray | None,
        multipliers: FloatArray | None,
        time: float,
    ) -> Outcome:
        return self.solver.tangents(x, y, None if rates is None else rates[self.rows], lattice, multipliers)


class LongChains(DistanceClusters):
    """Chains with a last look at the positions themselves.

    The multipliers of a long stretched chain can be so large that their rounding shows in the positions
    although the bond vectors of the iteration were exact; another round from there takes it away.
    """

    def __init__(self, solver: Chains, pairs: IntArray, targets: FloatArray) -> None:
        super().__init__(solver, targets)
        self._pairs = pairs.astype(np.uint32)

    def positions(
        self,
        x_new: FloatArray,
        x_ref: FloatArray,
        targets: FloatArray | None,
        lattice: FloatArray | None,
        velocities: FloatArray | None,
        inv_dt: float,
        multipliers: FloatArray | None,
        time: float,
        reference_time: float,
    ) -> Outcome:
        lengths = self._lengths if targets is None else targets[self.rows]
        outcome = self.solver.positions(x_new, x_ref, lengths, lattice, velocities, inv_dt, multipliers)
        more = None
        for _ in range(MAX_ROUNDS):
            if not outcome.converged or lengths_resolved(x_new, self._pairs, lengths, lattice):
                return outcome
            more = None if multipliers is None else np.empty(len(multipliers))
            again = self.solver.positions(x_new, x_ref, lengths, lattice, velocities, inv_dt, more)
            if not again.converged:
                return outcome
            if multipliers is not None and more is not None:
                multipliers += more
        return outcome


def sparse_distances(
    constraint_set: ConstraintSet, rows: IntArray, inverse_masses: FloatArray, time: float = 0.0
) -> DistanceClusters:
    """The sparse solver, which has step control, for distance rows."""
    pairs = np.array([constraint_set.row_atoms(int(row)) for row in rows], dtype=np.int64)
    targets = constraint_set.target(time)
    return DistanceClusters(SparseDistances(rows, pairs, targets[rows], inverse_masses), targets)
