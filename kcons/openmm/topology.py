"""Topologies of OpenMM: `openmm.app.Topology` with positions, rows by name, and back."""

from __future__ import annotations

from functools import partial
from typing import Any, Unpack

import numpy as np
import openmm
from numpy.typing import ArrayLike
from openmm import app, unit

from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.errors import InputError
from kcons.openmm.quantities import array, held_pairs, masses_of
from kcons.topology.rows_by_name import HeldRows, Holding, Options, rows_of, with_options
from kcons.topology.topology import (
    Snapshot,
    Topology,
    require_kind,
    require_standard_form,
    selected_numbers,
    sorted_pairs,
)

__all__ = ["bonds_of", "constraints_of", "openmm_topology", "snapshot_of"]

#: One angstrom in nm.
ANGSTROM = 0.1
_REMEDY = "give a Topology with bonds (createStandardBonds, addBond)"


@with_options
def constraints_of(
    topology: Any,
    positions: unit.Quantity | ArrayLike,
    constrain: str | None = "hbonds",
    *,
    system: openmm.System | None = None,
    **options: Unpack[Options],
) -> HeldRows:
    """Rows by name for an OpenMM Topology, in nm; give them to `kcons.openmm.hold`.

    Parameters
    ----------
    topology : openmm.app.Topology
    positions : Quantity or array_like, shape (n_atoms, 3)
        Plain numbers are in nm.
    system : openmm.System, optional
        Where the masses are taken from; otherwise they are those of the elements.
    **options
    """
    snapshot = snapshot_of(topology, positions, system=system)
    numbers = partial(selected_numbers, n=snapshot.topology.n_atoms)
    return rows_of(snapshot, Holding(constrain, **options), numbers, _REMEDY)


def snapshot_of(
    topology: Any,
    positions: unit.Quantity | ArrayLike,
    *,
    system: openmm.System | None = None,
    velocities: unit.Quantity | ArrayLike | None = None,
) -> Snapshot:
    """Topology, positions, box of OpenMM; in nm, plain velocities in nm/ps.

    The System is for masses and charges, and for the box if the Topology has none. `InputError` for what is no
    Topology, and for different numbers of atoms.
    """
    require_kind(topology, app.Topology, "topology", "an openmm.app.Topology, such as PDBFile(file).topology")
    atoms = list(topology.atoms())
    n = len(atoms)
    x = array(positions, unit.nanometer, "positions")
    if x.shape != (n, 3):
        raise InputError(
            f"the Topology has {n} atoms, but positions have shape {x.shape}; give those of the same system",
            item="positions",
        )
    residues = list(topology.residues())
    elements = np.array([a.element.symbol if a.element is not None else "" for a in atoms] or [""])[:n]
    elements = np.where(elements == "D", "H", elements)
    if system is None:
        weights = {a.element: a.element.mass._value for a in atoms if a.element is not None}
        masses = np.array([weights.get(a.element, 0.0) for a in atoms])
        charges = None
    else:
        if system.getNumParticles() != n:
            raise InputError(
                f"the Topology has {n} atoms, the System {system.getNumParticles()} particles", item="system"
            )
        masses = masses_of(system)
        nonbonded = next((force for force in system.getForces() if isinstance(force, openmm.NonbondedForce)), None)
        charges = nonbonded and np.array([nonbonded.getParticleParameters(k)[0]._value for k in range(n)])
    described = Topology(
        names=np.array([a.name for a in atoms] or [""])[:n],
        elements=elements,
        masses=masses,
        residues=np.array([a.residue.index for a in atoms], dtype=np.int64),
        residue_names=np.array([r.name for r in residues] or [""])[: len(residues)],
        residue_ids=np.array([str(r.id) for r in residues] or [""])[: len(residues)],
        chains=np.array([str(r.chain.id) for r in residues] or [""])[: len(residues)],
        bonds=sorted_pairs([(b[0].index, b[1].index) for b in topology.bonds()]),
        charges=charges,
    )
    vectors = topology.getPeriodicBoxVectors()
    if vectors is None and system is not None and system.usesPeriodicBoundaryConditions():
        vectors = system.getDefaultPeriodicBoxVectors()
    cell = None if vectors is None else array(vectors, unit.nanometer, "box")
    # One angstrom on all sides is what files without a box say.
    if cell is not None and np.diag(cell).max() < 0.2:
        cell = None
    v = None if velocities is None else array(velocities, unit.nanometer / unit.picosecond, "velocities")
    return Snapshot(described, x, ANGSTROM, cell, np.full(3, cell is not None), v, "OpenMM Topology")


def openmm_topology(snapshot: Snapshot) -> tuple[Any, unit.Quantity]:
    """An `openmm.app.Topology` with residues, bonds and box, and the positions."""
    snapshot = snapshot.in_unit(ANGSTROM)
    described = snapshot.topology
    topology = app.Topology()
    symbols = {s: app.Element.getBySymbol(s) for s in set(described.elements.tolist()) if s}
    members: list[list[int]] = [[] for _ in range(described.n_residues)]
    for atom, residue in enumerate(described.residues.tolist()):
        members[residue].append(atom)
    flat = [a for group in members for a in group]
    if flat != list(range(described.n_atoms)):
        raise InputError(
            "OpenMM keeps the atoms of a residue together, here they are scattered; sort the atoms by residue",
            item="atoms",
        )
    made: list[Any] = []
    chain, last = None, None
    names, elements = described.names.tolist(), described.elements.tolist()
    for residue, group in enumerate(members):
        if chain is None or described.chains[residue] != last:
            last = described.chains[residue]
            chain = topology.addChain(str(last) or None)
        entry = topology.addResidue(str(described.residue_names[residue]), chain, str(described.residue_ids[residue]))
        made += [topology.addAtom(names[a], symbols.get(elements[a]), entry) for a in group]
    for i, j in described.bonds.tolist():
        topology.addBond(made[i], made[j])
    if snapshot.cell is not None:
        topology.setPeriodicBoxVectors(reduced(snapshot.cell) * unit.nanometer)
    return topology, snapshot.positions * unit.nanometer


def reduced(cell: FloatArray) -> FloatArray:
    """The same lattice as OpenMM wants it: lower triangular, and the vectors as short as that allows.

    Raises
    ------
    InputError
        A cell that would have to be turned, which would turn the positions too.
    """
    require_standard_form(cell, "OpenMM", positive=True)
    a, b, c = np.tril(cell)
    c = c - b * np.round(c[1] / b[1])
    c = c - a * np.round(c[0] / a[0])
    b = b - a * np.round(b[0] / a[0])
    return np.stack([a, b, c])


def bonds_of(system: openmm.System, x: FloatArray) -> IntArray:
    """Pairs of particles that harmonic bonds or constraints of the System join, shape (n, 2).

    Springs of which most are off their lengths at `x` by more than a quarter make no structure, and more than two an
    atom are a network, not bonds (diamond has two): none counts then.
    """
    pairs = held_pairs(system)[0].tolist()
    for force in system.getForces():
        if isinstance(force, openmm.HarmonicBondForce) and force.getNumBonds():
            springs = [force.getBondParameters(k) for k in range(force.getNumBonds())]
            ends = np.array([spring[:2] for spring in springs])
            rest = np.array([spring[2].value_in_unit(unit.nanometer) for spring in springs])
            apart = np.linalg.norm(x[ends[:, 0]] - x[ends[:, 1]], axis=1)
            network = len(ends) > 2 * len(np.unique(ends))
            if not network and np.median(np.abs(apart - rest)) <= 0.25 * np.median(rest):
                pairs += ends.tolist()
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)
