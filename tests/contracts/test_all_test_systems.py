"""Test systems start on their constraints, know their solution, and offer every MD engine the same forces."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from small_test_systems import SMALL, STORED, end, small

from kcons.comparison import test_systems
from kcons.comparison.test_systems.minimal import COARSER, FINEST
from kcons.constraints import projection
from kcons.errors import InputError
from tests.contracts.test_reference_cases import EPS, sensitivities
from tests.reference import cases


@functools.cache
def solution(name, time):
    system = small(name)
    return replace(system, horizon=time).reference() if system.solution is None else system.solution(time)


@pytest.mark.parametrize("name", SMALL)
def test_start_forces_and_time_steps(name):
    """On the constraints; the gradient of the energy; parts of the horizon."""
    system = small(name)
    x, held = system.positions, system.constraint_set
    sigma, tangency = system.residuals(x, system.velocities)
    assert np.all(np.abs(held.value(x)) <= held.tolerance(x))
    assert sigma < 1e-13 and tangency < 1e-14
    direction = np.random.default_rng(0).standard_normal(x.shape)
    energy = [system.potential.energy(x + h * direction) for h in (-1e-4, 1e-4)]
    work = -np.sum(system.potential.forces(x) * direction)
    assert (energy[1] - energy[0]) / 2e-4 == pytest.approx(work, rel=1e-4, abs=1e-7)
    for dt in (*system.time_steps, *system.shortened(2).time_steps):
        assert system.horizon / dt == pytest.approx(round(system.horizon / dt), abs=1e-9)


@pytest.mark.parametrize("name", [n for n in SMALL if n != "water"])
def test_rattle_reaches_the_reference_with_order_two(name):
    system = small(name)
    reference = solution(name, system.horizon) if name in STORED else system.reference()
    errors = [system.deviation(end(system, dt).positions, reference.positions) for dt in system.time_steps[1:]]
    slope = np.polyfit(np.log(system.time_steps[1:]), np.log(errors), 1)[0]
    assert slope == pytest.approx(2.0, abs=0.1)
    assert reference.error < 0.01 * errors[-1]


@pytest.mark.parametrize(("name", "size"), [("chain", 5), ("chain-free", 5), ("ethanol", 1)])
def test_converged_reference_against_an_independent_integrator(name, size):
    # Eq. (105) with the dense oracle in DOP853: other equations, other code, other integrator.
    system = test_systems.build(name, size, **({"forces": "emt"} if name == "ethanol" else {}))
    held, masses, shape = system.constraint_set, system.masses, system.positions.shape

    def rate(_, y):
        x, v = y.reshape(2, *shape)
        f = system.potential.forces(x)
        a = projection.acceleration(held.jacobian(x).toarray(), masses, f.ravel(), held.acceleration_target(x, v))
        return np.concatenate([v.ravel(), a])

    start = np.concatenate([system.positions.ravel(), system.velocities.ravel()])
    y = solve_ivp(rate, (0, system.horizon), start, method="DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
    reference = system.reference()
    assert system.deviation(y.reshape(2, *shape)[0], reference.positions) < 1e-7


@pytest.mark.parametrize("name", STORED)
def test_system_is_the_stored_case(name):
    system, case = small(name), cases.load(STORED[name])
    x, v = case.initial.positions, case.initial.velocities
    np.testing.assert_allclose(system.positions, x, rtol=0, atol=5e-16)
    np.testing.assert_allclose(system.velocities, v, rtol=0, atol=5e-16)
    np.testing.assert_array_equal(system.masses, case.masses)
    forces = system.potential.forces(x)
    np.testing.assert_allclose(forces, case.force(x, v), rtol=1e-13, atol=1e-13)
    # The same accelerations: the same constraints.
    for s in case.snapshots:
        a = system.motion.acceleration(s.positions, s.velocities, system.potential.forces(s.positions), s.time)
        np.testing.assert_allclose(a, s.accelerations, rtol=0, atol=2e-10 * max(1.0, np.abs(s.accelerations).max()))


#: Those with a solution of their own; the others are compared with steps of order six.
SOLVED = [name for name in STORED if small(name).solution is not None]


@pytest.mark.parametrize("name", STORED)
def test_solution_meets_the_stored_one(name):
    # What is wrong at the start, or on the way, grows as the stored case is sensitive to its start. The start is wrong
    # by rounding, and a step by its tolerance at most; those of many steps do not add up, as they have either sign.
    system, case = small(name), cases.load(STORED[name])
    known = [(s, grown) for s, grown in zip(case.solution, sensitivities(STORED[name]), strict=True)]
    known = [(s, grown) for s, grown in known if s.time <= system.horizon]
    assert known
    for s, grown in known[:: max(1, len(known) - 1)]:  # the first and the last, which goes through the others
        found = solution(name, s.time)
        off = system.deviation(found.positions, s.positions)
        if name in SOLVED:
            assert off < 4 * FINEST * grown
            assert found.error < 4 * (FINEST + COARSER) * grown
        assert off < 5 * found.error + 4 * EPS * grown and found.error < 1e-8  # the estimate is honest


@pytest.mark.parametrize("name", SOLVED)
def test_solution_stays_on_the_constraints(name):
    system = small(name)
    for time in (0.0, 0.3 * system.horizon, system.horizon):
        x = solution(name, time).positions
        np.testing.assert_allclose(system.constraint_set.value(x, time), 0.0, rtol=0, atol=2e-14)
        if time == 0.0:
            np.testing.assert_allclose(x, system.positions, rtol=0, atol=1e-14)


# -- bad input --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "size", "options", "text"),
    [
        ("waters", None, {}, "there is no test system 'waters' .did you mean 'water'.*; there are alanine"),
        ("water", 3, {}, "too small"),
        ("water", 8, {"forces": "x"}, "no forces 'x' for water"),
        ("chain", 0, {}, "size is 0"),
        ("sphere", 0, {}, "size is 0"),
        ("ethanol", 2, {}, "cannot be built at size 2"),
        ("rotor", 2, {}, "rotor is one rigid body; it cannot be built at size 2"),
        ("triple-pendulum", 2, {}, "triple-pendulum is one pendulum"),
        ("butane", 3, {}, "one molecule"),
        ("chain", 4, {"forces": "x"}, "chain takes no options, not forces"),
        ("dumbbells", 3, {}, "cannot be built at size 3"),
        ("slab", 0, {}, "size is 0"),
        ("ethanol", 1, {"forces": "x"}, "no forces 'x' for ethanol"),
    ],
)
def test_bad_system(name, size, options, text):
    with pytest.raises(InputError, match=text):
        test_systems.build(name, size, **options)
