"""The fluids at a temperature: molecules whole, on their constraints, energies right, bad sizes refused."""

from __future__ import annotations

import math

import numpy as np
import pytest
from ase import Atoms, units
from ase.calculators.tip3p import angleHOH, rOH
from kcons.comparison.test_systems.lennard_jones import LennardJones

from kcons.comparison import test_systems
from kcons.comparison.test_systems import fluid
from kcons.errors import InputError
from kcons.steppers import State, run
from kcons.thermostats import thermal_velocities

KINDS = pytest.mark.parametrize("kind", ["atoms", "dumbbells", "triatomics", "water"])


@KINDS
@pytest.mark.parametrize("size", [27, 30])
def test_molecules_are_on_their_constraints_and_apart(kind, size):
    made = fluid.build(size, kind=kind)
    rows = {"atoms": 0, "dumbbells": 1, "triatomics": 3, "water": 3}[kind]
    assert made.n_molecules == size
    assert made.motion.rank == rows * size
    assert made.motion.report(made.positions).residual <= 1e-14
    assert math.isfinite(made.forces.potential(made.positions))
    centres = made.positions[made.forces.first[:-1]]
    apart = centres[:, None] - centres
    apart -= made.forces.box * np.round(apart / made.forces.box)
    assert np.linalg.norm(apart, axis=2)[np.triu_indices(size, 1)].min() > 0.2 * made.forces.box / math.ceil(
        size ** (1 / 3)
    )


@KINDS
def test_energy_is_conserved_without_a_thermostat(kind):
    """Forces and potential belong together, and time steps are sensible."""
    made = fluid.build(27, kind=kind)
    _, x, _ = made.forces.metropolis(made.positions, made.thermal_energy, 500, 10, 1, made.shift, made.turn)
    system, dt = made.system(), made.time_steps[-1] / 4
    start = State(x, thermal_velocities(system, x, made.thermal_energy, 1))
    end = run(system, start, dt, 200)
    before, after = system.total_energy(start), system.total_energy(end)
    assert abs(after - before) <= 0.02 * made.thermal_energy


def test_boxes_grow_with_their_molecules():
    small, large = fluid.build(27, kind="water"), fluid.build(64, kind="water")
    assert large.forces.box == pytest.approx(small.forces.box * (64 / 27) ** (1 / 3))
    assert fluid.build(1000).forces.cutoff == fluid.CUTOFF
    density = 27 * (15.999 + 2 * 1.008) * units._amu * 1e3 / (small.forces.box * 1e-8) ** 3
    assert density == pytest.approx(0.9, abs=0.01)
    assert small.thermal_energy == pytest.approx(400 * units.kB)


def test_water_is_water():
    made = fluid.build(27, kind="water")
    first = Atoms("OHH", made.positions[:3])
    assert first.get_distance(0, 1) == pytest.approx(rOH, abs=1e-4)
    assert first.get_angle(1, 0, 2) == pytest.approx(angleHOH, abs=1e-3)
    assert made.symbols == "OHH" * 27


def test_water_pairs_have_the_energy_of_tip3p():
    """Two of its molecules in a large box: -0.834 e and 0.417 e, 0.1521 kcal/mol, 3.1507 Å."""
    root, half, charges, _ = fluid.build(27, kind="water").forces.sites[:6].T
    pair = LennardJones([0, 0, 0, 1, 1, 1], 60.0, epsilon=root**2, sigma=2 * half, charges=charges)
    x = np.concatenate([fluid.WATER_SHAPE, fluid.WATER_SHAPE @ np.diag([1.0, -1, 1]) + [0, 0, 3.0]])
    d = np.linalg.norm(x[:3, None] - x[None, 3:], axis=2)
    q = np.array([-0.834, 0.417, 0.417])
    coulomb = units._e**2 / (4 * np.pi * units._eps0) / units._e * 1e10  # eV Å
    field = d**2 / (2 * 30.0**3) - 3 / (2 * 30.0)
    c = (3.1507 / d[0, 0]) ** 6
    wanted = coulomb * np.sum(q[:, None] * q * (1 / d + field)) + 4 * 0.1521 * units.kcal / units.mol * (c * c - c)
    assert pair.potential(x) == pytest.approx(wanted, rel=1e-6)


def test_time_steps_of_ones_own():
    made = fluid.build(27, kind="water").with_time_steps([1.0, 3.0, 1.0])
    assert made.time_steps == (3 * units.fs, 1 * units.fs)
    for bad in (0.0, -1.0, math.nan):
        with pytest.raises(InputError, match="give a positive number"):
            made.with_time_steps([1.0, bad])


def test_fluids_by_name():
    for name, entry in test_systems.FLUIDS.items():
        made = test_systems.build_fluid(name, quick=True)
        assert made.name == name and made.n_molecules == entry.quick_size
        assert not np.array_equal(made.positions, test_systems.build_fluid(name, seed=2, quick=True).positions) or (
            name == "thermostat"
        )
    assert test_systems.build_fluid("thermostat").n_molecules == 32
    with pytest.raises(InputError, match="there is no fluid 'mud'"):
        test_systems.build_fluid("mud")
    with pytest.raises(InputError, match="7 are too few for a periodic fluid; use 8 or more"):
        test_systems.build_fluid("thermostat-dumbbells", 7)
    with pytest.raises(InputError, match="use 27 or more"):
        test_systems.build_fluid("thermostat-water", 26)
