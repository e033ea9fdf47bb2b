"""Monte Carlo of atoms: the same as on arrays, restarts, logs, changes by others, bad input."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from ase import Atoms, units
from ase.build import molecule
from ase.calculators.calculator import Calculator, all_changes
from ase.constraints import Hookean
from ase.io import Trajectory
from ase.md.logger import MDLogger

from kcons.ase import ConstrainedMonteCarlo, constrain, draw_velocities, rigid_water
from kcons.constraints import Distance, MovingTarget
from kcons.errors import InputError, NonFiniteError, UnsupportedError
from kcons.motion import Motion
from kcons.steppers import BlanesMoan4, State, System, run
from kcons.thermostats import HamiltonianMonteCarlo, Langevin

FS = units.fs


class Wells(Calculator):
    """Each atom in a well of its own strength, drawn to one side, or about the middle of all; counts its calls."""

    implemented_properties = ("energy", "forces")

    def __init__(self, bad=None, free=False):
        super().__init__()
        self.bad, self.calls, self.free = bad, 0, free

    def calculate(self, atoms=None, properties=("energy",), system_changes=all_changes):
        super().calculate(atoms, properties, system_changes)
        self.calls += 1
        if self.free:
            x = atoms.positions - atoms.positions.mean(axis=0)
            self.results = {"energy": 0.05 * float((x * x).sum()), "forces": -0.1 * x}
            return
        x, k = atoms.positions, np.linspace(0.2, 0.6, len(atoms))[:, None]
        energy = float((k * x * x / 2).sum() - 0.3 * x[-1, 0])
        forces = -k * x
        forces[-1, 0] += 0.3
        if self.bad is not None and self.calls > self.bad:
            raise ZeroDivisionError("mine")
        self.results = {"energy": energy, "forces": forces}


def waters(calc=None) -> Atoms:
    atoms = molecule("H2O")
    other = molecule("H2O")
    other.translate([2.5, 1.0, 0.3])
    atoms += other
    atoms.calc = Wells() if calc is None else calc
    constrain(atoms, rigid_water(atoms, "tip3p"), project=True)
    return atoms


def sampler(atoms, timestep=4 * FS, temperature_K=400.0, steps=(2, 5), **options):
    return ConstrainedMonteCarlo(atoms, timestep, temperature_K, steps, **{"rng": 7, "keep": 0.4} | options)


def same(a, b):
    return np.array_equal(a.positions, b.positions) and np.array_equal(a.get_momenta(), b.get_momenta())


@pytest.mark.parametrize(("stepper", "step"), [(None, 5), (BlanesMoan4(), 13)], ids=repr)
def test_it_is_what_arrays_give(stepper, step):
    atoms = waters()
    dyn = sampler(atoms, stepper=stepper, timestep=step * FS)
    x, motion, calc = atoms.positions.copy(), dyn.motion, Wells()
    alone = Atoms(atoms.symbols, x, calculator=calc)

    def force(x, t):
        alone.positions[:] = x
        return alone.get_forces()

    def potential(x, t):
        alone.positions[:] = x
        return alone.get_potential_energy()

    system = System(Motion(motion.constraint_set, x), force, potential=potential)
    core = HamiltonianMonteCarlo(units.kB * 400, (2, 5), 7, stepper=stepper, keep=0.4)
    there = run(system, State(x, np.zeros_like(x)), step * FS, 12, stepper=core)
    dyn.run(12)
    np.testing.assert_allclose(atoms.positions, there.positions, atol=1e-9)
    np.testing.assert_allclose(atoms.get_velocities(), there.velocities, atol=1e-9)
    assert 0 < dyn.counts.accepted <= 12 == dyn.counts.proposals
    assert dyn.get_time() == pytest.approx(there.time)


def test_a_proposal_costs_what_its_stepper_costs():
    """One evaluation for the start, then those of the stepper: none for energies, rejections or ways back."""
    atoms = waters()
    dyn = sampler(atoms, steps=3, stepper=BlanesMoan4(), timestep=14 * FS)
    before = atoms.calc.calls
    dyn.run(20)
    assert 0 < dyn.counts.accepted < 20
    assert atoms.calc.calls - before <= 20 * 18 + 1


@pytest.mark.parametrize("how", ["file", "trajectory_of_states"])
def test_restarts_go_on_to_the_last_bit(how, tmp_path):
    whole = waters()
    dyn = sampler(whole, timestep=6 * FS)
    dyn.run(5)
    dyn.save(tmp_path / "state.npz")
    state = dyn.state.copied()
    dyn.run(6)
    again = waters()
    options = {"restart": tmp_path / "state.npz"} if how == "file" else {"state": state}
    more = sampler(again, timestep=6 * FS, **options)
    more.run(6)
    assert (
        same(whole, again) and more.nsteps == 11 and np.array_equal(more.state.thermostat, dyn.state.thermostat, True)
    )


def test_logs_and_trajectories(tmp_path):
    atoms = waters()
    dyn = sampler(atoms, timestep=7 * FS, trajectory=str(tmp_path / "run.traj"))
    dyn.attach(MDLogger(dyn, atoms, str(tmp_path / "log")))
    energies = []
    dyn.attach(lambda: energies.append(atoms.get_potential_energy()))
    dyn.run(10)
    with Trajectory(str(tmp_path / "run.traj")) as frames:
        assert [f.get_potential_energy() for f in frames] == pytest.approx(energies, abs=1e-12)
    assert len((tmp_path / "log").read_text().splitlines()) == 12
    kept = sum(a == b for a, b in pairwise(energies))
    assert kept == dyn.counts.proposals - dyn.counts.accepted > 0


def test_the_temperature_counts_what_takes_part():
    atoms = waters(Wells(free=True))
    dyn = sampler(atoms, keep=0.0, fixcm=True)
    assert dyn.thermostat_degrees_of_freedom == 12 - 3
    assert sampler(waters()).thermostat_degrees_of_freedom == 12
    found = []
    dyn.attach(lambda: found.append(dyn.get_temperature()))
    dyn.run(200)
    assert abs(np.mean(found[1:]) - 400) < 3.5 * 400 * math.sqrt(2 / 9 / 200)
    assert np.abs(atoms.get_momenta().sum(axis=0)).max() < 1e-10


def test_a_step_is_found():
    atoms = waters()
    dyn = sampler(atoms, timestep=1 * FS, steps=5, keep=0.0)
    found = dyn.tune(wanted=0.8, proposals=40)
    assert dyn.dt == found.dt > 2 * FS and dyn.counts.proposals == 0
    dyn.run(40)
    assert dyn.counts.acceptance > 0.55
    dyn.set_temperature(50.0)
    assert dyn.stepper.thermal_energy == pytest.approx(50 * units.kB)


def test_who_moves_the_atoms_moves_the_energy():
    atoms = waters()
    dyn = sampler(atoms)
    dyn.run(3)
    atoms.translate([0.5, 0, 0])
    moved = atoms.positions.copy()
    dyn.run(1)
    fresh = waters()
    fresh.set_positions(moved, apply_constraint=False)
    assert dyn.counts.proposals == 4
    kept = np.array_equal(atoms.positions, moved)
    expected = fresh.get_potential_energy() if kept else atoms.get_potential_energy()
    assert dyn.state.thermostat[0] == pytest.approx(expected, abs=1e-12)


def test_springs_of_ase_have_an_energy():
    atoms = waters()
    spring = Hookean(0, 3, 5.0, rt=0.5)
    atoms.set_constraint([*atoms.constraints, spring])
    dyn = sampler(atoms, keep=0.0, steps=8, timestep=0.5 * FS)
    dyn.run(2)
    assert spring.adjust_potential_energy(atoms) > 0.1
    assert dyn.counts.mean_square < 1e-3


def test_bad_input_changes_nothing():
    atoms = waters()
    draw_velocities(atoms, 300, 1)
    before = atoms.copy()
    for options, kind, words in (
        ({"temperature_K": 0.0}, InputError, "temperature_K is 0.0"),
        ({"steps": 0}, InputError, "steps is 0"),
        ({"keep": 1.5}, InputError, "keep is 1.5"),
        ({"stepper": Langevin(0.1, 0.1, 1)}, UnsupportedError, "not reversible and symplectic"),
        ({"friction": 0.1}, UnsupportedError, "friction"),
        (
            {"constraints": Distance([[0, 3]], MovingTarget(lambda t: 2.7, lambda t: 0.0, lambda t: 0.0))},
            UnsupportedError,
            "move with time",
        ),
    ):
        with pytest.raises(kind, match=words):
            sampler(atoms, **options)
        assert same(atoms, before)
    with pytest.raises(InputError, match="noise cannot be taken back"):
        sampler(atoms, timestep=-FS).run(1)
    with pytest.raises(InputError, match="wanted is 2"):
        sampler(atoms).tune(wanted=2)
    with pytest.raises(UnsupportedError, match="conserves no energy"):
        sampler(atoms).get_conserved_energy()
    assert same(atoms, before)


def test_an_error_of_the_calculator_leaves_the_last_good_atoms():
    atoms = waters(Wells(bad=20))
    dyn = sampler(atoms, steps=3)
    with pytest.raises(ZeroDivisionError, match="mine") as caught:
        for _ in range(20):
            before = atoms.copy()
            dyn.run(1)
    assert same(atoms, before) and caught.value.step == dyn.nsteps + 1
    atoms = waters(Wells(bad=0))
    with pytest.raises(ZeroDivisionError):
        sampler(atoms).tune()


def test_an_energy_that_is_not_finite_is_an_error():
    atoms = waters()
    dyn = sampler(atoms)
    atoms.calc.calculate = lambda *a, **k: atoms.calc.results.update(energy=math.nan, forces=np.zeros((6, 3)))
    with pytest.raises(NonFiniteError, match="potential energy is nan"):
        dyn.run(1)
