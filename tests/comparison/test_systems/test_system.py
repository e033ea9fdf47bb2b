"""The contract of a test system: steps, horizon, reference, and start."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ase import units
from small_test_systems import SMALL, small

from kcons.comparison.test_systems.potential import Potential
from kcons.comparison.test_systems.system import converged, thermal_velocities
from kcons.errors import InputError
from kcons.steppers import State, System, run


def test_error_estimate_of_the_converged_reference_is_honest():
    system = small("chain")
    fine = converged(system, min(system.time_steps) / 4)
    assert fine.error < 1e-12
    for dt in (4 * max(system.time_steps), 2 * max(system.time_steps)):
        coarse = converged(system, dt)
        assert 0.05 * coarse.error < system.deviation(coarse.positions, fine.positions) < coarse.error
        assert coarse.error > 100 * fine.error


def test_error_estimate_of_the_converged_reference_sees_noisy_forces():
    system = small("chain")
    rng = np.random.default_rng(4)

    def noisy(x):
        energy, forces = system.potential.energy(x), system.potential.forces(x)
        return energy, forces * (1 + 1e-6 * rng.standard_normal(forces.shape))

    right = system.reference()
    found = replace(system, potential=Potential(noisy, "noisy")).reference()
    off = system.deviation(found.positions, right.positions)
    assert off > 1e3 * right.error
    assert 0.2 * off < found.error < 20 * off


def test_thermal_velocities():
    system = small("water")
    v = thermal_velocities(system.motion, system.positions, 300.0, seed=3)
    masses = system.masses[:, None]
    assert np.abs(np.sum(masses * v, axis=0)).max() < 1e-12
    kinetic = 0.5 * np.sum(masses * v**2)
    assert kinetic == pytest.approx(0.5 * (6 * 8 - 3) * units.kB * 300.0, rel=1e-12)
    again = thermal_velocities(system.motion, system.positions, 300.0, seed=3)
    assert np.array_equal(v, again)
    assert not np.allclose(v, thermal_velocities(system.motion, system.positions, 300.0, seed=4))


@pytest.mark.parametrize("name", SMALL)
def test_atoms_carry_the_system(name):
    system = small(name)
    atoms = system.atoms()
    assert not atoms.constraints
    np.testing.assert_array_equal(atoms.positions, system.positions)
    np.testing.assert_allclose(atoms.get_velocities(), system.velocities, rtol=1e-14, atol=1e-300)
    np.testing.assert_array_equal(atoms.get_forces(), system.potential.forces(system.positions))
    assert atoms.get_potential_energy() == system.potential.energy(system.positions)
    np.testing.assert_array_equal(atoms.get_masses(), system.masses)


@pytest.mark.parametrize(
    ("dt", "text"), [(0.0, "positive step"), (-1.0, "positive"), (1e9, "positive"), (3.0, "does not divide")]
)
def test_bad_time_step(dt, text):
    with pytest.raises(InputError, match=text):
        small("chain").with_time_steps([dt])


def test_time_steps_are_sorted_coarse_first():
    system = small("chain").with_time_steps([2.5, 10.0, 5.0, 5.0])
    np.testing.assert_allclose(np.array(system.time_steps) / units.fs, [10.0, 5.0, 2.5])


@pytest.mark.parametrize("name", ["sphere", "sphere-pendulum", "rotor", "bead-rotating"])
def test_shortened_system_has_its_solution_at_its_own_horizon(name):
    test_system = small(name)
    half = test_system.shortened(2)
    assert half.horizon == test_system.horizon / 2
    system = System(half.motion, half.potential.forces)
    end = run(system, State(half.positions, half.velocities), half.horizon / 800, 800)
    assert half.deviation(end.positions, half.reference().positions) < 1e-4
