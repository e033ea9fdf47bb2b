"""Logs of runs: the temperature by all rows, and multipliers by name."""

from __future__ import annotations

import io

import numpy as np
import pytest
from ase import Atoms, units
from ase.build import molecule
from ase.calculators.emt import EMT
from ase.calculators.lj import LennardJones
from ase.constraints import FixBondLengths
from ase.md.logger import MDLogger
from ase.md.verlet import VelocityVerlet
from ase_systems import Field, Free

from kcons.ase import (
    ConstrainedDynamics,
    ConstrainedLangevin,
    ConstraintLogger,
    IsokineticDynamics,
    PressureReporter,
    constrain,
    draw_velocities,
)
from kcons.constraints import Angle, Dihedral, Distance, FixedAtoms
from kcons.errors import InputError
from kcons.free_energy import AseRecorder

TORSION = Dihedral([[3, 2, 1, 0]])
ROWS = [Distance([[0, 1], [1, 2]]), TORSION]


def moving() -> Atoms:
    atoms = molecule("CH3CH2OH")
    atoms.calc = EMT()
    draw_velocities(atoms, 300, rng=1)
    return atoms


def columns(log: io.StringIO) -> np.ndarray:
    return np.array([line.split() for line in log.getvalue().splitlines()[1:]], dtype=float)


def test_with_noise_the_log_is_of_the_middle_of_the_step():
    """As warm as the bath, to 5 standard errors, where the momenta at the ends of steps are a quarter colder.

    The frequency of each atom times the step is 1: at its ends BAOAB has 1 - 1/4 of the temperature.
    """
    atoms, step, log, ends = Atoms("Ar50"), 10 * units.fs, io.StringIO(), []
    atoms.calc = Field(float(atoms.get_masses()[0]) / step**2)
    draw_velocities(atoms, 300, rng=1)
    dynamics = ConstrainedLangevin(atoms, step, 300, 0.5 / step, rng=2)
    dynamics.run(50)
    dynamics.attach(ConstraintLogger(dynamics, atoms, log))
    dynamics.attach(lambda: ends.append(atoms.get_temperature()))
    dynamics.run(3000)
    found = columns(log)
    total, potential, kinetic, temperature = found[:, 1:].T
    error = 300 * np.sqrt(2 / 150 / (len(found) / 3))  # friction leaves a third of the samples independent
    assert error < 1.5
    assert temperature.mean() == pytest.approx(300, abs=5 * error)
    assert np.mean(ends) == pytest.approx(225, abs=5 * error)
    assert temperature == pytest.approx(2 * kinetic / (150 * units.kB), abs=0.5)
    assert total == pytest.approx(potential + kinetic, abs=2e-3)
    draw_velocities(atoms, 300, rng=3)  # these are nobody's middle of a step
    assert dynamics.get_kinetic_energy() == pytest.approx(atoms.get_kinetic_energy(), rel=1e-14)


@pytest.mark.parametrize("friction", [0.0, None])
def test_without_noise_the_log_is_of_the_end(friction):
    """Constant energy, also as a bath without friction, and isokinetic."""
    atoms = moving()
    if friction is None:
        dynamics = IsokineticDynamics(atoms, units.fs, 300, momentum="free")
    else:
        dynamics = ConstrainedLangevin(atoms, units.fs, 300, friction, rng=1)
    dynamics.run(2)
    assert dynamics.get_kinetic_energy() == atoms.get_kinetic_energy()


@pytest.mark.parametrize("ours", [True, False])
def test_multipliers_by_name(ours):
    """The same as those that `AseRecorder` keeps, which finds them in another way; in ASE's own dynamics too."""
    atoms, log = moving(), io.StringIO()
    if ours:
        dynamics = ConstrainedDynamics(atoms, units.fs, constraints=ROWS)
    else:
        constrain(atoms, ROWS)
        dynamics = VelocityVerlet(atoms, units.fs)
    named = {"torsion": TORSION, "bonds": Distance([[1, 0], [2, 1]])}
    recorder = AseRecorder(dynamics, {"torsion": TORSION})
    logger = ConstraintLogger(dynamics, atoms, log, named, peratom=True)
    dynamics.attach(recorder)
    dynamics.attach(logger)
    dynamics.run(3)
    head = log.getvalue().splitlines()[0].split()
    assert head[-3:] == ["lambda(torsion)", "lambda(bonds[0])", "lambda(bonds[1])"]
    assert columns(log)[:, 5] == pytest.approx(recorder.series.multiplier[:, 0], rel=1e-5)
    assert columns(log)[-1, 1] == pytest.approx(atoms.get_total_energy() / 9, abs=1e-4)


def test_a_rod_in_tension():
    """Two atoms that turn about each other: the multiplier is the centripetal force."""
    atoms, log = Atoms("Ar2", positions=[[0, 0, 0], [2.0, 0, 0]], calculator=Free()), io.StringIO()
    rod = Distance([[0, 1]])
    constrain(atoms, rod)
    atoms.set_velocities([[0, -0.1, 0], [0, 0.1, 0]])
    ConstraintLogger(None, atoms, log, {"rod": rod})()
    mass = atoms.get_masses()[0]
    assert columns(log)[0, -1] == pytest.approx(-mass * 0.1**2 / 1.0, rel=1e-5)


@pytest.mark.filterwarnings("ignore:Zero mass encountered")
def test_a_fixed_atom_needs_no_mass():
    """ASE divides 0 by 0 for its velocity. What is logged is the same whatever the mass of one that does not move."""
    found = []
    for mass in (40.0, 0.0):
        atoms, ours, theirs = Atoms("Ar3", 4 * np.eye(3), cell=[20.0] * 3, pbc=True), io.StringIO(), io.StringIO()
        atoms.calc = LennardJones(epsilon=0.01, sigma=3.4, rc=9.0)
        atoms.set_masses([40.0, 40.0, mass])
        rod, anchor = Distance([[0, 1]]), FixedAtoms([2])
        held = constrain(atoms, [rod, anchor])
        draw_velocities(atoms, 300, rng=1)
        dynamics = ConstrainedDynamics(atoms, units.fs)
        recorder = AseRecorder(dynamics, {"rod": rod})
        dynamics.attach(recorder)
        dynamics.attach(ConstraintLogger(dynamics, atoms, ours, {"rod": rod}, stress=True))
        if mass:
            dynamics.attach(MDLogger(dynamics, atoms, theirs, stress=True))
        dynamics.run(2)
        if mass:
            assert np.array_equal(columns(ours)[:, 5:11], columns(theirs)[:, 5:])
            assert np.abs(columns(ours)[:, 5:11]).max() > 0.0
        found.append((ours.getvalue(), recorder.series.multiplier, held.report(atoms).velocity_residual))
    assert found[0][0] == found[1][0] and "nan" not in found[0][0]
    assert np.array_equal(found[0][1], found[1][1]) and found[0][2] == found[1][2]


@pytest.mark.parametrize("held_by", ["atoms", "dynamics", "ase"])
def test_stress_is_that_of_all_rows(held_by):
    """The same pressure wherever the rows are held, as `PressureReporter` has it by another way."""
    atoms, log, rows = Atoms("N2", [[0, 0, 0], [0, 0, 1.1]], cell=[6.0] * 3, pbc=True), io.StringIO(), [[0, 1], [2, 3]]
    atoms.rotate(33, [1, 2, 3])
    atoms *= (2, 1, 1)
    atoms.calc = EMT()
    atoms.set_momenta(np.random.default_rng(0).normal(size=(4, 3)))
    if held_by == "ase":
        atoms.set_constraint(FixBondLengths(rows))
    elif held_by == "atoms":
        constrain(atoms, Distance(rows))
    dynamics = ConstrainedDynamics(atoms, units.fs, constraints=[Distance(rows)] if held_by == "dynamics" else [])
    reporter = PressureReporter(dynamics, virial="atomic")
    ConstraintLogger(dynamics, atoms, log, stress=True)()
    reporter()
    tensor = -reporter.values[0] / units.GPa
    assert columns(log)[0, 5:11] == pytest.approx(tensor[(0, 1, 2, 1, 0, 0), (0, 1, 2, 2, 2, 1)], abs=6e-4)
    assert abs(tensor[2, 2]) > 0.05


def test_nothing_is_free():
    """As `get_temperature` of the dynamics of kcons: 0."""
    atoms, log = Atoms("Ar2", positions=[[0, 0, 0], [2.0, 0, 0]], calculator=Free()), io.StringIO()
    constrain(atoms, FixedAtoms([0, 1]))
    dynamics = VelocityVerlet(atoms, units.fs)
    ConstraintLogger(dynamics, atoms, log)()
    assert columns(log)[0, 4] == 0.0 == ConstrainedDynamics(atoms, units.fs).get_temperature()


def test_what_is_not_held_is_refused():
    atoms = moving()
    dynamics = ConstrainedDynamics(atoms, units.fs, constraints=ROWS)
    with pytest.raises(InputError, match=r"angle, Angle\(0, 1, 2\), is not among the 3 rows"):
        ConstraintLogger(dynamics, atoms, io.StringIO(), {"angle": Angle([[0, 1, 2]])})
