"""OpenMM's Topologies: there and back, boxes as OpenMM wants them, and bonds of a System."""

import numpy as np
import openmm
import pytest
from openmm import app, unit
from openmm_systems import pairs_force, particles

from kcons.errors import InputError
from kcons.openmm.topology import bonds_of, constraints_of, openmm_topology, reduced, snapshot_of


def waters():
    topology = app.Topology()
    for name in ("A", "B"):
        chain = topology.addChain(name)
        residue = topology.addResidue("HOH", chain, "7")
        o, *hydrogens = (
            topology.addAtom(atom, app.Element.getBySymbol(symbol), residue)
            for atom, symbol in (("O", "O"), ("H1", "H"), ("H2", "D"))
        )
        for hydrogen in hydrogens:
            topology.addBond(o, hydrogen)
    topology.setPeriodicBoxVectors(np.diag([2.0, 2.1, 2.2]) * unit.nanometer)
    return topology, np.random.default_rng(0).uniform(0, 2, (6, 3))


def test_there_and_back():
    topology, x = waters()
    snapshot = snapshot_of(topology, 10 * x * unit.angstrom, velocities=x)
    described = snapshot.topology
    assert described.elements.tolist() == ["O", "H", "H"] * 2  # deuterium is hydrogen
    assert described.masses[2] == pytest.approx(2.014, abs=1e-3)
    assert described.bonds.tolist() == [[0, 1], [0, 2], [3, 4], [3, 5]]
    np.testing.assert_allclose(snapshot.positions, x, rtol=1e-15)
    np.testing.assert_allclose(snapshot.cell, np.diag([2.0, 2.1, 2.2]))
    back, places = openmm_topology(snapshot)
    np.testing.assert_allclose(places.value_in_unit(unit.nanometer), x, rtol=1e-15)
    assert [a.name for a in back.atoms()] == [a.name for a in topology.atoms()]
    assert [(r.name, r.id, r.chain.id) for r in back.residues()] == [("HOH", "7", "A"), ("HOH", "7", "B")]
    assert [(b[0].index, b[1].index) for b in back.bonds()] == [(0, 1), (0, 2), (3, 4), (3, 5)]


def test_what_does_not_fit_or_is_no_topology_is_refused():
    topology, x = waters()
    with pytest.raises(InputError, match="the Topology has 6 atoms, but positions have shape"):
        snapshot_of(topology, x[:5])
    with pytest.raises(InputError, match="the Topology has 6 atoms, the System 1 particles"):
        snapshot_of(topology, x, system=particles([1.0]))
    for call in (constraints_of, snapshot_of):
        for given in ([app.Topology()], None, openmm.System()):
            words = f"must be an openmm.app.Topology, .* not {type(given).__name__}"
            with pytest.raises(InputError, match=words) as caught:
                call(given, np.zeros((0, 3)))
            assert caught.value.item == "topology"


def test_masses_and_box_of_the_system():
    topology, x = waters()
    topology.setPeriodicBoxVectors(None)
    force = openmm.NonbondedForce()
    for k in range(6):
        force.addParticle(0.1 * k, 0.3, 0.0)
    force.setNonbondedMethod(openmm.NonbondedForce.CutoffPeriodic)
    system = particles(range(10, 16), force)
    system.setDefaultPeriodicBoxVectors(*(np.eye(3) * 3.0))
    snapshot = snapshot_of(topology, x, system=system)
    assert snapshot.topology.masses.tolist() == [10.0, 11.0, 12.0, 13.0, 14.0, 15.0]
    np.testing.assert_allclose(snapshot.topology.charges, 0.1 * np.arange(6))
    np.testing.assert_allclose(snapshot.cell, 3.0 * np.eye(3))
    # One angstrom on all sides is what files without a box say.
    topology.setPeriodicBoxVectors(np.eye(3) * 0.1 * unit.nanometer)
    assert snapshot_of(topology, x).cell is None


def test_the_same_lattice_with_short_vectors():
    cell = np.array([[4.0, 0, 0], [3.0, 5.0, 0], [-3.5, 4.0, 6.0]])
    short = reduced(cell)
    change = short @ np.linalg.inv(cell)
    np.testing.assert_allclose(change, np.round(change), atol=1e-12)
    assert np.linalg.det(change) == pytest.approx(1.0)
    assert abs(short[1, 0]) <= 2.0 and abs(short[2, 0]) <= 2.0 and abs(short[2, 1]) <= 2.5
    system = openmm.System()
    system.setDefaultPeriodicBoxVectors(*short)  # raises where it is not what it wants
    with pytest.raises(InputError):
        reduced(cell[[1, 0, 2]])


def test_bonds_are_springs_at_their_lengths_and_constraints():
    x = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0], [0.3, 0, 0]])
    springs = pairs_force(openmm.HarmonicBondForce(), (0, 1, 0.1, 1000.0), (1, 2, 0.1, 1000.0))
    system = particles([12.0] * 4, springs, held=[(2, 3)], x=x)
    assert sorted(map(tuple, bonds_of(system, x).tolist())) == [(0, 1), (1, 2), (2, 3)]
    assert bonds_of(system, 2.0 * x).tolist() == [[2, 3]]  # springs far off their lengths make no structure


def test_a_network_of_springs_is_no_molecule():
    x = np.random.default_rng(4).uniform(size=(7, 3))
    springs = [(i, j, float(np.linalg.norm(x[i] - x[j])), 1000.0) for i in range(7) for j in range(i)]
    assert len(bonds_of(particles([12.0] * 7, pairs_force(openmm.HarmonicBondForce(), *springs)), x)) == 0
