"""Steps in few compiled calls; `test_piecewise`, `test_splitting` and `test_fused_stages` compare what they compute."""

from __future__ import annotations

import numpy as np
import pytest

from kcons.steppers import Rattle, Suzuki4
from kcons.steppers.executors.fused import fused_steps
from tests.steppers.stages.test_fused_stages import GROUPS, STEPPERS, SYSTEMS, molecules
from tests.steppers.test_splitting import assert_same, one_by_one


@pytest.mark.parametrize("name", ["hydrogens", "far", "no force"])
@pytest.mark.parametrize("stepper", [Rattle(), Suzuki4()], ids=repr)
def test_one_step_is_a_march_of_one(stepper, name) -> None:
    names, options = SYSTEMS[name]
    system, state = molecules(*names, **options)
    assert_same(stepper.march(system, state, 0.02, 1), stepper.step(system, state, 0.02))
    made = fused_steps(system, system.with_forces(state), 0.02, 1, system.flights, stepper.kicks, stepper._stages)
    assert_same(made[0], stepper.step(system, state, 0.02))
    assert made[1] == 1


@pytest.mark.parametrize("stepper", STEPPERS, ids=repr)
def test_a_cell_that_the_force_function_changes(stepper) -> None:
    """One by one and all at once, with atoms of a molecule in different cells."""
    cell = np.diag([19.0, 18.0, 17.0])
    ends = []
    for together in (True, False):
        system, state = molecules(*GROUPS, "triangles", cell=cell, pbc=True, scatter=True)
        force = system.force

        def press(x, t, force=force, motion=system.motion):
            motion.set_cell((1.0 - 1e-3 * t) * cell)
            return force(x, t)

        system.force = press
        if together:
            ends.append(stepper.march(system, state, 0.02, 6, check_every=0))
        else:
            ends.append(one_by_one(stepper, system, state, 0.02, 6))
    assert_same(*ends)


def test_what_cannot_be_ended_is_left_to_the_caller() -> None:
    """A state so far away that it needs a remainder ends a march."""
    system, state = molecules(*GROUPS, force=None)
    state = type(state)(state.positions, state.velocities + 40.0)
    stepper = Rattle()
    end, made = fused_steps(system, state, 0.02, 400, system.flights, stepper.kicks, stepper._stages)
    assert 0 < made < 400 and end.step == made and end.remainder is None
    expected = one_by_one(stepper, system, state, 0.02, made)
    assert np.array_equal(end.positions, expected.positions) and np.array_equal(end.velocities, expected.velocities)
    assert stepper.step(system, end, 0.02).remainder is not None
