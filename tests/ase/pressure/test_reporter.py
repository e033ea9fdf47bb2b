"""The pressure along runs in ASE."""

from __future__ import annotations

import numpy as np
import pytest
from ase import Atoms, units
from ase.build import bulk, fcc111
from ase.calculators.emt import EMT
from ase.calculators.lj import LennardJones
from ase.constraints import FixAtoms, Hookean
from ase_systems import FS, TEMPERATURE, dumbbells, pressure

from kcons.ase import ConstrainedDynamics, ConstrainedLangevin, PressureReporter, constrain, draw_velocities
from kcons.constraints import Distance
from kcons.errors import InputError, UnsupportedError
from kcons.thermostats import MonteCarloBarostat


def copper():
    atoms = bulk("Cu", cubic=True) * 2
    atoms.rattle(0.05, rng=np.random.default_rng(3))
    atoms.calc = EMT()
    constrain(atoms, Distance([[0, 1], [2, 3]]))
    draw_velocities(atoms, 300, 1)
    return atoms


def test_atomic_pressure_is_that_of_ase_with_the_constraint_part():
    atoms = copper()
    reporter = PressureReporter(ConstrainedDynamics(atoms, FS), virial="atomic")
    reporter()
    assert reporter.mean == pytest.approx(pressure(atoms), rel=1e-9)
    assert reporter.values[0] == pytest.approx(-atoms.get_stress(voigt=False, include_ideal_gas=True), abs=1e-12)


def test_molecular_pressure_by_stress_and_by_differences():
    atoms = copper()
    dynamics = ConstrainedLangevin(atoms, FS, 300, 0.01 / FS, rng=1)
    ways = [PressureReporter(dynamics, virial=way) for way in ("molecular", "difference")]
    for way in ways:
        dynamics.attach(way, interval=2)
    before = atoms.cell.array.copy()
    dynamics.run(6)
    assert len(ways[0].values) == 4
    assert ways[0].mean == pytest.approx(ways[1].mean, rel=1e-4)
    assert np.array_equal(atoms.cell.array, before)


def test_a_reporter_changes_no_run():
    runs = []
    for watched in (False, True):
        atoms, _ = dumbbells(20, side=30.0)
        barostat = MonteCarloBarostat(20 * units.kB * TEMPERATURE / 30**3, every=2, width=0.2)
        dynamics = ConstrainedLangevin(atoms, 2 * FS, TEMPERATURE, 0.01 / FS, rng=1, barostat=barostat)
        if watched:
            reporter = PressureReporter(dynamics, virial="difference", temperature_K=TEMPERATURE)
            dynamics.attach(reporter, interval=1)
        dynamics.run(9)
        runs.append((atoms.cell.array.copy(), atoms.get_positions(), atoms.get_momenta()))
    for one, other in zip(*runs, strict=True):
        assert np.array_equal(one, other)
    assert len(reporter.values) == 10 and reporter.volumes[-1] == pytest.approx(atoms.get_volume())
    expected = 20 * units.kB * TEMPERATURE / atoms.get_volume()
    assert np.trace(reporter.values[-1]) / 3 == pytest.approx(expected, rel=1e-4)
    assert len(np.unique(reporter.volumes)) > 1


def test_forces_of_ase_constraints_have_no_stress():
    """They are among the forces and not in the stress of the calculator."""
    atoms = copper()
    atoms.set_constraint([*atoms.constraints, Hookean(4, 7, 1.0, rt=1.0)])
    dynamics = ConstrainedLangevin(atoms, FS, 300, 0.01 / FS, rng=1)
    for virial in ("molecular", "atomic"):
        with pytest.raises(UnsupportedError, match="no stress"):
            PressureReporter(dynamics, virial=virial)()
    with pytest.raises(InputError, match="temperature_K is -1"):
        PressureReporter(dynamics, temperature_K=-1)
    reporter = PressureReporter(dynamics, virial="difference")
    reporter()
    assert np.isfinite(reporter.mean)


@pytest.mark.parametrize("virial", ["molecular", "difference"])
def test_beside_a_wall_of_fixed_atoms_the_mean_is_that_of_the_rest(virial):
    """Along the axis that the barostat changes: along the others the wall stays, and its share was the largest."""
    atoms = fcc111("Cu", (3, 3, 2), vacuum=6.0, periodic=True)
    top, n = atoms.positions[:, 2].max(), len(atoms)
    atoms += Atoms("Ar2", positions=[[1.0, 1, top + 4], [4.0, 2, top + 5]])
    atoms.set_constraint(FixAtoms(range(n)))
    atoms.calc = LennardJones(sigma=2.5, epsilon=0.01, rc=6.0)
    barostat = MonteCarloBarostat(0.0, kind="normal", held="stay")
    dynamics = ConstrainedLangevin(atoms, FS, 300, 0.01 / FS, rng=1, barostat=barostat)
    reporter = PressureReporter(dynamics, virial=virial)
    reporter()
    energies = []
    for h in (1e-5, -1e-5):
        other = atoms.copy()
        other.calc = atoms.calc
        other.set_cell(atoms.cell.array * [1, 1, 1 + h])
        other.positions[n:, 2] *= 1 + h
        energies.append(other.get_potential_energy())
    assert reporter.mean == pytest.approx(-(energies[0] - energies[1]) / (2e-5 * atoms.get_volume()), rel=1e-3)
