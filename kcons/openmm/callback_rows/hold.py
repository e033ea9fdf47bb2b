"""Constraints of an OpenMM System handed over to kcons.

What stays in the System is solved by OpenMM and must not share atoms with rows of kcons. Constraints that share
atoms with each other are solved as one, so that whole clusters of them change hands.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import openmm
from numpy.typing import ArrayLike, NDArray
from openmm import unit
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from kcons.constraints import Constraint, Distance
from kcons.constraints.constraint import IntArray, constraints_in
from kcons.constraints.target import FloatArray
from kcons.errors import InputError
from kcons.openmm.callback_rows.carried_constraints import CarriedConstraints

#: Name of the force whose bonds of no strength keep molecules together.
TIES = "kcons molecules"


def move_constraints(system: openmm.System, *, keep_water: bool = True) -> list[Constraint]:
    """Take the constraints out of a System and return them as constraints of kcons.

    Bonds of no strength are added between their atoms, so that the molecules of a Context, which barostats and the
    wrapping of positions go by, stay what they were.

    Parameters
    ----------
    system : openmm.System
        Changed in place, before a Context is made of it.
    keep_water : bool
        Whether rigid water stays with OpenMM, whose SETTLE is fastest there.

    Returns
    -------
    list of Constraint
        A Distance in nm; empty if there is nothing to take.

    Raises
    ------
    InputError
        No System.
    """
    table = _table(system)
    chosen = table.all_but_water if keep_water else table.all
    rows = _as_rows(table, chosen)
    _release(system, table, chosen)
    return rows


def hold(
    system: openmm.System,
    constraints: Constraint | Iterable[Constraint],
    positions: unit.Quantity | ArrayLike,
    *,
    take: Literal["touched", "all"] = "touched",
    keep_water: bool = True,
    periodic: bool | None = None,
    join: bool = False,
    time: unit.Quantity | float = 0.0,
) -> CarriedConstraints:
    """Hold rows of kcons in a System: all that has to be done before its Context is made.

    Constraints of the System that share atoms with the rows move over to kcons, and the forces that carry the rows
    are added.

    Parameters
    ----------
    system : openmm.System
        Changed in place.
    constraints : Constraint or iterable of Constraint
        What is held: Quantities, or plain numbers of nm, ps, dalton, radian; functions get numbers and may return
        either. Empty if only constraints of the System are to move over.
    positions : Quantity or array_like, shape (n_particles, 3)
        On or near the constraints, in nm if without unit; targets left at None are taken from them.
    take : {'touched', 'all'}
        Which of the System's constraints move over: those that share atoms with the rows, directly or through others,
        or all.
    keep_water
        As for `move_constraints`; water that a row touches moves over.
    periodic : bool, optional
        Whether rows take minimum images; by default if the System is periodic. Turn it off for rows longer than
        half the box among molecules that are never cut.
    time : Quantity or float
        Time of `positions` in ps, for targets that move.
    join : bool
        Whether molecules that a row connects count as one from now on, for barostats and wrapping. Needed where
        a barostat would move them apart.

    Returns
    -------
    CarriedConstraints
        For ``ProjectedIntegrator(..., parts=[...])``.

    Raises
    ------
    KconsError
        As `CarriedConstraints`. The System was not changed.
    """
    given = constraints_in(constraints, "constraints")
    table = _table(system)
    if take not in ("touched", "all"):
        raise InputError(f"take is {take!r}; give 'touched' or 'all'", item="take")
    touched = np.concatenate([*(item.atoms.ravel() for item in given), np.zeros(0, np.int64)])
    chosen = _sharing(table, touched)
    if take == "all":
        chosen |= table.all_but_water if keep_water else table.all
    taken = _as_rows(table, chosen)
    part = CarriedConstraints(system, [*taken, *given], positions, periodic=periodic, time=time)
    links = [_neighbors(item.atoms) for item in given] if join else []
    joined = np.concatenate([*links, np.zeros((0, 2), np.int64)])
    # Nothing can fail from here on.
    _release(system, table, chosen)
    _tie(system, joined)
    part.add_to(system)
    return part


# -- what the System holds ------------------------------------------------------------------------


def constraints_about(system: openmm.System, atoms: IntArray) -> list[Constraint]:
    """The constraints of a System in the clusters of some atoms, as a `Distance` in nm; the System keeps them."""
    table = _table(system)
    return _as_rows(table, _sharing(table, atoms))


@dataclass
class _Table:
    """The constraints of a System: pairs (n, 2), lengths in nm (n,), and cluster number of each particle."""

    pairs: IntArray
    lengths: FloatArray
    clusters: IntArray

    @property
    def cluster(self) -> IntArray:
        """Cluster of each constraint."""
        return self.clusters[self.pairs[:, 0]]

    @property
    def all(self) -> NDArray[np.bool_]:
        return np.ones(len(self.pairs), dtype=bool)

    @property
    def all_but_water(self) -> NDArray[np.bool_]:
        """All but those of molecules that are a triangle of constraints and nothing else."""
        rows = np.bincount(self.cluster, minlength=len(self.clusters))[self.cluster]
        atoms = np.bincount(self.clusters)[self.cluster]
        return (rows != 3) | (atoms != 3)


def _table(system: openmm.System) -> _Table:
    if not isinstance(system, openmm.System):
        raise InputError(
            f"system is a {type(system).__name__}; give the openmm.System, as createSystem makes it", item="system"
        )
    n = system.getNumParticles()
    first, second, long = [], [], []
    for k in range(system.getNumConstraints()):
        i, j, length = system.getConstraintParameters(k)
        first.append(i)
        second.append(j)
        long.append(length._value)  # nm; converting a Quantity takes longer than all else here
    pairs = np.array([first, second], dtype=np.int64).T
    lengths = np.array(long, dtype=np.float64)
    links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    clusters = connected_components(links, directed=False)[1].astype(np.int64)
    return _Table(pairs, lengths, clusters)


def _sharing(table: _Table, atoms: IntArray) -> NDArray[np.bool_]:
    """Constraints of the clusters that these atoms belong to; what is no particle is told later."""
    return np.asarray(np.isin(table.cluster, table.clusters[atoms[atoms < len(table.clusters)]]))


def _as_rows(table: _Table, chosen: NDArray[np.bool_]) -> list[Constraint]:
    return [Distance(table.pairs[chosen], table.lengths[chosen])] if chosen.any() else []


# -- changes --------------------------------------------------------------------------------------


def _release(system: openmm.System, table: _Table, chosen: NDArray[np.bool_]) -> None:
    """Remove constraints, and keep their atoms together by bonds of no strength."""
    for k in np.flatnonzero(chosen)[::-1].tolist():
        system.removeConstraint(k)
    _tie(system, table.pairs[chosen])


def _tie(system: openmm.System, pairs: IntArray) -> None:
    """Make the pairs count as bonded."""
    if not len(pairs):
        return
    force = next((f for f in system.getForces() if f.getName() == TIES), None)
    if force is None:
        force = openmm.HarmonicBondForce()
        force.setName(TIES)
        system.addForce(force)
        force = system.getForce(system.getNumForces() - 1)
    for i, j in pairs.tolist():
        force.addBond(i, j, 0.0, 0.0)


def _neighbors(atoms: IntArray) -> IntArray:
    """Pairs of atoms that follow each other in rows, shape (n, 2)."""
    return np.stack([atoms[:, :-1], atoms[:, 1:]], axis=-1).reshape(-1, 2)
