"""A stepper with a barostat, in the core."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pressure_systems import TRIANGLE, gas, p_value
from scipy import stats

from kcons.errors import InputError
from kcons.steppers import Rattle, State, Suzuki4, run
from kcons.thermostats import (
    CellRescaling,
    ConstantPressure,
    Isokinetic,
    Langevin,
    MonteCarloBarostat,
    NoseHooverChain,
    mean,
    thermal_velocities,
)

N, SIDE = 40, 12.0
PRESSURE = (N + 1) / SIDE**3
STEPPERS = {
    "langevin": lambda: Langevin(1.0, 0.5, rng=2),
    "nose-hoover": lambda: NoseHooverChain(1.0, period=3.0, momentum="free"),
    "isokinetic": lambda: Isokinetic(1.0, momentum="free"),
}


def made(name, every=1, barostat=MonteCarloBarostat, **kwargs):
    more = {"width": 0.25} if barostat is MonteCarloBarostat else {"tau": 5.0, "compressibility": 1 / PRESSURE}
    return ConstantPressure(STEPPERS[name](), barostat(PRESSURE, every=every, **more, **kwargs))


def begun(**functions):
    system, x = gas(TRIANGLE, N, SIDE, **functions)
    return system, system.initial_state(x, thermal_velocities(system, x, 1.0, 4))


@pytest.mark.parametrize("name", STEPPERS)
def test_volumes_between_steps(name):
    system, state = begun()
    volumes = []
    run(system, state, 0.05, 500, stepper=made(name), observers=[lambda s: volumes.append(s.cell)], every=1)
    volumes = np.linalg.det(np.array(volumes[1:]))
    exact = stats.gamma(N + 1, scale=1 / PRESSURE)
    assert p_value(volumes, exact) > 0.01
    assert abs(mean(volumes).off(exact.mean())) < 3


@pytest.mark.parametrize("barostat", [MonteCarloBarostat, CellRescaling])
@pytest.mark.parametrize("name", STEPPERS)
def test_a_run_goes_on_bit_for_bit(name, barostat, tmp_path):
    stepper = made(name, 3, barostat)
    system, state = begun()
    middle = run(system, state, 0.05, 7, stepper=stepper)
    middle.save(tmp_path / "state.npz")
    last = run(system, middle, 0.05, 8, stepper=stepper)
    # In a system of another cell, and after a later state of the same one.
    for other in (system, begun()[0]):
        again = run(other, State.load(tmp_path / "state.npz"), 0.05, 8, stepper=made(name, 3, barostat))
        for key, value in last.__getstate__().items():
            assert np.array_equal(getattr(again, key), value), key
        assert np.array_equal(other.cell, last.cell)


def test_march_is_the_same_as_steps():
    system, state = begun()
    stepper = ConstantPressure(Langevin(1.0, 0.5, rng=2), MonteCarloBarostat(PRESSURE, every=4, width=0.2))
    one = state = stepper.start(system, state)
    for _ in range(10):
        one = stepper.step(system, one, 0.05)
    many = stepper.march(system, state, 0.05, 10)
    assert np.array_equal(one.positions, many.positions)
    assert np.array_equal(one.barostat, many.barostat)


def test_all_states_shown_have_a_cell():
    """Also the first, which is that of a step of no length."""
    system, state = begun()
    seen = []
    assert np.array_equal(made("langevin").step(system, state, 0.0).cell, SIDE * np.eye(3))
    end = run(system, state, 0.05, 4, stepper=made("langevin", 2), observers=[lambda s: seen.append(s.cell)])
    assert np.array_equal(seen[0], SIDE * np.eye(3))
    assert [cell.shape for cell in seen] == [(3, 3)] * 5
    assert np.array_equal(end.cell, system.cell)


def test_what_is_refused():
    system, state = begun()
    after = made("langevin").step(system, state, 0.1)
    for other in ("anisotropic", "lateral"):  # the second one has as many variables
        with pytest.raises(InputError, match="another barostat"):
            made("langevin", kind=other).step(system, after, 0.1)
        with pytest.raises(InputError, match="another barostat"):
            MonteCarloBarostat(PRESSURE, kind=other).acceptance(after)
    assert made("langevin", kind="anisotropic").step(system, replace(after, barostat=None), 0.1).cell is not None
    rescaling = ConstantPressure(Langevin(1.0, 0.5, 3), CellRescaling(PRESSURE, 1.0, 1.0))  # as many variables
    with pytest.raises(InputError, match="another barostat"):
        rescaling.step(system, after, 0.1)
    with pytest.raises(InputError, match="another barostat"):
        made("langevin").step(system, rescaling.step(system, replace(after, barostat=None), 0.1), 0.1)


def test_a_failing_trial_leaves_the_cell():
    system, state = begun(force=lambda x, t, h: 0 * x, potential=lambda x, t, h: 0.0 if h[0, 0] == SIDE else np.nan)
    stepper = made("langevin", 3)
    state = run(system, state, 0.05, 2, stepper=stepper)
    with pytest.raises(FloatingPointError) as found:
        run(system, state, 0.05, 1, stepper=stepper)
    assert found.value.step == 3
    assert np.array_equal(system.cell, SIDE * np.eye(3))
    assert np.array_equal(system.motion.lattice[0], SIDE * np.eye(3))


def swaying(x, t, h):
    """A field as wide as the cell."""
    return -np.sin(2 * np.pi * x @ np.linalg.inv(h))


@pytest.mark.parametrize("stepper", [*(make() for make in STEPPERS.values()), Rattle(), Suzuki4()], ids=repr)
def test_other_steppers_go_on_in_the_cell_of_the_state(stepper):
    """Which they keep, wherever the System has been since."""
    system, state = begun(force=swaying, potential=lambda x, t, h: 0.0)
    there = replace(run(system, state, 0.05, 6, stepper=made("langevin")), thermostat=None)
    first = run(system, there, 0.05, 2, stepper=stepper)
    run(system, there, 0.05, 6, stepper=made("langevin"))
    assert not np.array_equal(system.cell, there.cell)
    second = run(system, there, 0.05, 2, stepper=stepper)
    assert np.array_equal(first.positions, second.positions)
    assert np.array_equal(first.cell, there.cell) and np.array_equal(system.cell, there.cell)
