"""Cells are relaxed with molecules that stay rigid; what would break them is refused."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from ase import Atoms
from ase.build import bulk
from ase.calculators.emt import EMT
from ase.calculators.lj import LennardJones
from ase.filters import ExpCellFilter, FrechetCellFilter, StrainFilter, UnitCellFilter
from ase.optimize import BFGS

from kcons.ase import constrain
from kcons.constraints import Distance
from kcons.errors import UnsupportedError

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


@pytest.mark.parametrize("name", FILTERS)
def test_a_molecular_crystal_relaxes(name):
    atoms = crystal()
    lengths = [atoms.get_distance(2 * k, 2 * k + 1, mic=True) for k in range(4)]
    begun = atoms.get_potential_energy()
    BFGS(filtered(FILTERS[name], atoms), logfile=None).run(fmax=0.05, steps=10)
    assert atoms.get_potential_energy() < begun - 0.1
    found = [atoms.get_distance(2 * k, 2 * k + 1, mic=True) for k in range(4)]
    assert found == pytest.approx(lengths, abs=1e-9)


def test_what_scales_atoms_past_their_constraints_is_refused():
    atoms = crystal()
    optimiser = BFGS(StrainFilter(atoms), logfile=None)
    with pytest.raises(UnsupportedError, match="StrainFilter"):
        optimiser.run(fmax=0.01, steps=5)


def test_free_atoms_and_the_strain_filter_go_together():
    atoms = bulk("Ar", "fcc", a=5.6, cubic=True)
    atoms.calc = LennardJones(sigma=3.4, epsilon=0.01, rc=2.7)
    BFGS(StrainFilter(atoms), logfile=None).run(fmax=0.01, steps=3)
