"""ConstrainedDynamics with every stepper: as on arrays, restarts, reversal."""

from __future__ import annotations

import numpy as np
import pytest
from ase import Atoms
from ase.build import molecule
from ase.io import read
from ase.md.velocitydistribution import thermalize_momenta
from ase_systems import FS, Field, equal, off, random, state, water
from stepper_systems import SYMMETRIC

from kcons import ConstraintSet, Motion, System, run
from kcons.ase import ConstrainedDynamics, constrain, rigid_water
from kcons.constraints import Distance
from kcons.constraints.target import MovingTarget
from kcons.errors import InputError
from kcons.steppers import BlanesMoan6a, Geodesic, KahanLi6, Rattle, ReversibilityCheck, State

#: Of each kind one: what it does on arrays it does in ASE, as the first test shows of all.
KINDS = [Rattle(), Geodesic(), KahanLi6(), BlanesMoan6a(), ReversibilityCheck(Rattle())]
every = pytest.mark.parametrize("stepper", KINDS, ids=repr)


def driven() -> tuple[Atoms, list[Distance]]:
    """Water with one O-H length that swings, and the other held."""
    atoms = molecule("H2O")
    atoms.calc = Field()
    thermalize_momenta(atoms, 600.0, rng=random(3))
    length, w = atoms.get_distance(0, 1), 0.3 / FS
    swing = MovingTarget(
        lambda t: length + 0.1 * np.sin(w * t),
        lambda t: 0.1 * w * np.cos(w * t),
        lambda t: -0.1 * w**2 * np.sin(w * t),
    )
    return atoms, [Distance([0, 1], swing), Distance([0, 2])]


# -- the same steps as on arrays ---------------------------------------------------------------------


def rotating() -> tuple[Atoms, list]:
    """Fast rotation: b depends on the velocities."""
    atoms, held = water(temperature=1000)
    return atoms, list(held.constraints)


@pytest.mark.parametrize(
    ("case", "stepper"),
    [(case, stepper) for case in (rotating, driven) for stepper in (*SYMMETRIC, ReversibilityCheck(Rattle()))],
    ids=lambda value: getattr(value, "__name__", repr(value)),
)
def test_every_stepper_does_in_ase_what_it_does_on_arrays(case, stepper):
    """So that orders and invariants of arrays are those of ASE."""
    atoms, rows = case()
    x, v = atoms.get_positions(), atoms.get_velocities()
    atoms.set_constraint()
    system = System(Motion(ConstraintSet(rows, x, atoms.get_masses()), x), lambda x, t: -0.05 * x)
    end = run(system, system.initial_state(x, v, project=True), 0.5 * FS, 24, stepper=stepper)
    ConstrainedDynamics(atoms, 0.5 * FS, stepper, constraints=rows).run(24)
    assert np.abs(end.positions - x).max() > 0.05
    assert np.abs(atoms.positions - end.positions).max() <= 1e-12
    assert np.abs(atoms.get_velocities() - end.velocities).max() * FS <= 1e-12


# -- restarts ---------------------------------------------------------------------------------------


@every
def test_runs_in_pieces_and_restarts_are_identical_to_the_last_bit(stepper, tmp_path):
    whole, _ = water()
    path = tmp_path / "md.traj"
    with ConstrainedDynamics(whole, FS, stepper, trajectory=str(path)) as dyn:
        dyn.run(8)
    pieces, _ = water()
    dyn = ConstrainedDynamics(pieces, FS, stepper)
    dyn.run(3)
    dyn.run(5)
    assert equal(state(pieces), state(whole))
    again = read(path, index=3)
    again.calc = Field()
    ConstrainedDynamics(again, FS, stepper).run(5)
    assert equal(state(again), state(whole))


def test_state_of_other_atoms_is_refused():
    atoms, _ = water()
    saved = ConstrainedDynamics(atoms, FS).state
    before = state(atoms)
    with pytest.raises(InputError, match="positions must have shape"):
        ConstrainedDynamics(molecule("CH3CH2OH"), FS, state=saved)
    other = molecule("H2O")
    other.positions[1] *= 1.1
    constrain(other, rigid_water(other))
    x = other.get_positions()
    with pytest.raises(InputError, match="off row"):
        ConstrainedDynamics(other, FS, state=saved)
    assert np.array_equal(other.positions, x)
    moving = State(saved.positions, np.ones((3, 3)) * [[1], [2], [3]])
    with pytest.raises(InputError, match="velocities of the state leave the constraints"):
        ConstrainedDynamics(atoms, FS, state=moving)
    assert equal(state(atoms), before)


# -- time steps -------------------------------------------------------------------------------------


@every
def test_steps_of_zero_changed_on_the_fly_and_taken_back(stepper):
    atoms, held = water()
    before = state(atoms)
    ConstrainedDynamics(atoms, 0.0, stepper).run(3)
    assert equal(before, state(atoms))
    dyn = ConstrainedDynamics(atoms, FS, stepper)
    dyn.run(10)
    dyn.set_timestep(0.4 * FS)
    dyn.run(5)
    assert dyn.get_time() == pytest.approx(12 * FS)
    dyn.set_timestep(-0.4 * FS)
    dyn.run(5)
    dyn.set_timestep(-FS)
    dyn.run(10)
    assert all(np.abs(a - b).max() <= 1e-12 for a, b in zip(before, state(atoms), strict=True))
    assert dyn.get_time() == pytest.approx(0, abs=1e-13)
    assert off(atoms, held) <= 1e-14
