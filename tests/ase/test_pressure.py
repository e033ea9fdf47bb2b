"""Constant pressure in ASE, the pressure along runs; stress and filters of cells know the constraints."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
from ase import Atoms, units
from ase.build import bulk, fcc111
from ase.calculators.calculator import all_changes
from ase.calculators.emt import EMT
from ase.calculators.lj import LennardJones
from ase.constraints import FixAtoms, Hookean
from ase.filters import ExpCellFilter, FrechetCellFilter, StrainFilter, UnitCellFilter
from ase.optimize import BFGS
from ase_systems import FS, TEMPERATURE, Field, Free, copper, dumbbells, follow, state

from kcons.ase import ConstrainedCalculator, ConstrainedDynamics, ConstrainedLangevin, PressureReporter, constrain
from kcons.constraints import Distance, Plane
from kcons.errors import InputError, NonFiniteError, UnsupportedError
from kcons.thermostats import CellRescaling, MonteCarloBarostat

KT = units.kB * TEMPERATURE
N, SIDE = 60, 40.0
CUBE = np.diag([SIDE] * 3).tolist()
PRESSURE = (N + 1) * KT / SIDE**3


def langevin(atoms, **options):
    return ConstrainedLangevin(atoms, 2 * FS, TEMPERATURE, 0.1 / FS, rng=1, **options)


def barostats(**kwargs):
    return {
        "monte carlo": MonteCarloBarostat(PRESSURE, **{"every": 1, "width": 0.25, "rng": 3, **kwargs}),
        "rescaling": CellRescaling(PRESSURE, 4 * FS, 1 / PRESSURE, **{"every": 1, "rng": 3, **kwargs}),
    }


def gas():
    return dumbbells(N, side=SIDE)


def test_a_run_goes_on_without_its_barostat_in_its_cell():
    """Also where it is refused, the cell of the atoms is their own."""
    atoms, _ = gas()
    other = atoms.copy()
    whole = langevin(atoms, barostat=barostats(every=1)["monte carlo"])
    whole.run(5)
    other.calc = Free()
    langevin(other, state=whole.state).run(3)
    assert other.cell.array.tolist() == atoms.cell.array.tolist() != CUBE
    third, _ = gas()
    with pytest.raises(InputError, match="another barostat"):
        langevin(third, barostat=barostats(kind="lateral")["monte carlo"], state=whole.state)
    assert third.cell.array.tolist() == CUBE
    with pytest.raises(InputError, match="off row"):
        ConstrainedDynamics(third, FS, state=replace(whole.state, positions=1.1 * atoms.positions))
    assert third.cell.array.tolist() == CUBE


# -- forces, and what moves ---------------------------------------------------------------------------


@pytest.mark.parametrize(("which", "kind"), [("monte carlo", "semi-isotropic"), ("rescaling", "flexible")])
def test_the_energy_that_trials_bring_is_accounted_for(which, kind):
    atoms = copper()
    if which == "monte carlo":  # forces of ASE's objects count in the energy, and have no stress
        atoms.set_constraint([*atoms.constraints, Hookean(a1=4, a2=5, rt=2.0, k=5.0)])
        made = MonteCarloBarostat(0.0, every=2, kind=kind, width=1e-3)
    else:
        made = CellRescaling(0.0, 100 * FS, 1.0, every=2, kind=kind)
    dyn = ConstrainedLangevin(atoms, 1 * FS, 300, 0.01 / FS, rng=1, barostat=made)
    before, cell = dyn.get_conserved_energy(), atoms.cell.array.copy()
    dyn.run(40)
    assert abs(atoms.get_volume() / abs(np.linalg.det(cell)) - 1) > 1e-4
    assert dyn.get_conserved_energy() == pytest.approx(before, abs=2e-3)
    tried = dyn.state.barostat[11:].reshape(3, -1)[0]
    assert tried.sum() == 20
    assert 0.1 < np.nanmean(made.acceptance(dyn.state)) <= 1
    if which == "rescaling":
        assert np.ptp(made.acceptance(dyn.state)) == 0
        assert atoms.cell.array[0, 1] == atoms.cell.array[0, 2] == atoms.cell.array[1, 2] == 0
        assert abs(atoms.cell.array[2, 0]) > 1e-4


class WarmElectrons(Free):
    """A free energy that fixes the cell, and an energy that knows nothing of it."""

    def calculate(self, atoms=None, properties=("energy",), system_changes=all_changes):
        super().calculate(atoms, properties, system_changes)
        self.results["free_energy"] = 1e3 * (atoms.get_volume() / SIDE**3 - 1) ** 2


def test_trials_are_judged_by_the_energy_that_forces_belong_to():
    """They went by the energy that is extrapolated to cold electrons."""
    atoms, _ = gas()
    atoms.calc = WarmElectrons()
    dyn = langevin(atoms, barostat=MonteCarloBarostat(0.0, every=1, width=0.01, rng=1))
    volumes = follow(dyn, atoms.get_volume, 100)
    assert 0 < np.abs(volumes / SIDE**3 - 1).max() < 0.06


# -- errors, with the state kept --------------------------------------------------------------------------------


class Torn(Free):
    """Has no energy where the cell is a little smaller."""

    def calculate(self, atoms=None, properties=("energy",), system_changes=()):
        super().calculate(atoms, properties, system_changes)
        if atoms.get_volume() < 0.97 * SIDE**3:
            self.results["energy"] = np.nan


@pytest.mark.parametrize(
    ("which", "case", "error", "match"),
    [
        *((which, "cutoff", InputError, "less than twice the cutoff") for which in ("monte carlo", "rescaling")),
        *((which, "length", InputError, "half the box") for which in ("monte carlo", "rescaling")),
        ("monte carlo", "energy", NonFiniteError, "energy is nan"),
        ("rescaling", "stress", UnsupportedError, r"no stress.*MonteCarloBarostat"),
    ],
)
def test_a_trial_that_fails_leaves_the_atoms(which, case, error, match):
    atoms, _ = gas()
    if case == "length":
        atoms.positions[1] = atoms.positions[0] + [SIDE / 2 - 0.5, 0, 0]
        atoms.set_constraint()
        constrain(atoms, Distance(np.arange(2 * N).reshape(-1, 2)))
    atoms.calc = {"energy": Torn, "stress": lambda: Field(0.0)}.get(case, Free)()
    barostat = barostats(**({"cutoff": SIDE / 2 - 0.5} if case == "cutoff" else {}))[which]
    dyn, seen = langevin(atoms, barostat=barostat), []

    def remember():
        seen[:] = [atoms.cell.array.copy(), atoms.positions.copy(), atoms.get_momenta()]

    dyn.attach(remember)
    remember()
    with pytest.raises(error, match=match) as found:
        dyn.run(200)
    assert all(np.array_equal(*pair) for pair in zip((atoms.cell.array, *state(atoms)), seen, strict=True))
    assert found.value.step == dyn.nsteps + 1


def test_a_step_that_fails_after_a_trial_leaves_the_cell(monkeypatch):
    """Also where the trial itself was accepted."""
    atoms, _ = gas()
    dynamics = langevin(atoms, barostat=MonteCarloBarostat(PRESSURE, every=1, width=0.2), check_every=1)
    cell, x = atoms.cell.array.copy(), atoms.get_positions()
    tried = []

    def interrupted(*args, **kwargs):
        tried.append(atoms.cell.array.copy())
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(dynamics._systems().schedule, "made", interrupted)
        for _ in range(20):
            with pytest.raises(KeyboardInterrupt):
                dynamics.run(1)
            assert np.array_equal(atoms.cell.array, cell) and np.array_equal(atoms.positions, x)
            assert np.array_equal(dynamics.motion.lattice[0], cell)  # in the engine, which would take other images
            dynamics.nsteps += 1  # another trial
    assert any(not np.array_equal(one, cell) for one in tried)


# -- pressure and stress ------------------------------------------------------------------------------


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
    for asked in (PressureReporter(dynamics), PressureReporter(dynamics, virial="atomic"), atoms.get_stress):
        with pytest.raises(UnsupportedError, match="no stress"):
            asked()
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
    with warnings.catch_warnings(action="ignore", category=DeprecationWarning):
        return cls(atoms)


@pytest.mark.parametrize("name", FILTERS)
def test_forces_of_a_filter_are_the_derivative_of_its_energy(name):
    """Along any change of cell and positions after which bonds are restored."""
    atoms = crystal().copy()  # whose constraints have seen no positions yet
    atoms.calc = EMT()
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
    whole.set_positions(x + h * d)
    assert whole.get_potential_energy() == pytest.approx(energies[1], abs=1e-9)


@pytest.mark.parametrize(
    ("cls", "size", "said"), [(StrainFilter, 0.0, "StrainFilter"), (FrechetCellFilter, 1.0, "momenta leave .*to relax")]
)
def test_what_scales_atoms_past_their_constraints_is_refused(cls, size, said):
    """And what moves them past their momenta, whose constraint forces are in the stress."""
    atoms = crystal()
    atoms.set_momenta(size * np.random.default_rng(0).normal(size=(8, 3)))
    optimizer = BFGS(cls(atoms), logfile=None)
    with pytest.raises(UnsupportedError, match=said):
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
    BFGS(flat, logfile=None).run(fmax=0.01, steps=1)
