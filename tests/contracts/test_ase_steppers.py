"""ConstrainedDynamics with every stepper: as on arrays, restarts, time steps."""

from __future__ import annotations

import numpy as np
import pytest
from ase.build import molecule
from ase.io import read
from ase_systems import FS, KINDS, Field, equal, state, water
from stepper_systems import SYMMETRIC

from kcons import ConstraintSet, Motion, System, run
from kcons.ase import ConstrainedDynamics, constrain, rigid_water
from kcons.errors import InputError
from kcons.steppers import Rattle, ReversibilityCheck, State


@pytest.mark.parametrize("stepper", [*SYMMETRIC, ReversibilityCheck(Rattle())], ids=repr)
def test_every_stepper_does_in_ase_what_it_does_on_arrays(stepper):
    """So that orders and invariants of arrays are those of ASE."""
    atoms, held = water(temperature=1000)  # in fast rotation
    rows = held.constraints
    x, v = atoms.get_positions(), atoms.get_velocities()
    atoms.set_constraint()
    system = System(Motion(ConstraintSet(rows, x, atoms.get_masses()), x), lambda x, t: -0.05 * x)
    end = run(system, system.initial_state(x, v, project=True), 0.5 * FS, 24, stepper=stepper)
    ConstrainedDynamics(atoms, 0.5 * FS, stepper, constraints=rows).run(24)
    assert np.abs(end.positions - x).max() > 0.05
    assert np.abs(atoms.positions - end.positions).max() <= 1e-12
    assert np.abs(atoms.get_velocities() - end.velocities).max() * FS <= 1e-12


@pytest.mark.parametrize("stepper", KINDS, ids=repr)
def test_restarts_from_a_file_are_identical_to_the_last_bit(stepper, tmp_path):
    whole, _ = water()
    path = tmp_path / "md.traj"
    with ConstrainedDynamics(whole, FS, stepper, trajectory=str(path)) as dyn:
        dyn.run(8)
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


def test_steps_of_zero_and_of_another_length():
    atoms, _ = water()
    before = state(atoms)
    dyn = ConstrainedDynamics(atoms, 0.0)
    dyn.run(3)
    assert equal(before, state(atoms))
    for length in (1.0, 0.4, -0.4, -1.0):
        dyn.set_timestep(length * FS)
        dyn.run(5)
        assert dyn.get_time() == pytest.approx({1.0: 5, 0.4: 7, -0.4: 5, -1.0: 0}[length] * FS, abs=1e-13)
    assert all(np.abs(a - b).max() <= 1e-12 for a, b in zip(before, state(atoms), strict=True))
