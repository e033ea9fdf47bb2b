"""Stochastic isokinetic baths: moves on spheres, what stays, order, limits, starts, refusals."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from thermostat_systems import (
    METHANE,
    TEN,
    TWO,
    dumbbells,
    grouped,
    molecules,
    quartic,
    quartic_potential,
    springs,
    system,
    waves,
)

from kcons.constraints import CenterOfMass, Distance, FixedAtoms, LinearRelation, Plane, Sphere
from kcons.errors import InputError
from kcons.steppers import State, System, run
from kcons.thermostats import (
    HamiltonianMonteCarlo,
    Isokinetic,
    IsokineticSpheres,
    Langevin,
    NoseHooverChain,
    thermal_velocities,
)
from kcons.thermostats import sphere_kernels as kernels
from kcons.thermostats.spheres import SphereLayout

KT, L = 0.5, 2
FORCES = {"fast": springs, "slow": lambda x, t: 0.3 * waves(x)}


def made(kind):
    """Molecules of three atoms and two ions: tables, squares, and tangent velocities and accelerations."""
    held, state = molecules("bent", 3, ions=2)
    layout = SphereLayout.of(held, state.positions, kind)
    tables = layout.cluster, layout.spheres, layout.masses, layout.totals
    rng = np.random.default_rng(5)
    draw = lambda size: held.motion.project_velocities(state.positions, size * rng.normal(size=(11, 3)))  # noqa: E731
    squares = layout.squares(KT, L)
    v, w = draw(1.0), rng.normal(size=(len(squares), L))
    kernels.rescale(v, w, squares, True, *tables)
    return held, state, tables, squares, v, w, draw


def parts(v, tables):
    """Mass-weighted velocities of each sphere, one after another: written out, one cluster at a time."""
    cluster, spheres, masses, totals = tables
    found = {}
    for c in range(len(totals)):
        mine = np.flatnonzero(cluster == c)
        middle = np.zeros(3)
        if spheres[c, 0] >= 0:
            middle = masses[mine] @ v[mine] / totals[c]
            for k in range(3):
                found.setdefault(spheres[c, k], []).append(np.sqrt(totals[c]) * middle[[k]])
        if spheres[c, 3] >= 0:
            found.setdefault(spheres[c, 3], []).append((np.sqrt(masses[mine])[:, None] * (v[mine] - middle)).ravel())
    return [np.concatenate(found[s]) for s in sorted(found)]


KINDS = ["split", "axes", "cluster", "global"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("strength", [0.0, 1e-9, 1.0, 25.0])
def test_the_kick_solves_its_equation(kind, strength):
    """y' = (1 - y y^T/R^2)(F, 0) on each sphere."""
    _, _, tables, squares, v, w, draw = made(kind)
    a, t = draw(strength), 0.3
    wanted = []
    for u, f, own, square in zip(parts(v, tables), parts(a, tables), w, squares, strict=True):
        push = np.append(f, np.zeros(L))
        slope = lambda _, y, p=push, r=square: p - y * (y @ p) / r  # noqa: E731
        wanted.append(solve_ivp(slope, (0, t), np.append(u, own), method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1])
    kernels.turn(v, w, a, t, squares, *tables)
    for u, own, y in zip(parts(v, tables), w, wanted, strict=True):
        np.testing.assert_allclose(np.append(u, own), y, rtol=0, atol=1e-11)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("strength", [1e4, 1e150])
def test_forces_of_any_strength(strength, sign):
    """Velocities end along the force, with all that their sphere has; with a negative time, against it."""
    _, _, tables, squares, v, w, draw = made("split")
    a = draw(strength)
    kernels.turn(v, w, a, sign, squares, *tables)
    for u, f, square in zip(parts(v, tables), parts(a, tables), squares, strict=True):
        np.testing.assert_allclose(u, sign * f / np.linalg.norm(f) * np.sqrt(square), rtol=1e-10, atol=1e-10)
    assert np.abs(w).max() <= 1e-10


def test_from_rest_and_exactly_against_the_force():
    _, _, tables, squares, v, w, draw = made("cluster")
    a = draw(1.0)
    v[...], w[...] = -1e3 * a, 0.0
    kernels.turn(v, w, a, 50.0, squares, *tables)
    np.testing.assert_allclose([u @ u for u in parts(v, tables)], squares, rtol=1e-13)
    v[...], w[...] = 0.0, 1.0
    kernels.turn(v, w, a, 0.5, squares, *tables)
    for u, f in zip(parts(v, tables), parts(a, tables), strict=True):
        assert u @ f == pytest.approx(np.linalg.norm(u) * np.linalg.norm(f), rel=1e-12) and u @ f > 0


def test_the_bath_leaves_the_uniform_distribution():
    """On the sphere of one free atom: y stays uniform, and forgets at the rate asked for."""
    n = 30_000
    cluster, spheres = np.arange(n), np.full((n, 4), -1)
    spheres[:, :3] = np.arange(n)[:, None]
    tables = cluster, spheres, np.ones(n), np.ones(n)
    rng, squares = np.random.default_rng(2), np.full(n, 3.0)
    v, w = rng.normal(size=(n, 3)), rng.normal(size=(n, 1))
    kernels.rescale(v, w, squares, True, *tables)
    for _ in range(3):
        kernels.stir(v, w, rng.normal(size=(n, 3)), rng.normal(size=(n, 1)), 0.6, 0.8, squares, *tables)
    y = np.concatenate([v, w], axis=1) / np.sqrt(3)
    np.testing.assert_allclose((y**2).mean(axis=0), 1 / 4, rtol=0, atol=4.5 * np.sqrt((1 / 8 - 1 / 16) / n))
    np.testing.assert_allclose((y**4).mean(axis=0), 1 / 8, rtol=0, atol=4.5 * 0.15 / np.sqrt(n))
    np.testing.assert_allclose(y.mean(axis=0), 0, atol=4.5 * 0.5 / np.sqrt(n))


@pytest.mark.parametrize("kind", KINDS)
def test_velocities_stay_on_their_spheres(kind):
    held, state = molecules("triangles", 4, ions=1)
    split = grouped(held.motion, **FORCES)
    stepper = IsokineticSpheres(0.5, 1.0, 3, steps=TWO, spheres=kind, auxiliary=2)
    end = run(split, state, 0.2, 25, stepper=stepper)
    layout = stepper.layout(split, end.positions)
    own = end.thermostat[1 : 1 + 2 * len(layout.freedom)].reshape(-1, 2)
    tables = layout.cluster, layout.spheres, layout.masses, layout.totals
    has = [u @ u + w @ w for u, w in zip(parts(end.velocities, tables), own, strict=True)]
    np.testing.assert_allclose(has, layout.squares(0.5, 2), rtol=1e-13)


def test_many_auxiliary_variables_are_langevin_dynamics():
    """Kinetic energy is then that of Maxwell and Boltzmann, and no energy is bounded."""
    held, x = dumbbells(40, force=None)
    state = State(x, thermal_velocities(held, x, 0.5, 4))
    values = {}
    for auxiliary in (1, 400):
        stepper = IsokineticSpheres(0.5, 3.0, 3, spheres="cluster", auxiliary=auxiliary)
        kinetic = []
        see = lambda s, k=kinetic: k.append(held.kinetic_energy(s.velocities))  # noqa: E731
        run(held, state, 0.3, 60, stepper=stepper, observers=[see])
        values[auxiliary] = np.mean(kinetic[10:])
        assert values[auxiliary] == pytest.approx(stepper.kinetic_energy(held, x), rel=0.03)
    assert values[400] == pytest.approx(0.5 * 0.5 * 5 * 40, rel=0.03)
    assert values[1] == pytest.approx(values[400] * 5 / 6, rel=0.03)


def test_noise_is_a_function_of_seed_step_and_part():
    held, state = molecules("bent", 2)
    split = grouped(held.motion, **FORCES)
    ends = [run(split, state, 0.1, 5, stepper=IsokineticSpheres(0.5, 2.0, seed, steps=TWO)) for seed in (3, 3, 4)]
    assert np.array_equal(ends[0].positions, ends[1].positions)
    assert np.abs(ends[0].positions - ends[2].positions).max() > 1e-3
    by_engine = grouped(held.motion, **FORCES)
    by_engine.packed = None  # where Python draws it
    other = run(by_engine, state, 0.1, 5, stepper=IsokineticSpheres(0.5, 2.0, 3, steps=TWO))
    np.testing.assert_allclose(other.positions, ends[0].positions, rtol=0, atol=1e-13)
    np.testing.assert_allclose(other.thermostat, ends[0].thermostat, rtol=0, atol=1e-12)


def test_it_says_once_that_dynamics_are_lost(caplog):
    held, state = molecules("bent", 2)
    stepper = IsokineticSpheres(0.5, 2.0, 3)
    with caplog.at_level(logging.WARNING, logger="kcons.thermostats"):
        run(held, state, 0.05, 3, stepper=stepper)
    assert [record.message for record in caplog.records if "transport" in record.message] == [
        "isokinetic spheres sample configurations only: no transport, relaxation times or spectra"
    ]


@pytest.mark.parametrize(
    ("atoms", "auxiliary", "other"),
    [
        (3, 0, Langevin(1.0, 1.0, 3)),
        (3, 1, Isokinetic(1.0)),
        (2, 1, NoseHooverChain(1.0, 5.0, length=1)),
        (3, 3, HamiltonianMonteCarlo(1.0, 2, 3)),
    ],
    ids=lambda value: type(value).__name__ if not isinstance(value, int) else str(value),
)
def test_as_many_variables_of_another_thermostat(atoms, auxiliary, other):
    x = np.random.default_rng(1).normal(size=(atoms, 3))
    held = System(system([], x, np.ones(atoms)).motion, quartic, potential=quartic_potential)
    spheres = IsokineticSpheres(0.5, 1.0, 3, spheres="cluster", auxiliary=auxiliary)
    state = spheres.step(held, State(x, x), 0.01)
    with pytest.raises(InputError, match="variables of another thermostat"):
        other.step(held, state, 0.01)
    state = other.step(held, State(x, x), 0.01)
    assert state.thermostat.shape == (1 + atoms * auxiliary,)
    with pytest.raises(InputError, match="variables of another thermostat, not of IsokineticSpheres"):
        spheres.step(held, state, 0.01)


# -- which velocities share a sphere -----------------------------------------------------------------

X = np.array([[0.0, 0, 0], [1.0, 0, 0], [3.0, 0, 0], [3.0, 1.2, 0], [6.0, 0.5, 0.2]])
MASSES = np.array([1.0, 2.0, 3.0, 4.0, 5.0])


BONDS = Distance([[0, 1], [2, 3]])


@pytest.mark.parametrize(
    ("rows", "kind", "wanted"),
    [
        ([BONDS], "split", [3, 2, 3, 2, 3]),
        ([BONDS], "axes", [1, 1, 1, 2] * 2 + [1, 1, 1]),
        ([BONDS], "cluster", [5, 5, 3]),
        ([BONDS], "global", [13]),
        ([Plane([0], [0, 0, 1.0]), Distance([[0, 1]])], "split", [4, 3, 3, 3]),
        ([Sphere([2], [3.0, 0, 1.0], 1.0)], "axes", [2] + [1] * 12),
        ([FixedAtoms([0]), BONDS], "split", [2, 3, 2, 3]),
        ([BONDS, CenterOfMass([0, 1, 2, 3])], "split", [3 * 4 - 2 - 3, 3]),
        ([Distance([[0, 1], [2, 3], [1, 2]])], "split", [3, 6, 3]),
        ([LinearRelation(0, [1], [1.0], None)], "split", [3, 3, 3, 3]),  # held whole about its center
    ],
    ids=["split", "axes", "cluster", "global", "plane", "sphere", "fixed", "joined", "one chain", "center only"],
)
def test_degrees_of_freedom_by_sphere(rows, kind, wanted):
    """A cluster that is tied to space has one sphere; fixed atoms have none, and tie."""
    held = system(rows, X, MASSES)
    layout = SphereLayout.of(held, X, kind)
    assert layout.freedom.tolist() == wanted
    np.testing.assert_allclose(layout.squares(0.5, 2), 0.5 * (np.array(wanted) + 1))
    fixed = held.motion.fixed_atoms
    assert np.flatnonzero(layout.cluster < 0).tolist() == fixed.tolist() and not layout.masses[fixed].any()


def test_dependent_rows_count_by_rank():
    """Ten distances of five atoms hold nine; beside an independent cluster and few constrained atoms among many."""
    x = np.vstack([METHANE, METHANE[:3] + 4.0, 9.0 + np.arange(60.0).reshape(20, 3)])
    rows = np.array([*TEN, (5, 6), (6, 7)])
    held = system([Distance(rows)], x, np.ones(len(x)))
    layout = SphereLayout.of(held, x, "cluster")
    assert sorted(layout.freedom.tolist()) == [3] * 20 + [6, 7]
