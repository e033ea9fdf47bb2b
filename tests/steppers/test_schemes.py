"""Each scheme by itself: order on known solutions, exact maps, fractions, what it conserves; the sums of a step."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from stepper_problems import FRICTION, HOLONOMIC, VELOCITY_ROWS, named, observed_order
from stepper_systems import COMPOSED, NYSTROM, PROJECTED, angle_of, rotor, slope, system_of, verlet

from kcons.constraints import Distance, FixedAtoms, Sphere
from kcons.errors import ConvergenceError, InputError, UnsupportedError
from kcons.steppers import BlanesMoan4, BlanesMoan6, Composition, Geodesic, Rattle, State, run
from kcons.steppers import compiled_operations as compiled
from kcons.steppers.splitting import KAHAN_LI_6, SUZUKI_4

COMPOSITIONS = [stepper for stepper in COMPOSED if isinstance(stepper, Composition)]
SPLITTINGS = pytest.mark.parametrize("stepper", NYSTROM, ids=repr)
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


@pytest.mark.parametrize(("atoms", "held"), [(1, []), (3, []), (9, [2, 7])])
def test_what_is_not_held_moves_by_velocity_verlet(atoms, held):
    rng = np.random.default_rng(3)
    x, v, masses = rng.normal(size=(atoms, 3)), rng.normal(size=(atoms, 3)), rng.uniform(1, 2, atoms)
    steps = 50 if held else 1000
    system = system_of([Distance(held)] if held else [], x, masses, lambda x, t: -x)
    end = run(system, system.initial_state(x, v, project=True), 0.02, steps)
    x1, v1 = verlet(x, v, masses, lambda x, t: -x, 0.02, steps)
    others, scale = np.delete(np.arange(atoms), held), np.abs(x1).max()
    assert np.abs(end.positions - x1)[others].max() <= 1e-13 * scale
    assert np.abs(end.velocities - v1)[others].max() <= 1e-13 * scale
    assert not held or np.abs(end.positions - x1)[held].max() > 1e-3


def test_huge_force_along_a_bond_cancels():
    pull = np.array([[1e12, 0, 0], [-1e12, 0, 0]])
    system, state = rotor(omega=0.0, force=lambda x, t: pull)
    end = run(system, state, 1e-3, 10)
    assert np.linalg.norm(end.positions[0] - end.positions[1]) == pytest.approx(1.2, rel=1e-10)


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


# -- compositions -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fractions", "order", "match"),
    [
        ([], 2, "no palindrome"),
        ([0.3, 0.7], 2, "no palindrome"),
        ([0.5, 0.4, 0.5], 2, "add up to 1.4"),
        ([0.25, 0.5, 0.25], 4, "powers of 3 do not cancel"),
        (SUZUKI_4, 6, "powers of 5 do not cancel"),
        ([KAHAN_LI_6[k] for k in (1, 0, 2, 3, 4, 5, 6, 8, 7)], 6, "not in this sequence"),
    ],
)
def test_bad_fractions(fractions, order, match) -> None:
    with pytest.raises(InputError, match=match):
        Composition(fractions, order)


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


def test_great_circles_of_an_atom_at_rest() -> None:
    system, state, _ = sphere()
    still = system.initial_state(state.positions)
    end = run(system, still, 1.0, 3, stepper=Geodesic())
    np.testing.assert_allclose(end.positions, still.positions, rtol=0, atol=1e-15)
    assert np.isfinite(end.velocities).all()


# -- Runge-Kutta-Nystrom ----------------------------------------------------------------------------


@SPLITTINGS
def test_velocity_dependent_forces_are_refused(stepper) -> None:
    system, state = rotor(force=lambda x, v, t: -v, velocity_dependent=True)
    seen: list[State] = []
    with pytest.raises(UnsupportedError, match="depend on the velocities; use Suzuki4 or KahanLi6"):
        run(system, state, 0.1, 0, stepper=stepper, observers=[seen.append])
    with pytest.raises(UnsupportedError, match="depend on the velocities"):
        stepper.step(system, state, 0.1)
    assert not seen


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
