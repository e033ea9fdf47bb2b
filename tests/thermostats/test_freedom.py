"""Degrees of freedom by hand, conserved momenta, bodies apart; velocities drawn on the constraints."""

from __future__ import annotations

import math
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from fluids import LennardJones
from thermostat_systems import METHANE, TEN, quartic, repelling, swirling, system, waves

from kcons.constraints import CenterOfMass, Distance, Ellipsoid, FixedAtoms, Formula, Plane, Sphere
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import UnsupportedError
from kcons.motion import Motion
from kcons.steppers import State, System
from kcons.thermostats import Isokinetic, NoseHooverChain, freedom, thermal_velocities
from kcons.thermostats.freedom import LOOK_AT, open_directions

RNG = np.random.default_rng(11)
SCATTERED = 3.0 * RNG.standard_normal((12, 3))
WEIGHTS = np.linspace(1.0, 3.0, 12)


def methanes(force):
    """Two methanes, each by all ten distances (rank 9), and two free atoms."""
    x = np.vstack([METHANE, METHANE + np.array([5.0, 0, 0]), [[0, 4.0, 1.0], [2.0, -3.0, 0.5]]])
    pairs = np.array(TEN + [(i + 5, j + 5) for i, j in TEN])
    return system([Distance(pairs)], x, WEIGHTS, force), x


def mixed(force):
    """A bond from a fixed atom, a bond named twice, a bond between free atoms, and atoms on a plane."""
    rows = [FixedAtoms([0]), Distance([[0, 1], [2, 3], [2, 3], [4, 5]]), Plane([6, 7], [0, 0, 1.0])]
    return system(rows, SCATTERED, WEIGHTS, force), SCATTERED


def gravity(x, t):
    return np.tile([0.0, 0.0, -2.0], (len(x), 1)) + swirling(x)


def single(x, t):
    return swirling(x).astype(np.float32)


OPPOSITE = np.array([[0.7, 0.2, -0.4], [-0.7, -0.2, 0.4]])
FLAT = SCATTERED[:6] * [1.0, 1.0, 0.0]
ROUND = SCATTERED[:6].copy()
ROUND[:, :2] *= 2.0 / np.linalg.norm(ROUND[:, :2], axis=1)[:, None]


def twelve(force=None, *rows, x=SCATTERED):
    """Atoms and rows; the system, and where they are."""
    return system(list(rows), x, WEIGHTS[: len(x)], force), x


#: A perfect crystal, in which all forces are rounding.
CRYSTAL = 1.5 * np.stack(np.unravel_index(np.arange(27), (3, 3, 3)), 1) + 0.1
ATTRACTED = LennardJones(range(27), 4.5).force


def noisy(x, time):
    """What a calculator in single precision gives."""
    return ATTRACTED(x, time) + 2e-7 * np.sin(1e5 * x)


# (system and positions, g by hand, directions in which momentum is conserved)
COUNTED = {
    "free atoms, own forces": (twelve(swirling), 36 - 3, 3),
    "free atoms, single precision": (twelve(single), 36 - 3, 3),
    "two atoms, balanced by symmetry": ((system([], OPPOSITE, [1.0, 1.0], quartic), OPPOSITE), 6, 0),
    "free atoms in a field": (twelve(waves), 36, 0),
    "ideal gas": (twelve(), 36 - 3, 3),
    "crystal": ((system([], CRYSTAL, np.ones(27), ATTRACTED), CRYSTAL), 81 - 3, 3),
    "crystal, single precision": ((system([], CRYSTAL, np.ones(27), noisy), CRYSTAL), 81 - 3, 3),
    "gravity": (twelve(gravity), 36 - 2, 2),
    "a trap": (twelve(quartic), 36, 0),
    "one methane": ((system([Distance(TEN)], METHANE, np.ones(5), swirling), METHANE), 15 - 9 - 3, 3),
    "methanes, redundant": (methanes(swirling), 36 - 18 - 3, 3),
    "methanes in a field": (methanes(waves), 36 - 18, 0),
    "mixed": (mixed(swirling), 36 - 3 - 1 - 1 - 1 - 2, 0),
    "center of mass held": (twelve(swirling, CenterOfMass([range(12)])), 36 - 3, 0),
    "flat": (twelve(swirling, Plane(range(6), [0, 0, 1.0]), x=FLAT), 12 - 2, 2),
    "on a cylinder": (twelve(swirling, Ellipsoid(range(6), [0, 0, 0], [2.0, 2.0, np.inf]), x=ROUND), 12 - 1, 1),
}


@pytest.mark.parametrize("name", COUNTED)
def test_the_thermostats_hold_what_is_counted_by_hand(name):
    (held, x), count, directions = COUNTED[name]
    zero = {"zero_momentum": True} if directions else {}
    state = State(x, thermal_velocities(held, x, 0.7, 1, **zero))
    forces = held.forces(x, state.velocities, 0.0, 0)
    assert freedom(held, state, forces).count == count
    assert len(freedom(held, state, forces).directions) == directions
    for kt in (0.7, 1.9):
        begun = Isokinetic(kt).start(held, state)
        assert 2 * held.kinetic_energy(begun.velocities) == pytest.approx((count - 1) * kt, rel=1e-12)
        after = Isokinetic(kt).step(held, begun, 0.01)
        assert 2 * held.kinetic_energy(after.velocities) == pytest.approx((count - 1) * kt, rel=1e-12)
        assert after.thermostat[0] == pytest.approx((count - 1) * kt, rel=1e-14)
    moving = int((held.inverse_masses > 0).sum())
    notes = Isokinetic(0.7, convention="notes").start(held, state)
    assert 2 * held.kinetic_energy(notes.velocities) == pytest.approx(3 * moving * 0.7, rel=1e-12)
    assert NoseHooverChain(0.7, 1.0).start(held, state).thermostat[-1] == count


def test_conserved_directions_lie_where_they_should():
    (flat, x), _, _ = COUNTED["flat"]
    assert np.abs(open_directions(flat.motion, x)[:, 2]).max() <= 1e-12
    (falling, y), _, _ = COUNTED["gravity"]
    found = freedom(falling, State(y, y), falling.forces(y, y, 0.0, 0)).directions
    assert np.abs(found[:, 2]).max() <= 1e-7
    np.testing.assert_allclose(found @ found.T, np.eye(2), atol=1e-12)


def test_total_momentum_that_is_conserved_and_not_zero_is_said():
    """H39: P exp(-U/2K) is conserved, so that no K gives a temperature."""
    held = system([], SCATTERED, WEIGHTS, swirling)
    still = State(SCATTERED, thermal_velocities(held, SCATTERED, 1.0, 0, zero_momentum=True))
    moving = replace(still, velocities=still.velocities + np.array([0.0, 0.01, 0.0]))
    for thermostat in (Isokinetic(1.0), Isokinetic(), NoseHooverChain(1.0, 1.0)):
        thermostat.start(held, still)
        with pytest.warns(UserWarning, match="total momentum is not zero"):
            thermostat.start(held, moving)
    field = system([], SCATTERED, WEIGHTS, waves)
    Isokinetic(1.0).start(field, moving)


def test_angular_momentum_of_a_free_cluster_is_said():
    held = system([], SCATTERED, WEIGHTS, repelling)
    state = State(SCATTERED, thermal_velocities(held, SCATTERED, 1.0, 0, zero_momentum=True))
    for thermostat in (Isokinetic(1.0), NoseHooverChain(1.0, 1.0)):
        with pytest.warns(UserWarning, match="exert no torque"):
            thermostat.start(held, state)
    Isokinetic().start(held, state)  # no temperature is asked for


@pytest.mark.parametrize(
    ("rows", "axes"),
    [
        ([Sphere([0, 1, 2, 3], [0, 0, 0], 1.0)], 3),
        ([Plane([0, 1, 2, 3], [0, 0.6, 0.8], 0.0)], 1),
        ([Ellipsoid([0, 1, 2, 3], [0, 0, 0], [1.0, 1.0, np.inf])], 1),
        ([FixedAtoms([0], [0.5, 0.0, 0.2]), Distance([[1, 2]])], 3),
        ([Ellipsoid([0, 1, 2, 3], [0, 0, 0], [1.0, 1.2, 1.5])], 0),
        ([Distance([[0, 1]]), Formula("x1**2 + y1**2 + z1**2 - 1", [[3]])], 3),
        ([FixedAtoms([0, 1, 2])], 0),
    ],
    ids=["sphere", "plane", "cylinder", "fixed atom", "ellipsoid", "formula", "three fixed atoms"],
)
def test_angular_momentum_about_the_axes_of_what_is_held_is_said(rows, axes):
    """Pairs that repel exert no torque, and rows none about some axis; a field across it does."""
    x = np.random.default_rng(3).standard_normal((4, 3))
    motion = Motion(ConstraintSet(rows, x, np.ones(4)), x)
    x = motion.restore_positions(x, bonds=[])
    calls = []

    def force(x, t):
        calls.append(t)
        return repelling(x)

    for field in (0.0, np.array([[0.3, -0.7, 1.1]])):
        held = System(motion, lambda x, t, field=field: force(x, t) + field * x[:, [1, 2, 0]])
        state = held.initial_state(x, thermal_velocities(held, x, 1.0, 0), project=True)
        calls.clear()
        found = freedom(held, state, held.forces(x, x, 0.0, 0))
        assert found.turns == bool(axes and np.ndim(field) == 0)
        assert len(calls) <= 7
    cell = Motion(ConstraintSet([Plane([0, 1], [0, 0, 1.0])], x, np.ones(4), cell=[9.0] * 3), x)
    assert not freedom(System(cell, force), state, force(x, 0.0)).turns


def test_a_lattice_that_exerts_no_torque_by_symmetry_is_no_cluster():
    fluid = LennardJones(range(8), 3.0)
    x = 1.5 * np.stack(np.unravel_index(np.arange(8), (2, 2, 2)), 1).astype(float)
    x[:, 0] += 0.1 * (x[:, 0] > 0)
    held = system([], x, np.ones(8), fluid.force)
    assert (
        np.abs(np.cross(x - x.mean(axis=0), fluid.force(x)).sum(axis=0)).max() <= 1e-12 < np.abs(fluid.force(x)).max()
    )
    found = freedom(held, State(x, x), fluid.force(x))
    assert found.count == 21 and not found.turns


def test_a_surface_that_ends_nearby_has_a_place():
    x = np.array([[0.5, 0.0, 0.0], [3.0, 0.2, 0.1]])
    edge = Formula("sqrt(0.5 - x1)", [0])
    near = ConstraintSet([edge], x - np.array([0.01, 0, 0]), [1.0, 1.0])
    motion = Motion(near, x - np.array([0.01, 0, 0]))
    assert open_directions(motion, x - np.array([0.0001, 0, 0])).shape == (0, 3)


# -- bodies that do not feel each other -------------------------------------------------------------


def within(reach, between=lambda i, j: True):
    """Forces that push pairs of atoms apart, and are 0 beyond a reach; a trap for all."""

    def force(x, t):
        out = -0.1 * x
        for i in range(len(x)):
            for j in range(i):
                d = x[i] - x[j]
                r = np.sqrt(d @ d)
                if between(i, j) and r < reach:
                    push = (1.0 / r**7 - 1.0 / reach**7) * d / r
                    out[i] += push
                    out[j] -= push
        return out

    return force


FAR_APART = 40.0 * np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, 0, 1]])
ON_SPHERES = np.linalg.qr(RNG.standard_normal((8, 3, 3)))[0][:, 0]
PAIRS_FAR = np.repeat(FAR_APART, 2, axis=0) + np.tile([[0.0, 0, 0], [0, 0.3, 1.0]], (6, 1))


PAIRS = Distance(np.arange(12).reshape(6, 2))
#: Rows, positions and forces of bodies that feel no other, and of those that do, or are one.
APART = {
    "spheres": (
        [Sphere(range(8), [0, 0, 0], 1.0)],
        ON_SPHERES,
        lambda x, t: np.outer(x[:, 0], [0.7, 0, 0]) - [0, 0, 2],
    ),
    "dumbbells": ([PAIRS], PAIRS_FAR, quartic),
    "dumbbells without forces": ([PAIRS], PAIRS_FAR, None),
    "on a fixed atom": ([Distance([[0, 1], [0, 2]]), FixedAtoms([0])], SCATTERED[:3], quartic),
    "oscillators": ([], SCATTERED, lambda x, t: -np.arange(1.0, 13.0)[:, None] * x),
    "triangle and atoms": ([Distance([[0, 1], [1, 2], [0, 2]])], SCATTERED[:5], lambda x, t: np.cos(x)),
}
NOT_APART = {
    "cluster": ([], SCATTERED, repelling),
    "dumbbells that repel": ([PAIRS], SCATTERED, lambda x, t: waves(x) + repelling(x)),
    "gas": ([], FAR_APART, within(3.0)),
    "gas of dumbbells": ([PAIRS], PAIRS_FAR, within(3.0)),
    "one pair": ([], FAR_APART, within(2.5, lambda i, j: {i, j} == {2, 5})),
    "another pair": ([], FAR_APART, within(2.5, lambda i, j: {i, j} == {0, 1})),
    "one body": ([Distance([[0, 1]])], SCATTERED[:2], quartic),
    "tied": ([CenterOfMass(range(12))], SCATTERED, quartic),
}


@pytest.mark.parametrize("name", [*APART, *NOT_APART])
def test_bodies_that_feel_no_other_are_warned_of_once(name):
    rows, x, force = (APART | NOT_APART)[name]
    held = system(rows, x, np.ones(len(x)), force)
    v = thermal_velocities(held, x, 1.0, 3)
    for thermostat in (Isokinetic(1.0, momentum="free"), NoseHooverChain(1.0, 2.0, momentum="free")):
        state = replace(held.initial_state(x, v), step=LOOK_AT - 1)
        state = thermostat.step(held, state, 1e-3)
        with pytest.warns(UserWarning, match=r"feels another.*Use Langevin") if name in APART else nullcontext():
            state = thermostat.step(held, state, 1e-3)
        thermostat.step(held, state, 1e-3)


def test_fluids_in_cells_are_not_warned_of_and_cost_one_evaluation():
    fluid, calls = LennardJones(range(8), 6.0), []
    x = 3.0 * np.stack(np.unravel_index(np.arange(8), (2, 2, 2)), 1).astype(float) + 0.1 * SCATTERED[:8]

    def force(x, t):
        calls.append(t)
        return fluid.force(x)

    held = System(Motion(ConstraintSet([], x, np.ones(8), cell=[6.0] * 3), x), force)
    state = replace(held.initial_state(x, thermal_velocities(held, x, 1.0, 3)), step=LOOK_AT)
    thermostat = Isokinetic(1.0, momentum="free")
    state = thermostat.step(held, thermostat.start(held, state), 1e-3)
    assert len(calls) == 3  # at the start, of the step, and with every second atom moved
    thermostat.step(held, state, 1e-3)
    assert len(calls) == 4


def test_covariance_is_the_constrained_one():
    """<v v^T> = kT M_par^+, dense and by definition, with redundant rows."""
    x = METHANE
    held = system([Distance(TEN)], x, [12.0, 1, 1, 1, 1])
    rng = np.random.default_rng(0)
    n, kt = 20_000, 0.7
    drawn = np.array([thermal_velocities(held, x, kt, rng).ravel() for _ in range(n)])
    rows = held.motion.constraint_set.jacobian(x).toarray()
    inverse = np.repeat(1 / held.masses, 3)
    spread = rows * inverse
    expected = kt * (np.diag(inverse) - spread.T @ np.linalg.pinv(rows @ spread.T, rcond=1e-10) @ spread)
    found = drawn.T @ drawn / n
    # Standard error of each element of a covariance matrix.
    error = np.sqrt((np.outer(np.diag(expected), np.diag(expected)) + expected**2) / n) + 1e-15
    assert (np.abs(found - expected) / error).max() <= 4.5
    kinetic = 0.5 * (held.masses.repeat(3) * drawn**2).sum(axis=1)
    g = 15 - 9
    assert kinetic.mean() == pytest.approx(0.5 * g * kt, abs=4 * kt * math.sqrt(g / 2 / n))
    assert kinetic.var() == pytest.approx(0.5 * g * kt**2, rel=0.06)
    assert np.abs(rows @ drawn.T).max() <= 1e-12


def test_momentum_is_taken_out_along_open_directions_only():
    x = np.random.default_rng(0).standard_normal((5, 3)) * [1, 1, 0]
    flat = system([Plane(range(5), [0, 0, 1.0], lambda t: 0.3 * t)], x, np.arange(1.0, 6))
    v = thermal_velocities(flat, x, 1.0, 5, zero_momentum=True)
    np.testing.assert_allclose(flat.masses @ v, [0, 0, 0.3 * 15], atol=1e-14)


def test_fixed_atoms_stay():
    x = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    held = system([FixedAtoms([0]), Distance([[0, 1]])], x, [1.0, 3.0])
    v = thermal_velocities(held, x, 1.0, 5)
    assert (v[0] == 0).all() and v[1, 0] == 0 and np.abs(v[1, 1:]).min() > 0
    with pytest.raises(UnsupportedError, match="hold atoms in space in every direction"):
        thermal_velocities(held, x, 1.0, 5, zero_momentum=True)
    still = system([FixedAtoms([0, 1])], x, [1.0, 3.0])
    assert (thermal_velocities(still, x, 1.0, 5) == 0).all()
