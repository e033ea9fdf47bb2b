"""Test systems: their contract and their geometry.

Starts, forces, orders and stored solutions of all of them: tests/contracts/test_all_test_systems.py.
"""

from __future__ import annotations

import functools
from dataclasses import replace
from importlib.util import find_spec
from unittest.mock import patch

import numpy as np
import pytest
from ase import Atoms, units
from ase.calculators.calculator import CalculationFailed, Calculator
from small_test_systems import SMALL, end, small

from kcons.comparison import Potential, add_system, compare, test_systems
from kcons.comparison.test_systems import chain, water
from kcons.comparison.test_systems.potential import of_calculator
from kcons.comparison.test_systems.system import converged, thermal_velocities
from kcons.errors import CalculatorError, InputError


def apart(system):
    """Distances of all atoms to their nearest images, shape (n, n)."""
    d = system.positions[:, None] - system.positions
    return np.linalg.norm(d - system.cell * np.round(d / system.cell), axis=2)


# -- the contract -----------------------------------------------------------------------------------


def test_a_test_system_of_ones_own():
    def two(size, rng, *, stretch=1.0):
        return replace(small("rotor"), name="mine", title=f"{size} {stretch}")

    with patch.dict(test_systems.SYSTEMS):
        add_system("mine", two, "mine", size=3, quick_size=2, takes=("stretch",))
        add_system("only", two, "one", unit="pair of atoms", only=True, options={"stretch": 2.0})
        assert test_systems.build("mine", stretch=4.0).title == "3 4.0"
        assert test_systems.build("mine", quick=True).horizon == small("rotor").horizon / 2
        assert test_systems.build("only").title == "1 2.0"
        with pytest.raises(InputError, match="only is one pair of atoms; it cannot be built at size 2"):
            test_systems.build("only", 2)
        with pytest.raises(InputError, match="mine takes stretch, not bend"):
            test_systems.build("mine", bend=1.0)
        assert list(compare(test_systems.build("only"), ["rattle"], rounds=0).status) == ["ok"] * 4


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


def test_error_estimate_of_the_converged_reference_is_honest():
    system = small("chain")
    fine = converged(system, min(system.time_steps) / 4)
    assert fine.error < 1e-12
    for dt in (4 * max(system.time_steps), 2 * max(system.time_steps)):
        coarse = converged(system, dt)
        assert 0.05 * coarse.error < system.deviation(coarse.positions, fine.positions) < coarse.error
        assert coarse.error > 100 * fine.error
    rng = np.random.default_rng(4)

    def noisy(x):
        energy, forces = system.potential.energy(x), system.potential.forces(x)
        return energy, forces * (1 + 1e-6 * rng.standard_normal(forces.shape))

    found = replace(system, potential=Potential(noisy, "noisy")).reference()
    off = system.deviation(found.positions, fine.positions)
    assert off > 1e3 * fine.error and 0.2 * off < found.error < 20 * off


def test_thermal_velocities():
    system = small("water")
    draw = functools.partial(thermal_velocities, system.motion, system.positions, 300.0)
    v, masses = draw(rng=3), system.masses[:, None]
    assert np.abs(np.sum(masses * v, axis=0)).max() < 1e-12
    assert 0.5 * np.sum(masses * v**2) == pytest.approx(0.5 * (6 * 8 - 3) * units.kB * 300.0, rel=1e-12)
    assert np.array_equal(v, draw(rng=3)) and not np.allclose(v, draw(rng=4))


# -- forces -----------------------------------------------------------------------------------------


def test_a_potential_counts_points_not_calls_and_hands_out_copies():
    potential, x = small("chain").potential, small("chain").positions
    potential.forget()
    first = potential.forces(x)
    potential.energy(x)
    first[:] = 0.0
    assert potential.evaluations == 1 and np.abs(potential.forces(x.copy())).max() > 0
    potential.watched(x + 0.2)
    assert potential.evaluations == 1
    potential.forces(x + 0.1)
    assert potential.evaluations == 2


def test_a_calculator_that_fails_is_told_of():
    class Failing(Calculator):
        implemented_properties = ["energy", "forces"]

        def calculate(self, *_, **__):
            raise CalculationFailed("SCF not\n converged")

    potential = of_calculator(Atoms("H2", [[0, 0, 0], [0, 0, 1]]), Failing(), "ASE's failing")
    with pytest.raises(CalculatorError, match="ASE's failing failed: SCF not converged; mend the start"):
        potential.forces(np.zeros((2, 3)))


# -- what is built ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("shape", "angle"), [("zigzag", 112.0), ("175", 175.0), ("straight", 180.0)])
def test_chain_shapes(shape, angle):
    bonds = np.diff(chain.positions(7, shape), axis=0)
    np.testing.assert_allclose(np.linalg.norm(bonds, axis=1), chain.BOND, rtol=1e-14)
    cosine = np.sum(bonds[1:] * bonds[:-1], axis=1) / chain.BOND**2
    np.testing.assert_allclose(np.degrees(np.arccos(np.clip(cosine, -1, 1))), 180.0 - angle, atol=1e-5)
    with pytest.raises(InputError, match="no chain shape 'bent'"):
        chain.positions(4, "bent")


def test_ethanol():
    system = small("ethanol")
    symbols = np.array(system.symbols)
    lengths, angles = system.constraint_set.constraints
    bonds = sorted("".join(sorted(symbols[pair])) for pair in lengths.atoms)
    assert bonds == ["CC"] + ["CH"] * 5 + ["CO"] + ["HO"]
    assert (angles.n_rows, system.motion.rank, system.motion.degrees_of_freedom) == (13, 19, 8)
    assert len(system.bonds) == 21  # the same set by distances alone
    if find_spec("tblite") is not None:
        assert "xTB" in test_systems.build("ethanol").potential.name


@pytest.mark.parametrize("size", [64, 216, 512])
def test_equilibrated_water_needs_no_relaxation(size):
    x, box, equilibrated = water._molecules(size)
    assert equilibrated and x.shape == (3 * size, 3)
    assert size / box**3 * 18.0154 / 0.602214 == pytest.approx(0.98, abs=0.005)  # g/cm3
    d = x[::3][:, None] - x[::3]
    distance = np.linalg.norm(d - box * np.round(d / box), axis=2)[np.triu_indices(size, 1)]
    assert 2.3 < distance.min() < 2.7
    # First shell: four to five neighbors within 3.3 Å.
    assert 4.0 < 2 * np.sum(distance < 3.3) / size < 5.5


def test_cut_water_has_no_overlaps():
    system = test_systems.build("water", 20, forces="ase")
    assert apart(system)[::3, ::3][np.triu_indices(20, 1)].min() > 2.2
    assert system.potential.energy(system.positions) / 20 < -0.2  # eV a molecule; ice is near -0.6


@pytest.mark.parametrize("size", [1, 3])
def test_slab_is_periodic_and_its_lower_layers_are_fixed(size):
    system = test_systems.build("slab", size)
    symbols, heights = np.array(system.symbols), system.positions[:, 2]
    assert list(symbols[-2 * size :]) == ["C", "O"] * size
    metal = np.flatnonzero(symbols == "Cu")
    assert heights[system.fixed].max() < np.delete(heights, system.fixed).min()
    assert len(system.fixed) == len(metal) // 2
    assert system.motion.rank == size + 3 * len(system.fixed)
    assert not system.velocities[system.fixed].any() and system.atoms().pbc.all()
    # Of the molecule, carbon is the closer one, above an atom of the top layer.
    for carbon, oxygen in system.bonds:
        assert 1.5 < heights[carbon] - heights[metal].max() < 2.1
        assert heights[oxygen] > heights[carbon] + 1.0
    state = end(system, system.time_steps[0])
    assert np.array_equal(state.positions[system.fixed], system.positions[system.fixed])
