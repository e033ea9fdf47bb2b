"""The geodesic splitting: substeps, great circles, and what is left of the error."""

from __future__ import annotations

import numpy as np
import pytest
from stepper_problems import FRICTION, HOLONOMIC, VELOCITY_ROWS, GlobalError, named, observed_order
from stepper_systems import angle_of, growing_rod, rotor, spherical_pendulum, system_of

from kcons.constraints import Distance, FixedAtoms, Plane, Sphere
from kcons.errors import ConvergenceError, InputError, UnsupportedError
from kcons.steppers import Geodesic, Rattle, run


@pytest.mark.parametrize("problem", [*HOLONOMIC, *VELOCITY_ROWS, *FRICTION], ids=named)
@pytest.mark.parametrize("substeps", [1, 3])
def test_observed_order(substeps: int, problem: GlobalError) -> None:
    # Projections with velocity rows take ten milliseconds.
    steps = [8, 16, 32] if problem in VELOCITY_ROWS else [16, 32, 64, 128]
    assert observed_order(Geodesic(substeps), problem, steps) == pytest.approx(2, abs=0.15)


def test_one_substep_is_rattle() -> None:
    for make in (spherical_pendulum, rotor, growing_rod):
        system, state = make()
        a = run(system, state, 0.05, 20, stepper=Geodesic(1, great_circles=False))
        b = run(system, state, 0.05, 20, stepper=Rattle())
        np.testing.assert_allclose(a.positions, b.positions, rtol=0, atol=1e-13)
        np.testing.assert_allclose(a.velocities, b.velocities, rtol=0, atol=1e-13)


@pytest.mark.parametrize("substeps", [1, 2, 5])
def test_rotor_turns_by_the_arcsine_of_a_substep(substeps: int) -> None:
    system, state = rotor(omega=1.0)
    end = run(system, state, 0.7, 4, stepper=Geodesic(substeps))
    assert angle_of(end) == pytest.approx(4 * substeps * np.arcsin(0.7 / substeps), abs=1e-13)


def test_substeps_reach_where_rattle_has_no_solution() -> None:
    system, state = rotor(omega=1.0)
    with pytest.raises(ConvergenceError, match="time step too large"):
        Rattle().step(system, state, 1.2)
    assert angle_of(Geodesic(2).step(system, state, 1.2)) == pytest.approx(2 * np.arcsin(0.6), abs=1e-14)


def test_moving_rows_are_met_at_the_time_of_each_substep() -> None:
    """A rod that grows while it turns: with fine substeps the only error left is that of the substeps."""
    system, state = growing_rod()
    exact = 2.0 * np.array([np.cos(0.9), np.sin(0.9), 0.0])
    errors = [np.abs(run(system, state, 0.5, 4, stepper=Geodesic(n)).positions[1] - exact).max() for n in (16, 32, 64)]
    slopes = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(slopes, 2.0, atol=0.1)
    assert errors[-1] < 1e-4


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
def test_great_circles_are_exact_for_any_step(rest) -> None:
    system, state, center = sphere(rest=rest)
    end = run(system, state, 10.0, 3, stepper=Geodesic(great_circles=True))
    for k, radius in enumerate((1.0, 2.0)):
        arm, v = state.positions[k] - center, state.velocities[k]
        angle = np.linalg.norm(v) * 30.0 / radius
        exact = center + arm * np.cos(angle) + v / np.linalg.norm(v) * radius * np.sin(angle)
        np.testing.assert_allclose(end.positions[k], exact, rtol=0, atol=1e-13)
        turned = v * np.cos(angle) - arm / radius * np.linalg.norm(v) * np.sin(angle)
        np.testing.assert_allclose(end.velocities[k], turned, rtol=0, atol=1e-13)
    np.testing.assert_allclose(end.positions[-1], state.positions[-1] + 30.0 * state.velocities[-1], atol=1e-13)
    if rest:
        assert np.array_equal(end.positions[2], state.positions[2])


def test_great_circles_of_an_atom_at_rest() -> None:
    system, state, _ = sphere()
    still = system.initial_state(state.positions)
    end = run(system, still, 1.0, 3, stepper=Geodesic(great_circles=True))
    np.testing.assert_allclose(end.positions, still.positions, rtol=0, atol=1e-15)
    assert np.isfinite(end.velocities).all()


def test_great_circles_agree_with_substeps() -> None:
    system, state, _ = sphere()
    exact = run(system, state, 0.1, 10, stepper=Geodesic())
    errors = [
        np.abs(run(system, state, 0.1, 10, stepper=Geodesic(n, great_circles=False)).positions - exact.positions).max()
        for n in (8, 16, 32)
    ]
    np.testing.assert_allclose(np.log2(np.array(errors[:-1]) / errors[1:]), 2.0, atol=0.1)


@pytest.mark.parametrize(
    "rows",
    [
        [Distance([0, 1])],
        [Sphere(0, [0, 0, 0], np.sqrt(2)), Plane(1, [0, 0, 1], 0.0)],
        [Sphere(0, [0, 0, 0], np.sqrt(2)), Sphere(0, [3, 0, 1], 2.0)],
        [FixedAtoms([0])],
    ],
    ids=["distance", "plane", "two spheres", "no sphere"],
)
def test_great_circles_are_refused_where_there_are_none(rows) -> None:
    positions = np.array([[1.0, 0.0, 1.0], [2.0, 1.0, 0.0]])
    system = system_of(rows, positions, [1.0, 1.0])
    state = system.initial_state(positions)
    stepper = Geodesic(great_circles=True)
    for attempt in (lambda: stepper.check(system), lambda: stepper.step(system, state, 0.1)):
        with pytest.raises(UnsupportedError, match="Leave great_circles at None"):
            attempt()
    run(system, state, 0.1, 3, stepper=Geodesic(2))


def test_error_is_that_of_the_splitting_alone() -> None:
    """A fast rotor in a weak field: the drift is exact, what is left goes with the field."""
    field = 1e-3 * np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    system, state = rotor(omega=5.0, force=lambda x, t: field)
    fine = run(system, state, 0.0005, 4000, stepper=Geodesic(32))
    by_rattle = run(system, state, 0.05, 40, stepper=Rattle())
    by_geodesic = run(system, state, 0.05, 40, stepper=Geodesic(32))
    assert (
        100 * np.abs(by_geodesic.positions - fine.positions).max() < np.abs(by_rattle.positions - fine.positions).max()
    )


@pytest.mark.parametrize("substeps", [0, -1, 1.5, np.nan])
def test_bad_number_of_substeps(substeps) -> None:
    with pytest.raises(InputError, match="substeps"):
        Geodesic(substeps)
