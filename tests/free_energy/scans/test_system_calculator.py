"""Energies of an OpenMM System for scans."""

from __future__ import annotations

import numpy as np
import pytest
from ase import Atoms

from kcons.constraints import Dihedral
from kcons.errors import InputError, OccupiedError, UnsupportedError
from kcons.free_energy import SystemCalculator, scan

openmm = pytest.importorskip("openmm")


TURN = Dihedral([[0, 1, 2, 3]])


def four_atoms(constrained=True, change=None, barrier=2.0):
    """A chain with one torsion, 2 kJ/mol (1 + cos 3 phi), its bonds held or harmonic, in a zigzag."""
    system = openmm.System()
    for _ in range(4):
        system.addParticle(12.0)
    bonds, angles, turns = openmm.HarmonicBondForce(), openmm.HarmonicAngleForce(), openmm.PeriodicTorsionForce()
    for k in range(3):
        if constrained:
            system.addConstraint(k, k + 1, 0.15)
        else:
            bonds.addBond(k, k + 1, 0.15, 2e5)
    for k in range(2):
        angles.addAngle(k, k + 1, k + 2, 1.9, 400.0)
    turns.addTorsion(0, 1, 2, 3, 3, 0.0, barrier)
    for force in (bonds, angles, turns):
        system.addForce(force)
    if change is not None:
        change(system)
    x = [[0.0, 0, 0], [1.5, 0.1, 0], [2.0, 1.5, 0.1], [3.4, 1.6, 0.3]]
    return Atoms("C4", positions=x, calculator=SystemCalculator(system, "Reference"))


def test_energy_and_forces():
    atoms = four_atoms(constrained=False)
    forces, x, h = atoms.get_forces(), atoms.positions.copy(), 1e-4
    ends = []
    for sign in (1, -1):
        atoms.positions[:] = x
        atoms.positions[1, 1] += sign * h
        ends.append(atoms.get_potential_energy())
    assert -(ends[0] - ends[1]) / (2 * h) == pytest.approx(forces[1, 1], rel=1e-6)
    assert atoms.calc.held == []


def test_a_scan_with_what_the_system_constrains():
    atoms = four_atoms()
    values = np.radians(np.arange(-180, 180, 60))
    found = scan(atoms, TURN, values, held=atoms.calc.held, fmax=1e-4)
    truth = 2.0 * (1 + np.cos(3 * values)) * 0.01036427  # kJ/mol in eV
    np.testing.assert_allclose(found.energies, truth, atol=1e-7)
    for attempt in found.best.values():
        lengths = np.linalg.norm(np.diff(attempt.positions, axis=0), axis=1)
        np.testing.assert_allclose(lengths, 1.5, atol=1e-14)


def test_bad_systems():
    atoms = four_atoms()
    few = atoms[:3]
    few.calc = atoms.calc
    with pytest.raises(InputError, match="4 particles and the structure 3 atoms"):
        few.get_potential_energy()

    def site(system):
        system.setVirtualSite(system.addParticle(0.0), openmm.TwoParticleAverageSite(0, 1, 0.5, 0.5))

    with pytest.raises(UnsupportedError, match="particle 4 is a virtual site"):
        four_atoms(change=site)


def test_a_folder_belongs_to_one_system(tmp_path):
    """Energies of another System would be those of the first one."""
    one, other = (four_atoms(barrier=barrier) for barrier in (2.0, 3.0))
    scan(one, TURN, [1.0], held=one.calc.held, folder=tmp_path)
    with pytest.raises(OccupiedError, match="other calculator"):
        scan(other, TURN, [1.0], held=other.calc.held, folder=tmp_path)


def test_particles_without_mass_stay_where_they_are():
    atoms = four_atoms(constrained=False, change=lambda system: system.setParticleMass(0, 0.0))
    found = scan(atoms, TURN, [2.0], held=atoms.calc.held)
    np.testing.assert_array_equal(found.structure((0,)).positions[0], atoms.positions[0])
