"""Which velocities share a sphere: clusters of atoms that rows tie together, their centers of mass, or everything.

A cluster's kinetic energy is conserved in free flight, that of its center of mass alone as well unless a row knows a
place in space. Each part that is conserved by itself may have a sphere of its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from kcons.constraints.constraint import IntArray
from kcons.constraints.periodic.one_piece import BoolArray
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, OverdeterminedError, UnsupportedError
from kcons.motion.motion import Motion
from kcons.solvers.rank_revealing import rank
from kcons.steppers import System
from kcons.thermostats.bodies import placed_rows

Spheres = Literal["split", "axes", "cluster", "global"]
KINDS = ("split", "axes", "cluster", "global")


@dataclass(frozen=True, eq=False)
class SphereLayout:
    """The spheres of a system.

    Attributes
    ----------
    cluster : ndarray of int, shape (n_atoms,)
        Cluster of each atom, -1 for fixed ones.
    spheres : ndarray of int, shape (n_clusters, 4)
        Those of the center of mass along x, y and z, all -1 where it has none of its own; that of the rest, or -1.
    masses : ndarray, shape (n_atoms,)
        0 for fixed atoms.
    totals : ndarray, shape (n_clusters,)
        Masses of the clusters.
    freedom : ndarray of int, shape (n_spheres,)
        Degrees of freedom g on each sphere.
    """

    cluster: IntArray
    spheres: IntArray
    masses: FloatArray
    totals: FloatArray
    freedom: IntArray

    @classmethod
    def of(cls, system: System, positions: FloatArray, kind: Spheres) -> SphereLayout:
        """The spheres of one kind.

        Parameters
        ----------
        system : System
        positions : ndarray, shape (n_atoms, 3)
            On the constraints; ranks of clusters with dependent rows are found there.
        kind : {'split', 'axes', 'cluster', 'global'}

        Raises
        ------
        UnsupportedError
            Targets move, or rows hold velocities; the ranks of the clusters do not add up.
        OverdeterminedError
            Nothing can move.
        """
        refuse_driven(system)
        moving = system.inverse_masses[:, 0] > 0
        if kind == "global":
            cluster, tied, free = _everything(system.motion, moving)
        else:
            cluster, tied, free = _clusters(system, moving, positions)
        n = len(free)
        spheres = np.full((n, 4), -1, dtype=np.int64)
        counts = np.zeros((n, 4), dtype=np.int64)
        open_ = ~tied & (kind in ("split", "axes"))
        if kind == "axes":
            counts[open_, :3] = 1
        else:
            counts[open_, 0] = 3
        counts[:, 3] = free - 3 * open_
        own = counts > 0
        spheres[own] = np.arange(own.sum())
        if kind == "split":
            spheres[open_, 1:3] = spheres[open_, :1]
        if not own.any():
            raise OverdeterminedError("no degree of freedom is left for the thermostat: hold fewer rows")
        masses = np.where(moving, system.masses, 0.0)
        totals = np.zeros(n)
        np.add.at(totals, cluster[moving], masses[moving])
        return cls(cluster.astype(np.int64), spheres, masses, totals, counts[own])

    def squares(self, thermal_energy: float, auxiliary: int) -> FloatArray:
        """R^2 = (g + L - 1) k_B T of each sphere.

        Raises
        ------
        InputError
            A sphere of radius 0.
        """
        sizes = self.freedom + auxiliary - 1
        if (sizes < 1).any():
            count = int((sizes < 1).sum())
            raise InputError(
                f"{count} spheres of one degree of freedom and no auxiliary variable have the radius 0; "
                "give auxiliary=1 or more",
                item="auxiliary",
            )
        return np.asarray(thermal_energy * sizes)


def refuse_driven(system: System) -> None:
    """Raise `UnsupportedError` for targets that move and rows that hold velocities."""
    for item in system.motion.constraint_set.constraints:
        if item.moving or not item.holonomic:
            what = "has a target that moves" if item.holonomic else "holds velocities"
            raise UnsupportedError(
                f"{item.family} {what}: the spheres of an isokinetic bath go with constraints that rest. Use "
                "Langevin or LangevinRespa"
            )


def _everything(motion: Motion, moving: BoolArray) -> tuple[IntArray, BoolArray, IntArray]:
    """As `_clusters`, for all atoms as one that is tied to space."""
    return np.where(moving, 0, -1), np.ones(1, bool), np.array([motion.degrees_of_freedom])


def _clusters(system: System, moving: BoolArray, positions: FloatArray) -> tuple[IntArray, BoolArray, IntArray]:
    """Cluster of each atom (free atoms are their own), whether a row ties it to space, degrees of freedom."""
    held, labels = system.motion.constraint_set, system.motion.plan.labels
    incidence = held.incidence
    row_of = np.repeat(np.arange(held.n_rows), np.diff(incidence.indptr))
    inside = labels[row_of] >= 0
    atoms, rows = incidence.indices[inside], row_of[inside]
    found = np.full(held.n_atoms, -1, dtype=np.int64)
    movable = moving[atoms]
    found[atoms[movable]] = labels[rows[movable]]
    count = int(labels.max(initial=-1)) + 1
    placed = np.zeros(count, dtype=bool)
    placed[labels[rows[~movable]]] = True
    placed[labels[placed_rows(held) & (labels >= 0)]] = True
    alone = np.flatnonzero(moving & (found < 0))
    found[alone] = count + np.arange(len(alone))
    free = 3 * np.bincount(found[found >= 0], minlength=count + len(alone))
    free[:count] -= _ranks(system, count, positions)
    return found, np.append(placed, np.zeros(len(alone), bool)), free


def _ranks(system: System, count: int, positions: FloatArray) -> IntArray:
    """Independent rows of each cluster."""
    plan = system.motion.plan
    ranks = np.bincount(plan.labels[plan.labels >= 0], minlength=count)
    wanted = plan.rank - len(plan.pinned_rows)
    if ranks.sum() == wanted:
        return ranks
    jacobian = system.motion.constraint_set.jacobian(positions)
    weights = np.sqrt(system.weights.ravel())
    for rows in plan.dependent:
        part = jacobian[rows]
        columns, place = np.unique(part.indices, return_inverse=True)
        dense = np.zeros((1, len(rows), len(columns)))
        dense[0, np.repeat(np.arange(len(rows)), np.diff(part.indptr)), place] = part.data * weights[part.indices]
        ranks[plan.labels[rows[0]]] = rank(dense)
    if ranks.sum() != wanted:
        raise UnsupportedError(
            f"the ranks of the clusters add up to {ranks.sum()}, not to {wanted}: which of them has how many degrees "
            "of freedom is unclear. Leave out dependent rows, or use one sphere for all, spheres='global'"
        )
    return ranks
