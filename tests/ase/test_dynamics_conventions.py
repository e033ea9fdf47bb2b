"""ConstrainedDynamics follows ASE's conventions: observers, restarts, edits between steps, time steps."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from ase.calculators.tip3p import TIP3P
from ase.io import read
from ase.io.trajectory import Trajectory
from ase_systems import (
    FS,
    equal,
    off,
    rigid,
    state,
    water,
)

from kcons.ase import ConstrainedDynamics, Constraints, constrain
from kcons.constraints import FixedAtoms
from kcons.errors import InputError
from kcons.steppers import Rattle

# -- ASE's conventions ------------------------------------------------------------------------------


def test_trajectory_log_and_observers(tmp_path):
    atoms, _ = rigid()
    seen = []
    log = io.StringIO()
    path = tmp_path / "md.traj"
    with ConstrainedDynamics(atoms, FS, Rattle(), trajectory=str(path), logfile=log, loginterval=2) as dyn:
        dyn.attach(lambda: seen.append(dyn.nsteps), interval=3)
        assert [done for done in dyn.irun(6)] == [False] * 6 + [True]
        assert dyn.run(4) is True
    frames = read(path, index=":")
    assert len(frames) == 6
    assert seen == [0, 3, 6, 9]
    assert len(log.getvalue().splitlines()) == 7
    assert np.array_equal(frames[-1].positions, atoms.positions)
    assert isinstance(frames[-1].constraints[0], Constraints)
    with Trajectory(path) as file:
        description = file.description
    assert description["md-type"] == "ConstrainedDynamics"
    assert description["stepper"] == "Rattle()"


def test_one_force_evaluation_a_step():
    atoms, _ = water()
    dyn = ConstrainedDynamics(atoms, FS)
    dyn.attach(atoms.get_potential_energy)
    dyn.run(10)
    assert atoms.calc.calls == 11


def test_forces_are_not_computed_for_nobody():
    class Lazy:
        """Ends without forces, as some compositions do."""

        order, reversible, symplectic, force_evaluations = 1, False, False, 0

        def check(self, system):
            pass

        def step(self, system, state, dt):
            return replace(state, positions=state.positions + dt * state.velocities, forces=None, step=state.step + 1)

    atoms, _ = water()
    atoms.set_constraint()
    ConstrainedDynamics(atoms, FS, Lazy()).run(10)
    assert atoms.calc.calls == 0
    dyn = ConstrainedDynamics(atoms, FS, Lazy())
    dyn.attach(atoms.get_potential_energy, 5)
    dyn.run(10)
    assert atoms.calc.calls == 3


def test_restart_is_identical_to_the_last_bit(tmp_path):
    path = tmp_path / "md.traj"
    whole, _ = rigid(4)
    with ConstrainedDynamics(whole, FS, trajectory=str(path)) as dyn:
        dyn.run(40)
    frame = read(path, index=17)
    forces = frame.get_forces(apply_constraint=False)
    frame.calc = TIP3P(rc=6.0)
    ConstrainedDynamics(frame, FS).run(23)
    assert equal(state(frame), state(whole))
    assert np.array_equal(frame.get_forces(), whole.get_forces())
    again = read(path, index=17)
    again.calc = TIP3P(rc=6.0)
    ConstrainedDynamics(again, FS, forces=forces).run(23)
    assert equal(state(again), state(whole))


def test_run_in_pieces_is_identical_to_the_last_bit():
    whole, _ = rigid()
    pieces, _ = rigid()
    ConstrainedDynamics(whole, FS).run(30)
    dyn = ConstrainedDynamics(pieces, FS)
    dyn.run(10)
    dyn.run(20)
    assert equal(state(whole), state(pieces))
    assert dyn.nsteps == 30


def test_velocities_changed_between_steps_are_taken():
    atoms, held = water()
    dyn = ConstrainedDynamics(atoms, FS)
    dyn.run(3)
    atoms.set_momenta(np.zeros((3, 3)))
    atoms.arrays["momenta"] += 0.1  # past the constraints
    dyn.run(1)
    rows = held.engine(atoms).constraint_set.jacobian(atoms.positions)
    assert np.abs(rows @ atoms.get_velocities().ravel()).max() <= 1e-14


def test_positions_changed_between_steps_are_checked():
    atoms, held = water()
    dyn = ConstrainedDynamics(atoms, FS)
    dyn.run(3)
    atoms.positions[1] += 0.05
    with pytest.raises(InputError, match=r"off row.*restore"):
        dyn.run(1)
    held.restore(atoms)
    dyn.run(3)
    assert off(atoms, held) <= 1e-13


def test_constraints_changed_between_steps_are_taken():
    atoms, _ = water()
    dyn = ConstrainedDynamics(atoms, FS)
    dyn.run(2)
    atoms.set_constraint()
    constrain(atoms, FixedAtoms([0]))
    fixed = atoms.positions[0].copy()
    dyn.run(5)
    assert np.array_equal(atoms.positions[0], fixed)
    assert dyn.degrees_of_freedom == 6


def test_masses_changed_between_steps_are_taken():
    atoms, held = water()
    dyn = ConstrainedDynamics(atoms, FS)
    dyn.run(2)
    atoms.set_masses([16, 2, 2])
    atoms.set_momenta(atoms.get_momenta())
    dyn.run(5)
    assert off(atoms, held) <= 1e-13


# -- time steps -------------------------------------------------------------------------------------


def test_zero_step_changes_nothing():
    atoms, _ = water()
    dyn = ConstrainedDynamics(atoms, 0.0)
    before = state(atoms)
    dyn.run(3)
    assert equal(before, state(atoms))
    assert dyn.get_time() == 0


def test_negative_step_goes_back():
    atoms, _ = rigid()
    dyn = ConstrainedDynamics(atoms, FS)
    before = state(atoms)
    dyn.run(50)
    dyn.set_timestep(-FS)
    dyn.run(50)
    assert all(np.abs(a - b).max() <= 1e-11 for a, b in zip(before, state(atoms), strict=True))
    assert dyn.get_time() == pytest.approx(0, abs=1e-12)


def test_step_changed_on_the_fly():
    atoms, held = water()
    dyn = ConstrainedDynamics(atoms, FS)
    dyn.run(5)
    dyn.set_timestep(0.5 * FS)
    dyn.run(4)
    assert dyn.get_time() == pytest.approx(7 * FS)
    assert off(atoms, held) <= 1e-14


@pytest.mark.parametrize("bad", [np.nan, np.inf, None, "fast"])
def test_bad_time_step(bad):
    atoms, _ = water()
    with pytest.raises(InputError, match="time step"):
        ConstrainedDynamics(atoms, bad)
    dyn = ConstrainedDynamics(atoms, FS)
    with pytest.raises(InputError, match="time step"):
        dyn.set_timestep(bad)


def test_bad_time_and_forces():
    atoms, _ = water()
    with pytest.raises(InputError, match="time is nan"):
        ConstrainedDynamics(atoms, FS, time=np.nan)
    for forces in (np.zeros((2, 3)), np.full((3, 3), np.nan)):
        with pytest.raises(InputError, match="forces"):
            ConstrainedDynamics(atoms, FS, forces=forces)
