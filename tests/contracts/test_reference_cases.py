"""Independent high-precision solutions: the oracle, the engine and RATTLE against all of them."""

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
from kcons.steppers import State, System, run

#: Error of accelerations and constraint forces, relative to the largest force at play at that time. The stored
#: positions are rounded to doubles, which alone makes 1e-16 times the sensitivity; the largest error seen is 7e-15.
TOLERANCE = 1e-13

#: |x - x_ref|/dt^2 of plain RATTLE at the first stored time up to 3, computed once with another implementation.
ERROR_CONSTANTS = {
    "A01_sphere_free": 0.314,
    "A02_spherical_pendulum_generic": 0.132,
    "A02_spherical_pendulum_near_conical": 0.257,
    "A02_spherical_pendulum_near_planar": 0.0431,
    "A02_spherical_pendulum_near_top": 1.01,
    "A02_spherical_pendulum_near_top_Lz": 0.698,
    "A03_planar_pendulum_10deg": 0.00403,
    "A03_planar_pendulum_150deg": 0.0024,
    "A03_planar_pendulum_90deg": 0.0338,
    "A03_planar_pendulum_rotating": 1.25,
    "A04_double_pendulum": 0.0272,
    "A04_double_spherical_pendulum": 0.139,
    "A04_triple_pendulum": 0.0236,
    "A05_dipole_field": 0.0416,
    "A05_rotor_free": 0.308,
    "A05_rotor_gravity": 0.308,
    "A05_two_dumbbells_lj": 0.0278,
    "A06_asymmetric_top4": 0.259,
    "A06_linear_triatomic": 0.0669,
    "A06_water_free3": 213,
    "A07_angle_only_flexible_bonds": 0.435,
    "A07_bent_bonds_angle_field": 0.0234,
    "A07_butane_bonds_angles_fixed": 0.0295,
    "A08_bead_rotating_ellipse": 0.285,
    "A08_bead_rotating_hoop": 0.276,
    "A08_bead_vertical_ellipse": 0.0962,
    "A08_torus_geodesic": 0.127,
    "A08_torus_inner_equator": 0.0796,
    "A09_catenary_relax": 0.0982,
    "A09_hanging_chain5_3d": 0.255,
    "A09_ring6_planar": 0.0488,
}

EVERY = pytest.mark.parametrize("name", cases.NAMES)
HOLONOMIC_NAMES = [name for name in cases.NAMES if not cases.load(name).isokinetic]
HOLONOMIC = pytest.mark.parametrize("name", HOLONOMIC_NAMES)


@functools.cache
def constraint_set(name: str) -> ConstraintSet:
    case = cases.load(name)
    return ConstraintSet(case.constraints, case.initial.positions, case.masses, time=case.initial.time)


@functools.cache
def engine(name: str) -> Motion:
    return Motion(constraint_set(name), cases.load(name).initial.positions)


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
    assert set(ERROR_CONSTANTS) < set(HOLONOMIC_NAMES)
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


def system(name: str) -> System:
    case = cases.load(name)
    if case.velocity_dependent:
        return System(engine(name), lambda x, v, t: case.force(x, v), velocity_dependent=True)
    nothing = np.zeros((len(case.masses), 3))
    return System(engine(name), lambda x, t: case.force(x, nothing), potential=lambda x, t: case.potential(x))


def trajectories(name: str, reference: Snapshot, steps: int) -> Runs:
    case, setting = cases.load(name), system(name)
    start = setting.initial_state(case.initial.positions, case.initial.velocities, time=case.initial.time)
    length = reference.time - case.initial.time
    states = [run(setting, start, length / n, n) for n in (steps, 2 * steps, 4 * steps)]
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


@pytest.mark.parametrize("name", sorted(ERROR_CONSTANTS))
def test_rattle_has_the_known_error_constant(name: str) -> None:
    runs = first_runs(name)
    constant = runs.errors("positions")[-1] / runs.dt**2
    assert constant == pytest.approx(ERROR_CONSTANTS[name], rel=0.02)


@HOLONOMIC
def test_rattle_stays_on_the_constraints(name: str) -> None:
    held = constraint_set(name)
    for state in first_runs(name).states:
        assert np.all(np.abs(held.value(state.positions, state.time)) <= held.tolerance(state.positions, state.time))
        rows, c = held.jacobian(state.positions, state.time), held.velocity_target(state.positions, state.time)
        np.testing.assert_allclose(
            rows @ state.velocities.ravel(), c, rtol=0, atol=1e-14 * (np.abs(state.velocities).max() + np.abs(c).max())
        )
