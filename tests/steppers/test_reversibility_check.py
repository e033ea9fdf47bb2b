"""The check that every step can be taken back."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from stepper_systems import (
    PROJECTED,
    SYMMETRIC,
    rotor,
    system_of,
)

from kcons.constraints import Angle, Distance
from kcons.errors import ConvergenceError, InputError, ReversibilityError, UnsupportedError
from kcons.steppers import (
    Geodesic,
    Rattle,
    ReversibilityCheck,
    State,
    System,
    run,
)

REVERSIBLE = pytest.mark.parametrize("stepper", SYMMETRIC, ids=repr)


def copies(state: State) -> list[np.ndarray | None]:
    return [None if a is None else a.copy() for a in (state.positions, state.velocities, state.forces)]


def assert_untouched(state: State, before: list[np.ndarray | None]) -> None:
    for array, copy in zip((state.positions, state.velocities, state.forces), before, strict=True):
        assert (array is None) == (copy is None)
        assert array is None or np.array_equal(array, copy)


def molecule(force=None) -> tuple[System, State]:
    """A bent molecule and a free atom, tied by springs."""
    rng = np.random.default_rng(4)
    x = np.array([[1.0, 0.1, 0.0], [0.0, 0.0, 0.0], [-0.9, 0.3, 0.2], [0.4, 1.5, 0.3]])
    system = system_of([Distance([[0, 1], [1, 2]]), Angle([[0, 1, 2]])], x, [1.0, 3.0, 2.0, 1.5], force or springs)
    return system, system.initial_state(x, 0.3 * rng.normal(size=(4, 3)), project=True)


def springs(x: np.ndarray, t: float) -> np.ndarray:
    """Between all pairs; independent of origin, orientation and order of the atoms."""
    d = x[:, None] - x[None]
    return -np.sum(d * (1 - 0.5 / (1 + np.sum(d**2, axis=-1, keepdims=True))), axis=1)


@REVERSIBLE
def test_check_passes_good_steps_and_changes_nothing(stepper) -> None:
    system, start = molecule()
    checked = ReversibilityCheck(stepper)
    a, b = run(system, start, 0.02, 50, stepper=checked), run(system, start, 0.02, 50, stepper=stepper)
    assert np.array_equal(a.positions, b.positions)
    assert (checked.order, checked.symplectic) == (stepper.order, stepper.symplectic)
    assert checked.force_evaluations == 2 * stepper.force_evaluations


class Drifting(Rattle):
    """Claims to be reversible and loses a little speed."""

    def step(self, system: System, state: State, dt: float) -> State:
        after = super().step(system, state, dt)
        return State(after.positions, after.velocities * (1 - 1e-7), after.time, None, after.step)


def test_check_finds_a_stepper_that_is_not_reversible() -> None:
    system, state = rotor()
    state = State(state.positions, state.velocities, step=6)
    before = copies(state)
    with pytest.raises(ReversibilityError, match="step 7 is not reversible: taken back, atom") as caught:
        ReversibilityCheck(Drifting()).step(system, state, 0.1)
    assert caught.value.step == 7 and 1e-8 < caught.value.residual < 1e-6
    assert_untouched(state, before)
    ReversibilityCheck(Drifting(), tolerance=1e-5).step(system, state, 0.1)


def test_check_finds_forces_with_a_memory() -> None:
    """As by neighbour lists that are out of date: not a function of the positions."""
    counter = itertools.count()
    system, state = rotor(force=lambda x, t: -x * (1 + 1e-4 * next(counter)))
    with pytest.raises(ReversibilityError, match="not reversible"):
        run(system, state, 0.1, 10, stepper=ReversibilityCheck(Rattle()))


def test_check_reports_a_step_that_cannot_be_taken_back() -> None:
    class OneWay(Rattle):
        def step(self, system: System, state: State, dt: float) -> State:
            if dt < 0:
                raise ConvergenceError("no way back", residual=0.5, row=0, atoms=[0, 1])
            return super().step(system, state, dt)

    system, state = rotor()
    with pytest.raises(ReversibilityError, match="step 1 cannot be taken back: no way back") as caught:
        ReversibilityCheck(OneWay()).step(system, state, 0.1)
    assert caught.value.atoms == (0, 1) and caught.value.step == 1


@pytest.mark.parametrize("stepper", PROJECTED, ids=repr)
def test_check_refuses_schemes_that_are_not_reversible(stepper) -> None:
    with pytest.raises(UnsupportedError, match="use Rattle, Geodesic, a Composition or a RungeKuttaNystrom"):
        ReversibilityCheck(stepper)


@pytest.mark.parametrize("tolerance", [0.0, -1.0, np.nan])
def test_check_needs_a_tolerance(tolerance) -> None:
    with pytest.raises(InputError, match="tolerance"):
        ReversibilityCheck(Rattle(), tolerance)


def test_check_works_far_from_the_origin_and_at_rest() -> None:
    system, state = rotor(omega=1.0, offset=1e6)
    run(system, state, 0.05, 20, stepper=ReversibilityCheck(Geodesic(2)))
    system, state = rotor(omega=0.0)
    run(system, state, 0.05, 3, stepper=ReversibilityCheck(Rattle()))
