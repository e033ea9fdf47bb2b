"""The pressure along runs in ASE; stress and filters of cells know the constraints."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from ase import Atoms, units
from ase.build import bulk, fcc111
from ase.calculators.emt import EMT
from ase.calculators.lj import LennardJones
from ase.constraints import FixAtoms, Hookean
from ase.filters import ExpCellFilter, FrechetCellFilter, StrainFilter, UnitCellFilter
from ase.optimize import BFGS
from ase_systems import FS, TEMPERATURE, copper, dumbbells, pressure

from kcons.ase import (
    ConstrainedCalculator,
    ConstrainedDynamics,
    ConstrainedLangevin,
    PressureReporter,
    constrain,
)
from kcons.constraints import Distance, Plane
from kcons.errors import InputError, UnsupportedError
from kcons.thermostats import MonteCarloBarostat


def test_atomic_pressure_is_that_of_ase_with_the_constraint_part():
    atoms = copper()
    reporter = PressureReporter(ConstrainedDynamics(atoms, FS), virial="atomic")
    reporter()
    assert reporter.mean == pytest.approx(pressure(atoms), rel=1e-9)
    assert reporter.values[0] == pytest.approx(-atoms.get_stress(voigt=False, include_ideal_gas=True), abs=1e-12)


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
