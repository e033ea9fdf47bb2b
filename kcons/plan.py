"""Clusters of rows, and the table that picks each one's solver."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import scipy.sparse as sp
import scipy.sparse.csgraph

from kcons.constraint_set import ConstraintSet
from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.errors import ContradictionError
from kcons.solvers.general import GeneralClusters
from kcons.solvers.outcome import Outcome


class ClusterSolver(Protocol):
    """A solver of one kind for all clusters of one shape.

    Both methods work in place on the whole local arrays, touch only the atoms of their rows, and leave
    everything as it was when the outcome is not converged. `targets` and `rates` are indexed by row of
    the set (None: the targets found at set-up; no motion of the surface).
    """

    name: str
    rows: IntArray

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
    ) -> Outcome: ...

    def tangents(
        self,
        x: FloatArray,
        y: FloatArray,
        rates: FloatArray | None,
        lattice: FloatArray | None,
        multipliers: FloatArray | None,
        time: float,
    ) -> Outcome: ...


@dataclass(frozen=True)
class ClusterKind:
    """One line of the plan: clusters of the same kind and their solver."""

    solver: str
    clusters: int
    rows: int
    rank: int
    example: str


@dataclass
class Plan:
    """Who solves what.

    Attributes
    ----------
    solvers : list of ClusterSolver
    labels : ndarray of int, shape (n_rows,)
        Cluster of each row; -1 for rows that hold fixed atoms or lie between fixed atoms only.
    pinned, pinned_rows : ndarray of int
        Fixed atoms and their rows, three an atom.
    inverse_masses : ndarray, shape (n_atoms,)
        0 for fixed atoms.
    rank : int
        Independent rows, those of fixed atoms included.
    driven : bool
        Whether admissible velocities solve A v = c with c other than 0.
    kinds : list of ClusterKind
    """

    constraint_set: ConstraintSet
    solvers: list[ClusterSolver]
    labels: IntArray
    pinned: IntArray
    pinned_rows: IntArray
    inverse_masses: FloatArray
    rank: int
    driven: bool
    kinds: list[ClusterKind] = field(default_factory=list)

    def pinned_targets(self, targets: FloatArray | None, local: ConstraintSet) -> FloatArray:
        """Where fixed atoms are held, shape (len(pinned), 3)."""
        if targets is None:
            targets = local.target(0.0)
        return targets[self.pinned_rows].reshape(-1, 3)

    def general_for_all(self) -> list[GeneralClusters]:
        """The damped solver for every cluster, for positions that are far off."""
        rows = np.flatnonzero(self.labels >= 0)
        if len(rows) == 0:
            return []
        return [GeneralClusters(self.constraint_set, rows, self.labels[rows], self.inverse_masses)]


def make_plan(constraint_set: ConstraintSet, positions: FloatArray, time: float) -> Plan:
    """Find the clusters, their rank, and a solver for each."""
    pinned, pinned_rows = _pinned(constraint_set)
    inverse_masses = np.zeros(constraint_set.n_atoms)
    touched = np.unique(constraint_set.incidence.indices)
    inverse_masses[touched] = 1.0
    with np.errstate(divide="ignore"):
        inverse_masses[touched] /= constraint_set.masses[touched]
    inverse_masses[pinned] = 0.0
    labels = cluster_labels(constraint_set, pinned, pinned_rows)
    _check_rows_between_fixed(constraint_set, positions, labels, pinned_rows, time)
    rows = np.flatnonzero(labels >= 0)
    solvers: list[ClusterSolver] = []
    rank = len(pinned_rows)
    kinds: list[ClusterKind] = []
    if len(rows):
        general = GeneralClusters(constraint_set, rows, labels[rows], inverse_masses)
        solvers.append(general)
        for members, s in general.singular_values(positions, time):
            r = int(np.sum(s > 1e-8 * s[0]))
            rank += r
            kinds.append(ClusterKind("general", 1, len(members), r, constraint_set.row_name(int(members[0]))))
    driven = constraint_set.moving or not bool(constraint_set.holonomic.all())
    return Plan(constraint_set, solvers, labels, pinned, pinned_rows, inverse_masses, rank, driven, kinds)


def _pinned(constraint_set: ConstraintSet) -> tuple[IntArray, IntArray]:
    """Fixed atoms and their rows."""
    atoms: list[IntArray] = []
    rows: list[IntArray] = []
    for item, start in zip(constraint_set.constraints, constraint_set.starts, strict=False):
        if item.family == "FixedAtoms":
            atoms.append(item.atoms[::3, 0])
            rows.append(start + np.arange(item.n_rows))
    if not atoms:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    return np.concatenate(atoms), np.concatenate(rows)


def cluster_labels(constraint_set: ConstraintSet, pinned: IntArray, pinned_rows: IntArray) -> IntArray:
    """Cluster number of each row: rows that share a movable atom belong together; -1 for rows without one."""
    incidence = constraint_set.incidence
    n_rows, n_atoms = incidence.shape
    free = np.ones(n_atoms)
    free[pinned] = 0.0
    links = sp.csr_array((free[incidence.indices], incidence.indices, incidence.indptr), shape=incidence.shape)
    links.eliminate_zeros()
    graph = sp.block_array([[None, links], [links.T, None]], format="csr") if n_rows else sp.csr_array((0, 0))
    labels = np.full(n_rows, -1, dtype=np.int64)
    if n_rows == 0:
        return labels
    found = sp.csgraph.connected_components(graph, directed=False)[1][:n_rows]
    movable = np.diff(links.indptr) > 0
    movable[pinned_rows] = False
    if movable.any():
        labels[movable] = np.unique(found[movable], return_inverse=True)[1]
    return labels


def _check_rows_between_fixed(
    constraint_set: ConstraintSet, positions: FloatArray, labels: IntArray, pinned_rows: IntArray, time: float
) -> None:
    """Rows between fixed atoms only are dropped if fulfilled, and refused if not."""
    loose = labels < 0
    loose[pinned_rows] = False
    if not loose.any():
        return
    miss = np.abs(constraint_set.value(positions, time))
    allowed = np.maximum(constraint_set.tolerance(positions, time), 1e-10 * constraint_set.scale)
    bad = np.flatnonzero(loose & ~(miss <= allowed))
    if len(bad):
        row = int(bad[0])
        raise ContradictionError(
            f"row {constraint_set.row_name(row)} lies between fixed atoms and is off by {miss[row]:g}; "
            "remove it or free one of its atoms",
            rows=[row],
            atoms=constraint_set.row_atoms(row),
        )
