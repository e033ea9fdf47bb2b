"""Each scheme by itself: order on known solutions, exact maps, fractions, conservation; drifts; sums of a step."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction

import numpy as np
import pytest
from constraint_cases import blade
from stepper_systems import (
    COMPOSED,
    NYSTROM,
    PROJECTED,
    angle_of,
    growing_rod,
    rotor,
    skate,
    slope,
    spherical_pendulum,
    system_of,
)

from kcons.constraints import Distance, FixedAtoms, Formula, MovingTarget, Plane, Sphere, VelocityFormula
from kcons.errors import ConvergenceError
from kcons.steppers import BlanesMoan4, BlanesMoan6, Geodesic, Rattle, State, Stepper, run
from kcons.steppers import compiled_operations as compiled
from kcons.steppers.interpreter import Interpreter
from kcons.steppers.operations import Fly, Program

GlobalError = Callable[[Stepper, float], float]


def error_spherical_pendulum(stepper, dt):
    # 25-digit reference at t = 1 (minimal coordinates, 45-digit arithmetic).
    x1 = np.array([0.4497250024354154, 0.6418565722780616, -0.6211018940624181])
    v1 = np.array([-0.9582024352419465, 0.2904057756042812, -0.3937014830599042])
    system, state = spherical_pendulum()
    end = run(system, state, dt, round(1 / dt), stepper=stepper)
    return np.abs(np.concatenate([end.positions[1] - x1, end.velocities[1] - v1])).max()


def error_free_rotor(stepper, dt):
    system, state = rotor(omega=1.3)
    end = run(system, state, dt, round(2 / dt), stepper=stepper)
    return abs(angle_of(end) - 2.6)


def error_growing_rod(stepper, dt):
    system, state = growing_rod(speed=2.7)
    end = run(system, state, dt, round(2 / dt), stepper=stepper)
    phi = 2.7 / 0.5 * (1 - 1 / 2.0)
    exact = 2.0 * np.array([np.cos(phi), np.sin(phi), 0.0])
    return np.abs(end.positions[1] - exact).max()


def error_rotor_with_friction(stepper, dt):
    system, state = rotor(omega=1.3, force=lambda x, v, t: -0.4 * np.array([[1.0], [2.5]]) * v, velocity_dependent=True)
    end = run(system, state, dt, round(2 / dt), stepper=stepper)
    return abs(angle_of(end) - 1.3 / 0.4 * (1 - np.exp(-0.8)))


def error_skate(stepper, dt):
    system, state = skate()
    end = run(system, state, dt, round(1 / dt), stepper=stepper)
    w, u0, g, t = 1.1, 0.4, 0.7, 1.0
    x = u0 / w * np.sin(w * t) + g / (2 * w**2) * np.sin(w * t) ** 2
    y = u0 / w * (1 - np.cos(w * t)) + g / w**2 * (w * t / 2 - np.sin(2 * w * t) / 4)
    return np.abs(end.positions.mean(axis=0) - [x, y, 0]).max()


def error_driven_atom(stepper, dt):
    system = system_of([VelocityFormula("vx1", 0, target=lambda t: np.cos(3 * t))], np.zeros((1, 3)), [2.0])
    end = run(system, system.initial_state(np.zeros((1, 3))), dt, round(2 / dt), stepper=stepper)
    return abs(end.positions[0, 0] - np.sin(6.0) / 3)


#: Rows and forces that depend on positions and time.
HOLONOMIC: list[GlobalError] = [error_spherical_pendulum, error_free_rotor, error_growing_rod]
VELOCITY_ROWS: list[GlobalError] = [error_skate, error_driven_atom]
FRICTION: list[GlobalError] = [error_rotor_with_friction]


def named(problem: GlobalError) -> str:
    return problem.__name__.removeprefix("error_")


def observed_order(stepper: Stepper, problem: GlobalError, steps: list[int]) -> float:
    """Slope over steps of 1/n, on errors that are far above rounding."""
    dts = 1.0 / np.array(steps)
    errors = [problem(stepper, dt) for dt in dts]
    assert min(errors) >= 30e-13, f"{errors} end in round-off"
    return slope(dts, errors)


COMPOSITIONS = [stepper for stepper in COMPOSED if not isinstance(stepper, Rattle | Geodesic)]
#: Coarse, since these are so accurate that finer steps end in round-off.
STEPS = {
    "spherical_pendulum": {4: [4, 8], 6: [1, 3]},
    "free_rotor": {4: [8, 16], 6: [4, 8]},
    "growing_rod": {4: [8, 16], 6: [4, 8]},
    "skate": {4: [4, 8], 6: [2, 4]},
    "driven_atom": {4: [4, 8], 6: [2, 4]},
}


def orders():
    """Steppers, problems, and numbers of steps; projections with velocity rows take ten milliseconds."""
    for problem in (*HOLONOMIC, *VELOCITY_ROWS, *FRICTION):
        rolls = problem in VELOCITY_ROWS
        for stepper in (Rattle(), Geodesic(1), Geodesic(3)):
            yield stepper, problem, [8, 16, 32] if rolls else [16, 32, 64, 128], ()
        for stepper in COMPOSITIONS:
            coarse = {4: 8, 6: 4}.get(stepper.order, 16)
            yield stepper, problem, [coarse, 2 * coarse] if rolls else [2 * coarse, 4 * coarse], ()
        for stepper in NYSTROM if problem not in FRICTION else ():
            # With velocity rows one of each order, on a skate, which is not integrable, and on an atom that is driven.
            first = type(stepper) is (BlanesMoan4 if problem is VELOCITY_ROWS[0] else BlanesMoan6)
            marks = pytest.mark.validation if rolls and not first else ()
            yield stepper, problem, STEPS[named(problem)][stepper.order], marks


@pytest.mark.parametrize(
    "stepper, problem, steps",
    [pytest.param(*row, id=f"{row[0]!r}-{named(row[1])}", marks=marks) for *row, marks in orders()],
)
def test_observed_order(stepper, problem, steps) -> None:
    assert observed_order(stepper, problem, steps) == pytest.approx(stepper.order, abs=0.15)


@pytest.mark.parametrize("stepper", PROJECTED, ids=repr)
@pytest.mark.parametrize("problem", [*HOLONOMIC, *VELOCITY_ROWS], ids=named)
def test_observed_order_of_the_projected_equation(stepper, problem) -> None:
    # The rod that grows is late in reaching its order.
    dts = 1.0 / np.array([64, 128] if problem is HOLONOMIC[2] else [32, 64])
    assert slope(dts, [problem(stepper, dt) for dt in dts]) == pytest.approx(stepper.order, abs=0.15)


# -- RATTLE -----------------------------------------------------------------------------------------


def test_state_off_the_constraints_is_named_as_the_cause():
    system, _ = rotor()
    crossed = State(np.array([[0.0, 9.0, 0.0], [0.0, -9.0, 0.0]]), np.array([[90.0, 0, 0], [-90.0, 0, 0]]))
    with pytest.raises(ConvergenceError, match=r"already off row #0 Distance\(0, 1\) by 16\.8"):
        Rattle().step(system, crossed, 1.0)


def test_unsettled_friction_is_reported():
    system, state = rotor(force=lambda x, v, t: -1e3 * v, velocity_dependent=True)
    with pytest.raises(ConvergenceError, match="time step too large") as caught:
        Rattle().step(system, state, 1.0)
    assert caught.value.step == 1


@pytest.mark.parametrize("stepper", COMPOSED, ids=repr)
def test_forces_that_depend_on_velocities_are_taken_back(stepper):
    system, start = rotor(force=lambda x, v, t: -0.4 * v, velocity_dependent=True)
    back = run(system, run(system, start, 0.05, 20, stepper=stepper), -0.05, 20, stepper=stepper)
    assert np.abs(back.positions - start.positions).max() <= 1e-12
    assert np.abs(back.velocities - start.velocities).max() <= 1e-12


# -- the geodesic splitting -------------------------------------------------------------------------


@pytest.mark.parametrize(("substeps", "omega_dt"), [(1, 0.7), (2, 0.7), (5, 0.7), (2, 1.2)])
def test_rotor_turns_by_the_arcsine_of_a_substep(substeps: int, omega_dt: float) -> None:
    """Also where RATTLE has no solution."""
    system, state = rotor(omega=1.0)
    end = run(system, state, omega_dt, 2, stepper=Geodesic(substeps))
    assert angle_of(end) == pytest.approx(2 * substeps * np.arcsin(omega_dt / substeps), abs=1e-13)


def sphere(radii=(1.0, 2.0), rest=()):
    """Atoms on spheres of their own about (1, 2, 3), no two in one place, and atoms at rest."""
    rng = np.random.default_rng(6)
    n = rng.normal(size=(len(radii), 3))
    n /= np.linalg.norm(n, axis=1)[:, None]
    center = np.array([1.0, 2.0, 3.0])
    positions = np.concatenate([center + np.array(radii)[:, None] * n, rng.normal(size=(len(rest) + 1, 3))])
    rows = [Sphere(k, center, r) for k, r in enumerate(radii)]
    if rest:
        rows.append(FixedAtoms([len(radii) + k for k in range(len(rest))]))
    system = system_of(rows, positions, np.linspace(1, 2, len(positions)))
    return system, system.initial_state(positions, rng.normal(size=positions.shape), project=True), center


@pytest.mark.parametrize("rest", [(), (1,)])
@pytest.mark.parametrize("stepper", [Geodesic(), *NYSTROM], ids=repr)
def test_great_circles_are_exact_for_any_step(stepper, rest) -> None:
    system, state, center = sphere(rest=rest)
    end = run(system, state, 10.0, 3, stepper=stepper)
    for k, radius in enumerate((1.0, 2.0)):
        arm, v = state.positions[k] - center, state.velocities[k]
        angle = np.linalg.norm(v) * 30.0 / radius
        exact = center + arm * np.cos(angle) + v / np.linalg.norm(v) * radius * np.sin(angle)
        np.testing.assert_allclose(end.positions[k], exact, rtol=0, atol=3e-13)
        turned = v * np.cos(angle) - arm / radius * np.linalg.norm(v) * np.sin(angle)
        np.testing.assert_allclose(end.velocities[k], turned, rtol=0, atol=3e-13)
    np.testing.assert_allclose(end.positions[-1], state.positions[-1] + 30.0 * state.velocities[-1], atol=1e-13)
    assert not rest or np.array_equal(end.positions[2], state.positions[2])
    still = system.initial_state(state.positions)
    after = run(system, still, 1.0, 3, stepper=stepper)
    np.testing.assert_allclose(after.positions, still.positions, rtol=0, atol=1e-15)
    assert np.isfinite(after.velocities).all()


# -- Runge-Kutta-Nystrom ----------------------------------------------------------------------------


def test_many_stages_round_once() -> None:
    """A hundred kicks and flights leave what one rounding does; a plain sum loses more."""
    rng = np.random.default_rng(1)
    x, v, w = 3 + rng.normal(size=(5, 3)), 3 + rng.normal(size=(5, 3)), rng.uniform(0.1, 1, (5, 3))
    q, u, inverse = ([Fraction(a) for a in values.ravel()] for values in (x, v, w))
    y, plain, low, push = x, v.copy(), np.zeros_like(x), np.zeros_like(x)
    for kick in 0.01 * np.sin(np.arange(100)):
        f, h, there, along = rng.normal(size=(5, 3)), -3 * kick, np.empty_like(x), np.empty_like(x)
        assert compiled.fly(x, low, v, push, kick, f, w, h, there)
        assert compiled.fly_once(y, plain, kick, f, w, h, along)
        x, y = there, along
        u = [a + Fraction(kick) * b * Fraction(c) for a, b, c in zip(u, inverse, f.ravel(), strict=True)]
        q = [a + Fraction(h) * b for a, b in zip(q, u, strict=True)]
    assert compiled.land(v, push, 0.0, w, w) and not push.any()
    for found, exact in ((x, q), (v, u)):
        assert np.abs(found.ravel() - np.array([float(a) for a in exact])).max() <= np.spacing(4.0)
    assert np.abs(y.ravel() - np.array([float(a) for a in q])).max() > 2 * np.spacing(4.0)


# -- drifts: constrained flight without forces ------------------------------------------------------


def flown(system, state, h: float, *, exact: bool = False, flights: int = 1):
    """Positions and velocities after a drift of h, by the engine."""
    if not exact:
        system.packed = None
    parts = (1.0 / flights,) * flights
    ends = (*np.cumsum(parts)[:-1], 1.0)
    steps = Interpreter(system, state, h, Program([Fly(1.0, parts, ends, exact)]))
    end = steps.through()
    return end.positions, end.velocities + (steps.push if steps.program.pairs else 0.0)


def literal_flight(system, state, h: float):
    """What a flight should be, by dense algebra on all rows at once: x1 and u."""
    held, x0, t0 = system.motion.constraint_set, state.positions, state.time
    rolls, weights = ~held.holonomic, np.repeat(system.inverse_masses, 3)
    pull = weights[:, None] * held.jacobian(x0, t0).toarray().T
    multipliers = np.zeros(held.n_rows)
    for _ in range(60):
        u = state.velocities.ravel() + pull @ multipliers
        x1 = x0 + h * u.reshape(x0.shape)
        middle, then = 0.5 * (x0 + x1), t0 + 0.5 * h
        rows = np.where(rolls[:, None], held.jacobian(middle, then).toarray(), held.jacobian(x1, t0 + h).toarray())
        speeds = held.jacobian(middle, then) @ u - held.velocity_target(middle, then)
        multipliers -= np.linalg.lstsq(rows @ pull, np.where(rolls, speeds, held.value(x1, t0 + h) / h), rcond=1e-10)[0]
    return x1, u.reshape(x0.shape)


#: Of a hub and a point that turns about it, on a slope whose direction has the sine s and the cosine c; radius 1.
ROLLS = "c*vx1 - s*vz1 - ((z2 - z1)*(vx2 - vx1) - (x2 - x1)*(vz2 - vz1))/((x2 - x1)**2 + (z2 - z1)**2)"


def rolling(masses, turns, size: float, slope: float = 0.0, force=None):
    """A wheel of three masses and a hub that rolls down a slope."""
    along, up = np.array([np.cos(slope), 0, -np.sin(slope)]), np.array([np.sin(slope), 0, np.cos(slope)])
    turns = np.radians(turns)[:, None]
    x = up + np.vstack([np.zeros(3), size * (np.cos(turns) * along + np.sin(turns) * up)])
    held = [Plane([0], up), Plane([0, 1, 2, 3], [0.0, 1, 0]), Distance([[0, 1], [0, 2], [0, 3], [1, 2], [2, 3]])]
    rolls = VelocityFormula(ROLLS, [0, 1], {"s": np.sin(slope), "c": np.cos(slope)})
    return system_of([*held, rolls], x, masses, force), x, along


def wheel():
    """It is pushed at its hub in a direction that turns with it."""
    system, x, _ = rolling([0.5, 1.0, 2.0, 1.5], [80, -40, -160], 0.9)
    return system, system.initial_state(x, np.array([[1.0, 0, 0], [2, 0, 0.5], [0, 0, 1], [-1, 0, 0]]), project=True)


def pivoting_skate():
    """A blade that touches at its back, so that what keeps it from sliding turns it."""
    x = np.array([[0.2, -0.1, 0.0], [0.7, 0.3, 0.1]])
    rows = [Distance([0, 1]), Plane([0, 1], [0.0, 0.1, 1.0]), blade([0, 1], contact=0.1)]
    system = system_of(rows, x, [1.0, 3.0])
    return system, system.initial_state(x, np.array([[1.0, 0.5, 0], [0.2, 2.0, 0]]), project=True)


def bodies_apart():
    """An atom whose velocity is held, a rod, and a free atom."""
    x = np.array([[0.0, 0, 0], [1.0, 0, 0], [5.0, 0, 0], [5.0, 1.2, 0], [9.0, 9, 9]])
    system = system_of([VelocityFormula("vz1", 0, target=lambda t: 0.5), Distance([2, 3])], x, np.ones(5))
    return system, system.initial_state(x, np.random.default_rng(1).normal(size=(5, 3)), project=True)


#: The plane of `swept` has turned by the end, and pushes where it was; speeds, and their directions, depend on time.
DENSE = [skate, pivoting_skate, wheel, bodies_apart, lambda: swept(), lambda: swept(pushed(np.cos)), growing_rod]


@pytest.mark.parametrize("h", [0.1, -0.3])
@pytest.mark.parametrize("make", DENSE)
def test_flights_are_those_of_dense_algebra(make, h) -> None:
    system, state = make()
    for one, other in zip(flown(system, state, h), literal_flight(system, state, h), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=3e-14)


def test_velocity_row_that_cannot_be_met_names_itself() -> None:
    """A skate that turns by more than it can in one step."""
    system, state = skate()
    with pytest.raises(ConvergenceError) as caught:
        flown(system, state, 40.0)
    assert caught.value.atoms == (0, 1)


def test_great_circles_only_where_every_row_allows_them() -> None:
    x = np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [5.0, 5.0, 5.0]])
    unit, wide = Sphere(0, [0, 0, 0], 1.0), Sphere(1, [0, 0, 0], 2.0)
    growing = Sphere(0, [0, 0, 0], MovingTarget(lambda t: 1 + t, lambda t: 1.0, lambda t: 0.0))

    def circles(*rows):
        return system_of(rows, x, [1, 1, 1]).great_circles

    assert circles(unit)[:, 3].tolist() == [1, 0, 0]
    assert circles(unit, wide, FixedAtoms([2]))[:, 3].tolist() == [1, 2, -1]
    for rows in ([FixedAtoms([2])], [growing], [unit, Distance([1, 2])], [unit, Sphere(0, [1, 1, 0], 1.0)], []):
        assert circles(*rows) is None


def test_great_circles_end_on_the_sphere_wherever_they_start() -> None:
    """What rounding, or a start within the tolerance, left off the sphere is gone after any drift: |x - c| = R."""
    center = np.array([0.3, -0.2, 0.1])
    on = center + 2.0 * np.array([[0.6, 0.0, 0.8]])
    system = system_of([Sphere(0, center, 2.0)], on, [2.0])
    state = system.initial_state(on, [[0.8, 0.5, -0.6]])
    for off in (1e-7, -1e-10):
        start = type(state)(on + off * (on - center), state.velocities)
        for h in (1e-6, 0.4):
            at, _ = flown(system, start, h, exact=True)
            assert abs(np.linalg.norm(at[0] - center) - 2.0) <= 4 * np.spacing(2.0)


# -- times ------------------------------------------------------------------------------------------


def turning(rate: float = 1.3) -> Formula:
    """Atom 0 in a plane through the z axis that turns: the gradient depends on the time, not only the value."""
    return Formula("x1*sin(w*t) - y1*cos(w*t)", 0, {"w": rate})


def pushed(speed) -> VelocityFormula:
    """Atom 2 moves at a given speed in a direction that turns with the time and depends on the place."""
    return VelocityFormula("vx1*cos(2*t) + vy1*sin(2*t) + vz1*x1", 2, target=speed)


def swept(*more) -> tuple:
    x = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.8], [1.7, 0.3, 0.8]])
    system = system_of([turning(), Distance([[0, 1], [1, 2]]), *more], x, [1.0, 0.4, 2.0])
    v = np.array([[0.3, 0.0, 0.1], [0.2, 0.5, -0.4], [0.0, 0.3, 0.6]])
    return system, system.initial_state(x, v, project=True)


@pytest.mark.parametrize("slope, dt", [(0.0, 0.0001), (0.17, 0.005), (0.17, 0.001)])
def test_a_wheel_starts_to_roll_from_rest(slope, dt) -> None:
    """Velocities are known to what rounding of the positions leaves of them, also where they vanish."""
    masses = np.array([0.5, 1.0, 1.0, 1.0])
    weight = masses[:, None] * np.array([0.0, 0.0, -10.0])
    system, x, along = rolling(masses, [0, 120, 240], 1.0, slope, lambda x, t: weight)
    end = run(system, State(x, np.zeros_like(x)), dt, 100)
    rolled = (end.positions[0] - x[0]) @ along
    assert rolled == pytest.approx(10 * np.sin(slope) * 3.5 / 6.5 * (100 * dt) ** 2 / 2, rel=1e-4, abs=1e-13)
