"""Extrapolated RATTLE where forces end, jump or are noise, where a base is not fit, and where input is bad."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from stepper_attempts import attempts, counted, end_of
from stepper_systems import gravity, rotor, spherical_pendulum

from kcons.errors import ConvergenceError, InputError, NonFiniteError, SingularGeometryError, UnsupportedError
from kcons.steppers import (
    Composition,
    Extrapolation,
    Geodesic,
    Rattle,
    ReversibilityCheck,
    Suzuki4,
    System,
)
from kcons.thermostats import Isokinetic, Langevin, NoseHooverChain


@pytest.mark.parametrize("tolerance", [1e-4, 1e-9, 1e-14])
def test_forces_that_end(tolerance) -> None:
    system, state = spherical_pendulum()
    weight = gravity([1, 1])
    broken, times = counted(System(system.motion, lambda x, t: weight(x, t) * (np.nan if t > 0.5 else 1.0)))
    seen = [state]
    with pytest.raises(NonFiniteError, match="the force function there") as raised:
        seen.extend(Extrapolation(tolerance).states(broken, state, 1.0))
    last = seen[-1]
    assert raised.value.step == last.step + 1 and f"step {last.step + 1}, from time 0.5" in str(raised.value)
    assert raised.value.item == "force" and raised.value.atom == 0
    assert 0.5 - 1e-13 < last.time <= 0.5 and len(times) < 1000
    # The state before is good to go on from.
    on = end_of(Extrapolation(tolerance), system, last, 1.0)
    assert (
        np.abs(on.positions - end_of(Extrapolation(1e-12), system, state, 1.0).positions).max()
        < 1e3 * tolerance + 1e-12
    )


@pytest.mark.parametrize("jumps", [lambda x, t: t > 0.5123, lambda x, t: x[1, 1] > 0.3], ids=["time", "place"])
@pytest.mark.parametrize("tolerance", [1e-6, 1e-10, 1e-14])
def test_forces_that_jump_are_passed(jumps, tolerance) -> None:
    """No order there, but steps that are short enough."""
    system, state = spherical_pendulum()
    weight = gravity([1, 1])
    jumping, times = counted(System(system.motion, lambda x, t: weight(x, t) * (-2.0 if jumps(x, t) else 1.0)))
    end = end_of(Extrapolation(tolerance), jumping, state, 1.0)
    finer = end_of(Extrapolation(1e-12), jumping, state, 1.0)
    assert np.abs(end.positions - finer.positions).max() < 100 * tolerance + 1e-10
    assert len(times) < 2000


def test_forces_without_an_error_that_shrinks() -> None:
    system, state = spherical_pendulum()
    rng = np.random.default_rng(3)
    noisy = System(system.motion, lambda x, t: 1e12 * rng.standard_normal(x.shape))
    with pytest.raises(ConvergenceError, match="jump or are noisy: make them smooth") as raised:
        list(Extrapolation(1e-12, speed=1.0).states(noisy, state, 1.0))
    assert raised.value.step == 1 and raised.value.residual > raised.value.tolerance == 1e-12


@pytest.mark.parametrize(
    ("error", "kind"),
    [
        (ConvergenceError("no way", row=3, residual=0.5), ConvergenceError),
        (SingularGeometryError("bond of length 0", atoms=[1]), SingularGeometryError),
    ],
)
def test_what_the_base_cannot_do_at_any_size(error, kind) -> None:
    class Ends(Rattle):
        def step(self, system, state, dt):
            if state.time + dt > 0.7:
                raise error
            return super().step(system, state, dt)

    system, state = spherical_pendulum()
    seen = [state]
    with pytest.raises(kind, match=rf"from time 0\.7, at steps down to .*: {error}") as raised:
        seen.extend(Extrapolation(1e-8, base=Ends()).states(system, state, 1.0))
    assert raised.value is not error and raised.value.__cause__ is error
    assert f"step {seen[-1].step + 1}," in str(raised.value)
    assert seen[-1].time == pytest.approx(0.7, abs=1e-13)
    if kind is ConvergenceError:
        assert raised.value.step == seen[-1].step + 1 and raised.value.row == 3


def test_steps_too_long_for_a_projection_are_made_shorter(monkeypatch) -> None:
    made = attempts(monkeypatch)
    system, state = rotor(omega=30.0)
    *_, end = Extrapolation(1e-9, base=Rattle()).states(system, state, 1.0, first_step=1.0)
    known = end_of(Extrapolation(1e-12), system, state, 1.0)
    assert not all(fits for _, _, fits in made)
    assert np.abs(end.positions - known.positions).max() < 1e-7


def test_wrong_shapes_of_forces() -> None:
    system, state = spherical_pendulum()
    wrong = System(system.motion, lambda x, t: np.zeros(3) if t > 0 else np.zeros((2, 3)))
    with pytest.raises(InputError, match=r"returned shape \(3,\)"):
        list(Extrapolation().states(wrong, state, 1.0))


@pytest.mark.parametrize(
    "base",
    [Suzuki4(), Isokinetic(1.0), Langevin(1.0, 1.0, 1)],
    ids=lambda base: type(base).__name__,
)
def test_bases_that_cannot_be_extrapolated(base) -> None:
    with pytest.raises(UnsupportedError, match="use Rattle or Geodesic"):
        Extrapolation(base=base)


def test_a_thermostat_as_the_base() -> None:
    system, state = rotor()
    with pytest.raises(UnsupportedError, match="no thermostats"):
        next(Extrapolation(base=NoseHooverChain(1.0, 1.0)).states(system, state, 1.0))


def test_friction_of_the_system() -> None:
    """The base is symmetric with it, too: with friction alone, velocities fall off exactly."""
    system, state = rotor()
    free = System(system.motion, friction=0.5)
    end = end_of(Extrapolation(1e-10), free, replace(state, forces=None), 1.0)
    kinetic = free.kinetic_energy(state.velocities)
    assert free.kinetic_energy(end.velocities) == pytest.approx(kinetic * np.exp(-1.0), rel=1e-8)


def test_bases_that_can() -> None:
    system, state = spherical_pendulum()
    known = end_of(Extrapolation(1e-12), system, state, 1.0).positions
    for base in (Geodesic(), Geodesic(great_circles=False), Composition([1.0], order=2), ReversibilityCheck(Rattle())):
        assert np.abs(end_of(Extrapolation(1e-10, base=base), system, state, 1.0).positions - known).max() < 1e-9


def test_what_the_base_refuses_is_refused_before_any_step() -> None:
    swinging, start = rotor()
    with pytest.raises(UnsupportedError, match="great circles"):
        Extrapolation(base=Geodesic(great_circles=True)).states(swinging, start, 1.0)
