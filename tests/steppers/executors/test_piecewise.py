"""Operations one after another: the bits of the fused executor, and what only they can do."""

from __future__ import annotations

import numpy as np
import pytest

from kcons.errors import ImageError, NonFiniteError
from kcons.steppers import Rattle, Splitting, System, run
from kcons.steppers.executors.piecewise import ArrayStep, SplittingStep
from kcons.steppers.operations import Evaluate, Kick
from tests.steppers.stages.test_fused_stages import GROUPS, STEPPERS, SYSTEMS, molecules, springs
from tests.steppers.test_splitting import assert_same

KICK_FIRST = [stepper for stepper in STEPPERS if stepper.kick_first]


@pytest.mark.parametrize("stepper", KICK_FIRST, ids=repr)
@pytest.mark.parametrize("name", SYSTEMS)
def test_executors_agree_to_the_last_bit(stepper, name) -> None:
    names, options = SYSTEMS[name]
    system, state = molecules(*names, **options)
    state = system.with_forces(state)
    for dt in (0.02, -0.05, 0.03):
        many = len(stepper.drifts) * len(stepper.flight) > 1
        piecewise = SplittingStep(system, state, dt, exact=False, many=many).through(stepper.operations(system))
        fused = stepper.step(system, state, dt)
        assert_same(piecewise, fused)
        assert not np.array_equal(fused.positions, state.positions)
        state = fused


def test_drifts_first_with_forces_that_depend_on_velocities() -> None:
    """Two steps of half the length, whichever comes first where they do not."""

    def force(x, v, t):
        return springs(x, t) - 0.1 * v

    plain, state = molecules(*GROUPS)
    system = System(plain.motion, force, velocity_dependent=True)
    halves = run(system, state, 0.01, 8)
    for splitting in (Splitting((1.0,), (0.5, 0.5)), Splitting((0.25, 0.5, 0.25), (0.5, 0.5))):
        end = run(system, state, 0.02, 4, stepper=splitting)
        np.testing.assert_allclose(end.positions, halves.positions, rtol=0, atol=1e-13)
        np.testing.assert_allclose(end.velocities, halves.velocities, rtol=0, atol=1e-13)
        assert np.array_equal(end.forces, system.forces(end.positions, end.velocities, end.time, 0))


def test_forces_are_kept_where_no_drift_comes_after_them() -> None:
    system, state = molecules(*GROUPS, piecewise=True)
    for splitting, kept in ((Rattle(), True), (Splitting((1.0,), (0.5, 0.5)), False)):
        end = splitting.step(system, state, 0.02)
        assert (end.forces is not None) == kept
        assert not kept or np.array_equal(end.forces, springs(end.positions, 0.0))


def test_an_executor_has_a_method_for_each_verb() -> None:
    """Of its own operations, in their order; errors get the number of the step."""
    done: list[tuple[str, float]] = []

    class Noted(ArrayStep):
        def kick(self, operation):
            done.append((operation.verb, operation.fraction))

        def end(self):
            return self.frame.closed(self.x, self.v, self.forces)

    system, state = molecules(*GROUPS)
    end = Noted(system, state, 0.1).through([Kick(0.25), Evaluate(), Kick(0.75)])
    assert done == [("kick", 0.25), ("kick", 0.75)]
    assert np.array_equal(end.forces, springs(state.positions, 0.0)) and end.step == state.step + 1

    class Apart(Noted):
        def kick(self, operation):
            raise ImageError("half the cell apart")

    with pytest.raises(ImageError) as caught:
        Apart(system, state, 0.1).through([Kick(1.0)])
    assert caught.value.step == state.step + 1


@pytest.mark.parametrize("compiled", [True, False])
def test_a_force_that_is_not_finite_is_named(compiled) -> None:
    def force(x, t):
        f = springs(x, t)
        if t > 0.01:
            f[3, 1] = np.nan
        return f

    system, state = molecules(*GROUPS, force=force)
    slowed = System(system.motion, force, friction=0.2)
    if not compiled:
        slowed.flights = None
    with pytest.raises(NonFiniteError, match="non-finite force at step 1 on atom 3"):
        run(slowed, state, 0.02, 3)
