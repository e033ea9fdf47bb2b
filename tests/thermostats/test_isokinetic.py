"""The isokinetic thermostat: the closed form of its kick, compiled steps, the right motion, its order and constants."""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import numpy as np
import pytest
from reference import cases
from thermostat_systems import (
    ROWS,
    distance,
    dumbbells,
    integrated,
    isokinetics,
    loaded,
    molecules,
    springs,
    swirling,
    system,
    water_and_more,
    waves,
)

from kcons.constraints import Ellipsoid, Plane, Sphere, Torus
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import ConvergenceError, NonFiniteError
from kcons.motion import Motion
from kcons.steppers import State, System, run
from kcons.steppers.compiled_operations import PYTHON
from kcons.thermostats import Isokinetic, thermal_velocities
from kcons.thermostats import isokinetic as kick
from kcons.thermostats.isokinetic import IsokineticStep

RNG = np.random.default_rng(5)
MASSES = np.repeat(RNG.uniform(0.5, 3.0, (4, 1)), 3, axis=1)


def kicked(u, pace, t, masses=MASSES):
    uu, up, pp = kick.sums(u, pace, masses)
    keep, push, log_growth, cancels = kick.weights_of(up, pp, uu, t)
    if cancels:
        return kick.turned(u, pace, masses, uu, t)
    return keep * u + push * pace, log_growth


def by_angle(u, pace, t):
    """u along the force is U tanh(ct + b), and across it falls off as 1/cosh(ct + b)."""
    root = np.sqrt(MASSES)
    a, b = root * u, root * pace
    largest = np.abs(b).max()
    size, strength = np.linalg.norm(a), np.linalg.norm(b / largest) * largest
    e = b / strength
    along = (a * e).sum()
    across = a - along * e
    begin = math.atanh(along / size)
    end = strength / size * t + begin
    ratio = math.exp(math.log(math.cosh(begin)) - abs(end) - math.log1p(math.exp(-2 * abs(end))) + math.log(2))
    return (size * math.tanh(end) * e + ratio * across) / root


@pytest.mark.parametrize("strength", [0.0, 1e-300, 1e-12, 1e-6, 1.0, 50.0, 1e3, 1e6, 1e12, 1e100, 1e200])
@pytest.mark.parametrize("t", [0.01, -0.01])
def test_any_strength(strength, t):
    u, pace = RNG.standard_normal((2, 4, 3))
    pace *= strength
    after, growth = kicked(u, pace, t)
    uu, up, _ = kick.sums(u, pace, MASSES)
    assert kick.square_sum(after, MASSES) == pytest.approx(uu, rel=3e-14)
    if strength > 1e-200:
        np.testing.assert_allclose(after, by_angle(u, pace, t), rtol=1e-13, atol=1e-13)
    else:
        np.testing.assert_allclose(after, u, rtol=1e-15)
    if strength * 0.01 > 100:
        e = pace / np.abs(pace).max()
        np.testing.assert_allclose(
            after, math.copysign(1, t) * e * math.sqrt(uu / kick.square_sum(e, MASSES)), rtol=1e-12
        )
    if strength <= 1e-6:  # log of the growth is the integral of alpha
        assert growth == pytest.approx(t * up / uu, rel=1e-6)
    assert math.isfinite(growth)


@pytest.mark.parametrize("tilt", [0.0, 1e-12, 1e-6, 1e-3, 0.1])
@pytest.mark.parametrize("z", [1e-3, 1.0, 10.0, 30.0, 800.0])
def test_against_the_force(tilt, z):
    """u + sF and s' are then differences of nearly equal numbers."""
    pace = RNG.standard_normal((4, 3))
    side = RNG.standard_normal((4, 3))
    side -= pace * (MASSES * side * pace).sum() / (MASSES * pace * pace).sum()
    u = -pace + tilt * side
    uu, _, pp = kick.sums(u, pace, MASSES)
    t = z * math.sqrt(uu / pp)
    after, growth = kicked(u, pace, t)
    assert kick.square_sum(after, MASSES) == pytest.approx(uu, rel=3e-13)
    assert math.isfinite(growth)
    # q/(1 + p) = tan of half the angle falls off as e^-z
    q = tilt * math.sqrt((MASSES * side * side).sum() / uu)
    p = math.copysign(math.sqrt(max(1 - q * q, 0)), -1)
    begin = math.log((1 - p) / q) if q else math.inf
    cosine = (MASSES * after * pace).sum() / math.sqrt(uu * pp)
    if math.isinf(begin):
        if z < 30:  # beyond, rounding decides
            assert cosine == pytest.approx(-1, abs=1e-3)
    elif q > 1e-9 or z < 20:
        assert cosine == pytest.approx(math.tanh(z - begin), abs=1e-6)


ORDERS = pytest.mark.parametrize("order", [2, 4, 6])
EVERY = pytest.mark.parametrize("name", ROWS)


@ORDERS
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"ions": 5},
        {"cell": np.diag([9.0, 8.0, 7.0]), "pbc": True},
        {"at": 1e6, "force": lambda x, t: springs(x - 1e6, t)},
    ],
    ids=["plain", "ions", "periodic", "far"],
)
@EVERY
def test_steps_are_those_made_operation_by_operation(name, options, order) -> None:
    system, state = molecules(name, **options)
    compiled, calls = isokinetics(system, order=order)
    state = compiled.start(system, state)
    close = 1e-9 if "at" in options else 2e-14
    for dt in (0.05, -0.02, 0.03):
        following, expected = compiled.step(system, state, dt), calls.step(system, state, dt)
        assert distance(following, expected) <= close
        assert distance(following, state) > 1e-3
        np.testing.assert_allclose(following.forces, expected.forces, rtol=0, atol=close)
        np.testing.assert_allclose(following.thermostat, expected.thermostat, rtol=1e-12 + close, atol=close)
        state = following


# -- where a kernel cannot go on --------------------------------------------------------------------


def noted(monkeypatch, method: str) -> list[int]:
    """Steps in which Python made an operation."""
    calls: list[int] = []
    made = getattr(IsokineticStep, method)

    def note(self, row, begun):
        calls.append(self.number)
        return made(self, row, begun)

    monkeypatch.setattr(IsokineticStep, method, note)
    return calls


def test_the_engine_lands_where_many_iterations_are_needed(monkeypatch) -> None:
    """As a flight that the kernel gives up; steps are the same, and those without solution name row and step."""
    system, state = molecules("triangles", force=lambda x, t: 0 * x)
    compiled, calls = isokinetics(system)
    made, taken, failed = noted(monkeypatch, "fly"), 0, 0
    state = compiled.start(system, state)
    for dt in np.geomspace(0.3, 30.0, 15):
        outcomes = []
        made.clear()
        for each in (compiled, calls):
            try:
                outcomes.append(each.step(system, state, float(dt)))
            except ConvergenceError as error:
                outcomes.append(error)
            if each is compiled:
                taken += bool(made) and isinstance(outcomes[0], State)
        one, two = outcomes
        if isinstance(two, State):
            assert distance(one, two) <= 1e-10
        else:
            failed += 1
            assert (one.step, one.row, one.atoms) == (two.step, two.row, two.atoms) == (1, two.row, two.atoms)
            assert f"step 1: time step too large (dt = {dt:g})" in str(one)
    assert taken and failed


def along_bonds(x: np.ndarray) -> np.ndarray:
    """Forces of which a kick without projection would leave some."""
    push, d = np.zeros_like(x), x[1::3] - x[0::3]
    push[0::3], push[1::3] = -1e9 * d, 1e9 * d
    return springs(x, 0.0) + push


@pytest.mark.parametrize("against", [False, True], ids=["along bonds", "against velocities"])
def test_forces_too_strong_for_the_closed_form(monkeypatch, against) -> None:
    """Digits would be lost in it; the tangent one takes over."""
    system, state = molecules("bent", n=2) if against else molecules("triangles")
    system.force = lambda x, t: system.masses[:, None] * [0.0, 0.0, 1e8] if against else along_bonds(x)
    compiled, calls = isokinetics(system)
    start = compiled.start(system, State(state.positions, 0 * state.positions - [0, 0, 1.0]) if against else state)
    made, dt = noted(monkeypatch, "first_turn"), 0.01 if against else 0.02
    after = compiled.step(system, start, dt)
    assert made == [1]
    assert distance(after, calls.step(system, start, dt)) <= (1e-13 if against else 1e-6)
    kinetic = 0.5 * system.masses.sum() if against else system.kinetic_energy(start.velocities)
    assert system.kinetic_energy(after.velocities) == pytest.approx(kinetic, rel=1e-14)


@pytest.mark.parametrize("method", ["first_turn", "turn"])
def test_turns_by_python_are_those_of_the_kernel(method) -> None:
    """Where a function says that it has done nothing, the method does all."""
    system, state = molecules("tetrahedra", ions=3)
    thermostat = Isokinetic(momentum="free", order=4)
    start = thermostat.start(system, state)
    expected = thermostat.step(system, start, 0.05)
    program = Isokinetic(momentum="free", order=4).program(None)
    program.rows[:] = [r._replace(verb=PYTHON, function=None) if r.name == method else r for r in program.rows]
    thermostat._programs[0] = program
    after = thermostat.step(system, start, 0.05)
    assert distance(after, start) > 0 and distance(after, expected) <= 1e-14
    np.testing.assert_allclose(after.thermostat, expected.thermostat, rtol=1e-12, atol=1e-13)


NAMES = [name for name in cases.NAMES if "isokinetic" in name]
#: Single atoms and free clusters: there is no temperature, and it is said.
HAS_NO_TEMPERATURE = "ignore:(total momentum|the forces exert):UserWarning"


@functools.cache
def referenced(name: str) -> System:
    case = cases.load(name)
    start = case.initial.positions
    motion = Motion(ConstraintSet(case.constraints, start, case.masses), start)
    return System(motion, lambda x, t: case.force(x, np.zeros_like(x)), potential=lambda x, t: case.potential(x))


def begin(name: str) -> State:
    return State(cases.load(name).initial.positions, cases.load(name).initial.velocities)


def error(a: State, b: cases.Snapshot) -> float:
    return max(np.abs(a.positions - b.positions).max(), np.abs(a.velocities - b.velocities).max())


#: Steps a unit of time for each order, few enough for errors to be above rounding.
STEPS = {2: (40, 80), 4: (8, 16), 6: (4, 8)}


def slope(counts, errors) -> float:
    return float(-np.polyfit(np.log(counts), np.log(errors), 1)[0])


# -- against independent solutions ------------------------------------------------------------------


@pytest.mark.filterwarnings(HAS_NO_TEMPERATURE)
@pytest.mark.parametrize("name", NAMES)
def test_reference_trajectories_to_their_tolerance(name):
    held, case, state = referenced(name), cases.load(name), begin(name)
    thermostat = Isokinetic(order=6)
    kinetic = held.kinetic_energy(state.velocities)
    steps = {"A10_isokinetic_lj4": 500, "A10_isokinetic_dumbbell_quartic": 120}.get(name, 100)
    for target in case.solution:
        span = target.time - state.time
        if target.time > 10:  # lj4 is chaotic
            break
        state = run(held, state, span / round(steps * span), round(steps * span), stepper=thermostat)
        assert error(state, target) <= target.tolerance, target.time
        assert state.velocities.ravel() @ state.forces.ravel() / (2 * kinetic) == pytest.approx(target.alpha, abs=1e-10)
        assert held.kinetic_energy(state.velocities) == pytest.approx(kinetic, rel=3e-15)


def on_ellipsoid():
    a, s = np.array([1.2, 0.9, 0.7]), np.array([0.5, 0.6, math.sqrt(0.39)])
    return [Ellipsoid([0], [0, 0, 0], a)], [a * s, [2.0, 1.0, 0.0]], [1.5, 1.0]


def on_torus():
    return [Torus([0], [0, 0, 0], [0, 0, 1.0], 1.5, 0.5)], [[2.0, 0.0, 0.0]], [1.3]


@functools.cache
def solved(made):
    held = system(*made(), waves)
    x = np.array(made()[1])
    start = held.initial_state(x, thermal_velocities(held, x, 0.8, 3))
    return held, start, integrated(held, start, 1.0)


#: Many projections on curved surfaces, which the others have too.
COSTLY = {(on_ellipsoid, 4), (on_torus, 4), (on_torus, 6)}


@pytest.mark.parametrize(
    ("made", "order"),
    [
        pytest.param(
            made, order, id=f"{made.__name__}-{order}", marks=[pytest.mark.validation] * ((made, order) in COSTLY)
        )
        for made in (water_and_more, on_ellipsoid, on_torus)
        for order in (2, 4, 6)
    ],
)
def test_order_with_constraints(made, order):
    """Against Gauss's principle with v^T M as one more row, solved densely as an ordinary differential equation."""
    counts = 2 * np.array(STEPS[order])
    held, start, exact = solved(made)
    kinetic = held.kinetic_energy(start.velocities)
    errors = []
    for n in counts:
        after = run(held, start, 1.0 / n, n, stepper=Isokinetic(order=order))
        errors.append(max(np.abs(after.positions - exact[0]).max(), np.abs(after.velocities - exact[1]).max()))
        assert held.kinetic_energy(after.velocities) == pytest.approx(kinetic, rel=1e-14)
    assert slope(counts, errors) == pytest.approx(order, abs=0.15), errors


# -- constants --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("momentum", "expected"), [("auto", 9), ("free", 12), ("conserved", 9)])
def test_a_loaded_run_of_other_degrees_of_freedom_begins_anew(momentum, expected):
    """Fewer rows, or another `momentum`, than the run had that was saved."""
    held, x = dumbbells(2, force=swirling, potential=None)
    v = thermal_velocities(held, x, 1.0, 1, zero_momentum=True)
    saved = run(held, State(x, v), 0.01, 5, stepper=Isokinetic(1.0))
    assert saved.thermostat[3] == 7
    free = system([], x, held.masses, swirling)
    after = run(free, loaded(saved), 0.01, 5, stepper=Isokinetic(1.0, momentum=momentum))
    assert after.thermostat[3] == expected
    assert (held.masses[:, None] * after.velocities**2).sum() == pytest.approx(expected - 1, rel=1e-12)


def on_its_way(thermostat):
    held, x = dumbbells(3)
    return held, run(held, State(x, thermal_velocities(held, x, 1.0, 1)), 0.01, 5, stepper=thermostat)


@pytest.mark.parametrize("changed", ["temperature", "attribute", "convention"])
def test_a_run_that_goes_on_with_other_settings_takes_them(changed):
    thermostat = Isokinetic(1.0)
    held, state = on_its_way(thermostat)
    wanted = 18.0 if changed == "convention" else 2.0 * (int(state.thermostat[3]) - 1)
    if changed == "attribute":
        thermostat.thermal_energy = 2.0
    else:
        thermostat = Isokinetic(2.0) if changed == "temperature" else Isokinetic(1.0, convention="notes")
    after = run(held, state, 0.01, 5, stepper=thermostat)
    assert 2 * held.kinetic_energy(after.velocities) == pytest.approx(wanted, rel=1e-12)


@pytest.mark.parametrize("put", ["velocities", "velocities by hand", "positions"])
def test_what_is_put_into_a_run_is_taken_from_its_next_step_on(put):
    """Velocities are scaled before the first flight; the square of the forces along the constraints is of these."""
    thermostat = Isokinetic(1.0)
    held, state = on_its_way(thermostat)
    x, v, forces = state.positions, 3 * state.velocities, state.forces
    if put == "positions":
        x, v = state.positions + np.array([0.4, -0.3, 0.2]), state.velocities
        forces = held.force(x, 0.0)
    other = State(x, v, forces=forces, thermostat=state.thermostat)
    after = thermostat.step(held, replace(state, velocities=v) if put == "velocities" else other, 0.01)
    alone = replace(other, forces=None) if put == "positions" else replace(state, thermostat=None)
    expected = Isokinetic(1.0).step(held, alone, 0.01)
    np.testing.assert_allclose(after.positions, expected.positions, atol=1e-14)
    np.testing.assert_allclose(after.velocities, expected.velocities, atol=1e-13)
    if put == "positions":
        assert after.thermostat[1] == pytest.approx(expected.thermostat[1], rel=1e-12)


def test_forces_that_were_dropped_are_found_again():
    """A run goes on from positions and velocities alone."""
    held, x = dumbbells(2)
    thermostat = Isokinetic(0.5, order=4)
    state = run(held, held.initial_state(x, thermal_velocities(held, x, 0.5, 4)), 0.02, 5, stepper=thermostat)
    stale = replace(state, forces=None, thermostat=state.thermostat * [1, 1, 17.0, 1])
    bare = State(state.positions, state.velocities, state.time, step=5)
    ends = [run(held, s, 0.02, 5, stepper=thermostat) for s in (state, stale, bare)]
    for end in ends[1:]:
        assert np.array_equal(end.positions, ends[0].positions)
        assert np.array_equal(end.velocities, ends[0].velocities)


def test_velocities_off_the_constraints_are_projected_and_scaled():
    held, x = dumbbells(2)
    v = np.random.default_rng(0).standard_normal(x.shape)
    begun = Isokinetic(0.5).start(held, State(x, v))
    tangent = held.motion.project_velocities(x, v)
    ratio = begun.velocities / tangent
    np.testing.assert_allclose(ratio, ratio[0, 0], rtol=1e-12)
    assert 2 * held.kinetic_energy(begun.velocities) == pytest.approx((12 - 2 - 1) * 0.5, rel=1e-14)


def test_one_degree_of_freedom():
    """g = 1 has no temperature, but a kinetic energy; g = 2 has beta = 1/2K, and averages that depend on the start."""
    x = np.array([[1.0, 0, 0]])
    one = [Plane([0], [0, 0, 1.0]), Sphere([0], [0, 0, 0], 1.0)]
    state = State(x, np.array([[0.0, 0.7, 0.0]]))
    ring = system(one, x, [1.0], waves)
    after = run(ring, state, 0.01, 100, stepper=Isokinetic())
    assert ring.kinetic_energy(after.velocities) == pytest.approx(ring.kinetic_energy(state.velocities), rel=1e-14)
    two = system(one[1:], x, [1.0], waves)
    with pytest.warns(UserWarning, match="two degrees of freedom.*Use Langevin") as said:
        after = run(two, state, 1e-3, 10, stepper=Isokinetic(0.4))
    assert [one.filename for one in said] == [__file__]
    assert 2 * two.kinetic_energy(after.velocities) == pytest.approx(0.4, rel=1e-14)
    run(two, state, 1e-3, 10, stepper=Isokinetic())


def test_forces_whose_squares_overflow():
    x = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    v = np.array([[0.3, -0.2, 0.1], [0.1, -0.4, 0.3]])
    held = system([], x, [1.0, 1.0], lambda x, t: np.full_like(x, 1e200))
    after = Isokinetic(momentum="free").step(held, State(x, v), 0.01)
    np.testing.assert_allclose(after.velocities, math.sqrt(2 * held.kinetic_energy(v) / 6), rtol=1e-14)
    light = system([], x, [1e-200, 1.0], lambda x, t: np.full_like(x, 1e200))
    with pytest.raises(NonFiniteError, match="non-finite velocity at step 1"):
        Isokinetic(momentum="free").step(light, State(x, v), 0.01)


def test_momentum_stays_zero():
    rows, x, masses = water_and_more()
    held = system(rows, x, masses, swirling)
    state = State(x, thermal_velocities(held, x, 0.5, 1, zero_momentum=True))
    after = run(held, state, 0.01, 2000, stepper=Isokinetic(0.5))
    assert np.abs(held.masses @ after.velocities).max() <= 1e-11
