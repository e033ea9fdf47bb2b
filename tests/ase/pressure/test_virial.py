"""Stress and pressure contain the constraints."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from ase import Atoms
from ase.build import bulk
from ase.calculators.emt import EMT
from ase.filters import ExpCellFilter, FrechetCellFilter, StrainFilter, UnitCellFilter
from ase.md.velocitydistribution import thermalize_momenta
from ase.optimize import BFGS
from ase_systems import TEMPERATURE, pressure, random, water_gas

from kcons.ase import ConstrainedCalculator, constrain, rigid_water
from kcons.constraints import Distance, Plane
from kcons.errors import UnsupportedError

# -- pressure ---------------------------------------------------------------------------------------


def test_ideal_gas_of_rigid_water():
    """At any instant, the pressure is that of the molecules as points."""
    atoms = water_gas()
    constrain(atoms, rigid_water(atoms, "tip3p"), project=True)
    n, volume, rng = len(atoms) // 3, atoms.get_volume(), random()
    mass = atoms.get_masses()[:3].sum()
    for _ in range(5):
        thermalize_momenta(atoms, TEMPERATURE, rng=rng)
        momenta = atoms.get_momenta().reshape(n, 3, 3).sum(axis=1)
        assert pressure(atoms) == pytest.approx((momenta**2).sum() / (3 * mass * volume), rel=1e-10)


# -- cells are relaxed with molecules that stay rigid; what would break them is refused ------------


FILTERS = {"Frechet": FrechetCellFilter, "unit cell": UnitCellFilter, "exponential": ExpCellFilter}


def crystal() -> Atoms:
    """Four molecules CO by EMT, on an fcc lattice along its diagonals; atoms of unequal mass."""
    base = bulk("Ar", "fcc", a=5.2, cubic=True)
    axes = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3)
    x = np.stack([base.positions - 0.57 * axes, base.positions + 0.57 * axes], axis=1).reshape(-1, 3)
    atoms = Atoms("CO" * 4, positions=x, cell=base.cell, pbc=True, calculator=EMT())
    atoms.rattle(0.05, seed=2)
    constrain(atoms, Distance(np.arange(8).reshape(-1, 2)))
    return atoms


def filtered(cls, atoms):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        return cls(atoms)


@pytest.mark.parametrize("name", FILTERS)
def test_forces_of_a_filter_are_the_derivative_of_its_energy(name):
    """Along any change of cell and positions after which bonds are restored."""
    atoms = crystal()
    whole = filtered(FILTERS[name], atoms)
    x, forces = whole.get_positions(), whole.get_forces()
    rng = np.random.default_rng(1)
    for _ in range(3):
        d = rng.standard_normal(x.shape)
        energies = []
        for h in (1e-5, -1e-5):
            other = crystal()
            there = filtered(FILTERS[name], other)
            there.set_positions(x + h * d)
            energies.append(other.get_potential_energy())
            assert other.get_distance(0, 1, mic=True) == pytest.approx(atoms.get_distance(0, 1, mic=True), abs=1e-10)
        assert -(forces * d).sum() == pytest.approx((energies[0] - energies[1]) / 2e-5, rel=1e-4, abs=1e-5)


def test_what_scales_atoms_past_their_constraints_is_refused():
    atoms = crystal()
    optimizer = BFGS(StrainFilter(atoms), logfile=None)
    with pytest.raises(UnsupportedError, match="StrainFilter"):
        optimizer.run(fmax=0.01, steps=5)


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("calculator", [False, True])
def test_filters_beside_atoms_that_stay_are_refused(name, calculator):
    """Fixed atoms do not follow the cell, and forces of the filter took them to."""

    def held() -> Atoms:
        atoms, rows = crystal(), [Plane([0], [0, 0, 1.0])]
        atoms.set_constraint()
        if calculator:
            atoms.calc = ConstrainedCalculator(atoms.calc, rows)
        else:
            constrain(atoms, rows)
        return atoms

    atoms = held()
    assert np.isfinite(atoms.get_stress()).all()
    with pytest.raises(UnsupportedError, match=r"#0 Plane\(0\) holds atoms in space along z, and .*CellFilter"):
        BFGS(filtered(FILTERS[name], atoms), logfile=None).run(fmax=0.01, steps=1)
    atoms = held()
    flat = filtered(lambda a: FILTERS[name](a, mask=[1, 1, 0, 0, 0, 1]), atoms)
    x, forces, energies = flat.get_positions(), flat.get_forces(), []
    n = len(atoms)
    for h in (1e-5, -1e-5):
        y = x.copy()
        y[n, 0] += h
        flat.set_positions(y)
        energies.append(flat.get_potential_energy())
    assert -forces[n, 0] == pytest.approx((energies[0] - energies[1]) / 2e-5, rel=1e-4, abs=1e-5)
