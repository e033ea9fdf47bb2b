"""Independent high-precision solutions: oracle, engine, RATTLE and steppers of order six against all of them."""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
import pytest
from reference import cases
from reference.cases import Case, Snapshot

from kcons.constraints import projection
from kcons.constraints.constraint_set import ConstraintSet
from kcons.motion import Motion
from kcons.steppers import BlanesMoan6, KahanLi6, State, Stepper, System, run

#: Error of accelerations and constraint forces, relative to the largest force at play at that time. The stored
#: positions are rounded to doubles, which alone makes 1e-16 times the sensitivity; the largest error seen is 7e-15.
TOLERANCE = 1e-13

EVERY = pytest.mark.parametrize("name", cases.NAMES)
HOLONOMIC_NAMES = [name for name in cases.NAMES if not cases.load(name).isokinetic]
HOLONOMIC = pytest.mark.parametrize("name", HOLONOMIC_NAMES)


@functools.cache
def constraint_set(name: str) -> ConstraintSet:
    case = cases.load(name)
    return ConstraintSet(case.constraints, case.initial.positions, case.masses, time=case.initial.time)


@functools.cache
def engine(name: str) -> Motion:
    first = cases.load(name).initial
    return Motion(constraint_set(name), first.positions, time=first.time)


def thermostatted_force(case: Case, s: Snapshot) -> np.ndarray:
    """Applied force, the friction of the isokinetic thermostat included where there is one."""
    return case.force(s.positions, s.velocities) - s.alpha * case.masses[:, None] * s.velocities


def check(case: Case, s: Snapshot, a: np.ndarray, z: np.ndarray) -> None:
    """Accelerations and total constraint forces against the reference, at one time."""
    friction = s.alpha * case.masses[:, None] * s.velocities
    force = max(np.abs(case.force(s.positions, s.velocities)).max(), np.abs(friction).max())
    largest = max(np.abs(s.constraint_forces).max(), force)
    if largest == 0:
        largest = 1.0
    m = case.masses[:, None]
    assert np.abs(z - s.constraint_forces).max() <= TOLERANCE * largest, f"constraint force at t = {s.time}"
    assert np.abs(m * (a - s.accelerations)).max() <= TOLERANCE * largest, f"acceleration at t = {s.time}"


def test_all_cases_are_here() -> None:
    assert len(cases.NAMES) == 38
    assert len(HOLONOMIC_NAMES) == 34


# -- the files and the constraint set ---------------------------------------------------------------


@EVERY
def test_stored_states_fulfil_the_constraints_and_have_the_stored_energy(name: str) -> None:
    case, held = cases.load(name), constraint_set(name)
    for s in (case.initial, *case.solution):
        np.testing.assert_array_less(np.abs(held.value(s.positions, s.time)), 3 * held.tolerance(s.positions, s.time))
        rows, c = held.jacobian(s.positions, s.time), held.velocity_target(s.positions, s.time)
        speed = np.abs(s.velocities).max(initial=0) + np.abs(c).max(initial=0)
        np.testing.assert_allclose(rows @ s.velocities.ravel(), c, rtol=0, atol=1e-14 * speed)
        if s.energy is not None:
            parts = abs(case.potential(s.positions)) + abs(case.energy(s.positions, s.velocities))
            assert case.energy(s.positions, s.velocities) == pytest.approx(s.energy, abs=1e-14 * parts + 1e-15)


# -- the oracle -------------------------------------------------------------------------------------


@EVERY
def test_oracle_accelerations_and_constraint_forces(name: str) -> None:
    case, held = cases.load(name), constraint_set(name)
    for s in case.snapshots:
        A = held.jacobian(s.positions, s.time).toarray()
        b = held.acceleration_target(s.positions, s.velocities, s.time)
        f = thermostatted_force(case, s)
        projection.require_solvable(A, b)
        a = projection.acceleration(A, case.masses, f, b)
        check(case, s, a, projection.constraint_force(A, case.masses, f, b))
        check(case, s, *projection.bott_duffin(A, case.masses, f, b))
        # Gauss: the stored solution itself is the least among its admissible neighbors.
        least = projection.gauss_function(s.accelerations, case.masses, f)
        assert least == pytest.approx(projection.gauss_function(a, case.masses, f), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("name", [name for name in cases.NAMES if cases.load(name).isokinetic])
def test_oracle_with_the_kinetic_energy_as_one_more_row(name: str) -> None:
    """Notes example 5: the row v^T M with b = 0 gives the thermostat, with holonomic rows or without."""
    case, held = cases.load(name), constraint_set(name)
    for s in case.snapshots:
        momentum = case.masses[:, None] * s.velocities
        A = np.vstack([held.jacobian(s.positions).toarray(), momentum.reshape(1, -1)])
        b = np.append(held.acceleration_target(s.positions, s.velocities), 0.0)
        f = case.force(s.positions, s.velocities)
        a = projection.acceleration(A, case.masses, f, b)
        z = projection.constraint_force(A, case.masses, f, b)
        check(case, s, a, z + s.alpha * momentum)
        assert projection.multipliers(A, case.masses, f, b)[-1] == pytest.approx(-s.alpha, abs=1e-13 * np.abs(f).max())


def test_two_ways_to_hold_a_bent_molecule_are_one() -> None:
    """Two bonds and the angle, or three distances: other rows and multipliers, the same motion."""
    case = cases.load("A07_bent_bonds_angle_field")
    x, v = case.initial.positions, case.initial.velocities
    other = ConstraintSet(cases.held.Distance([[0, 1], [0, 2], [1, 2]]), x, case.masses)
    for s in case.snapshots:
        x, v, f = s.positions, s.velocities, case.force(s.positions, s.velocities)
        A, b = other.jacobian(x).toarray(), other.acceleration_target(x, v)
        a, z = projection.acceleration(A, case.masses, f, b), projection.constraint_force(A, case.masses, f, b)
        check(case, s, a, z)


# -- the engine -------------------------------------------------------------------------------------


@EVERY
def test_engine_accelerations_and_constraint_forces(name: str) -> None:
    case, held, motion = cases.load(name), constraint_set(name), engine(name)
    for s in case.snapshots:
        f = thermostatted_force(case, s)
        a = motion.acceleration(s.positions, s.velocities, f, s.time)
        z = motion.constraint_force(s.positions, s.velocities, f, s.time)
        check(case, s, a, z)
        lam = motion.multipliers(s.positions, s.velocities, f, s.time)
        check(case, s, a, (held.jacobian(s.positions, s.time).T @ lam).reshape(z.shape))


@EVERY
def test_engine_leaves_the_stored_states_where_they_are(name: str) -> None:
    case, held, motion = cases.load(name), constraint_set(name), engine(name)
    for s in (case.initial, *case.solution):
        x = motion.project_positions(s.positions, s.positions, time=s.time)
        np.testing.assert_allclose(x, s.positions, rtol=0, atol=2e-14 * np.abs(s.positions).max())
        assert np.all(np.abs(held.value(x, s.time)) <= held.tolerance(x, s.time))
        v = motion.project_velocities(s.positions, s.velocities, time=s.time)
        np.testing.assert_allclose(v, s.velocities, rtol=0, atol=2e-14 * np.abs(s.velocities).max(initial=1e-300))


# -- trajectories -----------------------------------------------------------------------------------


class Runs(NamedTuple):
    """RATTLE from the start to one stored time, with a step, half of it and a quarter."""

    dt: float
    states: list[State]
    reference: Snapshot

    def errors(self, item: str) -> np.ndarray:
        """Largest deviation of each run."""
        return np.array([np.abs(getattr(s, item) - getattr(self.reference, item)).max() for s in self.states])

    def extrapolated(self, item: str) -> np.ndarray:
        """Without the terms in dt^2 and dt^4: a symmetric scheme has even powers only."""
        a, b, c = (getattr(s, item) for s in self.states)
        return (16 * (4 * c - b) / 3 - (4 * b - a) / 3) / 15


@functools.cache
def system(name: str) -> System:
    """Isokinetic cases have the thermostat as a force that depends on the velocities, (f.v / v.m v) m v."""
    case = cases.load(name)
    if not (case.isokinetic or case.velocity_dependent):
        nothing = np.zeros((len(case.masses), 3))
        return System(engine(name), lambda x, t: case.force(x, nothing))

    def force(x: np.ndarray, v: np.ndarray, t: float) -> np.ndarray:
        f, p = case.force(x, v), case.masses[:, None] * v
        return f - np.sum(f * v) / np.sum(p * v) * p if case.isokinetic else f

    return System(engine(name), force, velocity_dependent=True)


def start(name: str) -> State:
    first = cases.load(name).initial
    return system(name).initial_state(first.positions, first.velocities, time=first.time)


def trajectories(name: str, reference: Snapshot, steps: int) -> Runs:
    first = start(name)
    length = reference.time - first.time
    states = [run(system(name), first, length / n, n) for n in (steps, 2 * steps, 4 * steps)]
    return Runs(length / (4 * steps), states, reference)


@functools.cache
def first_runs(name: str) -> Runs:
    return trajectories(name, cases.load(name).solution[0], 64)


@HOLONOMIC
def test_rattle_extrapolates_to_the_reference(name: str) -> None:
    """Nothing but even powers of dt separates RATTLE from the exact solution: four more digits without two of them."""
    runs = first_runs(name)
    for item in ("positions", "velocities"):
        plain = runs.errors(item)[-1]
        left = np.abs(runs.extrapolated(item) - getattr(runs.reference, item)).max()
        assert left <= max(1e-11, 1e-4 * plain), f"{item}: {left:.2e}, plain error {plain:.2e}"


@HOLONOMIC
def test_rattle_stays_on_the_constraints(name: str) -> None:
    held = constraint_set(name)
    for state in first_runs(name).states:
        assert np.all(np.abs(held.value(state.positions, state.time)) <= held.tolerance(state.positions, state.time))
        rows, c = held.jacobian(state.positions, state.time), held.velocity_target(state.positions, state.time)
        np.testing.assert_allclose(
            rows @ state.velocities.ravel(), c, rtol=0, atol=1e-14 * (np.abs(state.velocities).max() + np.abs(c).max())
        )


# -- the bound on round-off: max(1e-11, 100 cond eps), cond being the sensitivity of the solution to its start ---------

EPS = float(np.finfo(float).eps)
#: Surfaces without compiled solvers: a projection takes a millisecond.
SURFACES = frozenset(name for name in cases.NAMES if name.startswith("A08"))
#: Later times take minutes.
SLOW_AT_THE_BOUND = SURFACES | {"A04_triple_pendulum", "A05_two_dumbbells_lj", "A06_water_free3"}
#: Steps with which the bound is reached, and the stepper for it; 0.05 and BlanesMoan6 otherwise.
FLOOR_STEPS = {
    "A02_spherical_pendulum_near_top": 0.025,
    "A02_spherical_pendulum_near_top_Lz": 0.025,
    "A03_planar_pendulum_179deg": 0.03,
    "A03_planar_pendulum_179p9deg": 0.03,
    "A04_double_pendulum": 0.012,
    "A04_double_spherical_pendulum": 0.03,
    "A04_triple_pendulum": 0.008,
    "A05_rotor_free": 0.03,
    "A05_rotor_gravity": 0.03,
    "A05_two_dumbbells_lj": 0.0045,
    "A06_water_free3": 0.0025,
    "A07_angle_only_flexible_bonds": 0.02,
    "A07_butane_bonds_angles_fixed": 0.025,
    "A08_bead_rotating_ellipse": 0.008,
    "A08_bead_rotating_hoop": 0.015,
    "A08_bead_vertical_ellipse": 0.02,
    "A08_torus_geodesic": 0.015,
    "A08_torus_inner_equator": 0.02,
    "A09_catenary_relax": 0.012,
    "A09_hanging_chain5_3d": 0.012,
    "A09_ring6_planar": 0.02,
    "A10_isokinetic_constant_force": 0.025,
    "A10_isokinetic_dumbbell_quartic": 0.015,
    "A10_isokinetic_harmonic2d": 0.01,
    "A10_isokinetic_lj4": 0.0015,
}


@functools.cache
def sensitivities(name: str, latest: float = np.inf) -> tuple[float, ...]:
    """Of the solution at the first stored time, and at each other that is not after `latest`, to its start.

    By differences where the file has none, to the state at earlier stored times as well, since rounding on the way
    counts as that at the start does, and may count more: a pendulum near the top, a body about its middle axis.
    """
    case = cases.load(name)
    wanted = [s for k, s in enumerate(case.solution) if not k or s.time <= latest]
    known = [s.condition for s in wanted]
    if np.isfinite(known).all():
        return tuple(float(c) for c in known)
    setting, size, dt = system(name), 1e-6, min(0.1, 4 * FLOOR_STEPS.get(name, 0.05))
    largest = np.nan_to_num(known, nan=1.0)
    snapshots = [case.initial, *wanted]
    for j, s in enumerate(snapshots[:-1]):
        starts = [(s.positions, s.velocities), *disturbed(s, size)]
        states = [setting.initial_state(y, u, time=s.time, project=True) for y, u in starts]
        for k in range(j, len(known)):
            length = snapshots[k + 1].time - states[0].time
            n = int(np.ceil(length / dt))
            states = [run(setting, state, length / n, n, stepper=KahanLi6()) for state in states]
            flat = np.array([np.concatenate([e.positions.ravel(), e.velocities.ravel()]) for e in states])
            largest[k] = max(largest[k], np.linalg.norm(flat[1:] - flat[0]) / size)
    return tuple(largest.tolist())


def disturbed(snapshot: Snapshot, size: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Positions and velocities that differ from these by `size` along each axis of the tangent space, or at random."""
    x, v = snapshot.positions, snapshot.velocities
    if len(x) == 1:
        along = np.cross([0.0, 1.0, 0.0], x)  # in the plane of the pendulum
        return [(x * np.cos(size) + along * np.sin(size), v), (x, v + size * along)]
    # Of a matrix J, the mean of |J g|^2 over normal deviates g is |J|^2.
    some = np.random.default_rng(0).standard_normal((6, 2, *x.shape)) * size / np.sqrt(6)
    return [(x + a, v + b) for a, b in some]


def deviations(end: State, reference: Snapshot) -> tuple[float, float]:
    """Of positions and velocities: norms, relative to the largest component where that is more than 1."""
    return tuple(
        float(np.linalg.norm(a - b)) / max(1.0, float(np.abs(b).max()))
        for a, b in ((end.positions, reference.positions), (end.velocities, reference.velocities))
    )


@EVERY
def test_round_off_bound(name: str) -> None:
    case, setting, state = cases.load(name), system(name), start(name)
    latest = 1.0 if name in SLOW_AT_THE_BOUND or setting.velocity_dependent else 5.0
    stepper: Stepper = KahanLi6() if name in SURFACES or setting.velocity_dependent else BlanesMoan6()
    grown = sensitivities(name, latest)
    for reference, sensitivity in zip(case.solution[: len(grown)], grown, strict=True):
        n = int(np.ceil((reference.time - state.time) / FLOOR_STEPS.get(name, 0.05)))
        state = run(setting, state, (reference.time - state.time) / n, n, stepper=stepper)
        allowed = max(1e-11, 100 * sensitivity * EPS)
        for item, off in zip(("positions", "velocities"), deviations(state, reference), strict=True):
            assert off <= allowed, f"{item} at t = {reference.time}: {off:.1e}, allowed {allowed:.1e}"
