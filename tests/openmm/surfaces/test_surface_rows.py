"""Surfaces: landings in closed form, compiled and by formula; what is checked, put right and refused."""

from __future__ import annotations

import copy
from threading import Thread

import numpy as np
import openmm
import pytest
from openmm import unit
from openmm_systems import context_of
from surface_cases import (
    FORMULA,
    KINDS,
    POSITIONS,
    QUADRICS,
    VELOCITIES,
    on_surface,
    started,
    state_of,
    system_of,
    worst,
)

from kcons.constraints import Sphere
from kcons.errors import ConvergenceError, InputError, UnsupportedError
from kcons.openmm import (
    ExpressionSurface,
    Isokinetic,
    Langevin,
    NoseHooverMiddle,
    ProjectedIntegrator,
    SurfaceIntegrator,
    surface_parts,
)


@pytest.mark.parametrize("kind", QUADRICS)
@pytest.mark.parametrize("scheme", ["rattle", "suzuki4"])
def test_compiled_landing_is_the_same(kind, scheme):
    pair = [on_surface(kind, scheme, 0.02, atoms=(2, 0), compiled=compiled) for compiled in (False, True)]
    for integrator, _ in pair:
        integrator.step(50)
    (x, v), (x2, v2) = (state_of(context) for _, context in pair)
    assert np.abs(x - x2).max() <= 1e-13
    assert np.abs(v - v2).max() <= 1e-13
    assert max(worst(*pair[1])) <= 1e-14


@pytest.mark.parametrize("kind", [ProjectedIntegrator, SurfaceIntegrator])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"ensemble": Langevin(300, 0.0)},
        {"ensemble": Isokinetic(300, momentum="free")},
        {"ensemble": NoseHooverMiddle(300, 5.0)},
    ],
    ids=repr,
)
def test_parts_that_are_compiled_go_where_the_others_go(kind, options):
    """In any integrator and ensemble, also after an integrator whose drifts follow great circles."""
    ends = []
    for compiled in (False, True):
        system = system_of()
        spheres = [Sphere([k], [0.0, 0.0, 0.0], float(np.linalg.norm(POSITIONS[k]))) for k in (0, 2)]
        parts = surface_parts(spheres, system=system, compiled=compiled)
        if compiled:
            SurfaceIntegrator(0.01, "geodesic", parts=parts)
        context = context_of(system, integrator := kind(0.01, parts=parts, **options), "Reference")
        context.setPositions(POSITIONS)
        context.setVelocities(VELOCITIES)
        integrator.applyVelocityConstraints(context)
        integrator.step(20)
        integrator.check()
        ends.append(state_of(context))
    assert np.abs(np.array(ends[1]) - ends[0]).max() <= 1e-13


def test_a_step_without_landing_is_told_by_openmm_s_own_arithmetic_too():
    system = system_of()
    parts = surface_parts(Sphere([0], [0, 0, 0], float(np.linalg.norm(POSITIONS[0]))), system=system, compiled=True)
    integrator = SurfaceIntegrator(1.0 * unit.picosecond, parts=parts, ensemble=Langevin(300, 0.0))
    context = context_of(system, integrator, "Reference")
    context.setPositions(POSITIONS)
    context.setVelocities(100 * VELOCITIES)
    with pytest.raises(ConvergenceError, match=r"step 1: .*Sphere\(0\)"):
        integrator.step(1)


def test_copies_of_a_system_make_steps_in_threads():
    """Each drift begins where the particles of its own Context are."""
    n = 20
    system = openmm.System()
    for _ in range(n):
        system.addParticle(10.0)
    parts = surface_parts(Sphere(np.arange(n), [0, 0, 0], 1.0), system=system, compiled=True)
    ends = {}

    def go(seed, name):
        integrator = SurfaceIntegrator(2e-3, parts=copy.deepcopy(parts), check_every=0)
        context = context_of(copy.deepcopy(system), integrator)
        x, v = np.random.default_rng(seed).normal(size=(2, n, 3))
        context.setPositions(x / np.linalg.norm(x, axis=1)[:, None])
        context.setVelocities(v)
        integrator.applyVelocityConstraints(context)
        integrator.step(1000)
        ends[name] = np.asarray(context.getState(positions=True).getPositions(asNumpy=True)._value)

    for seed in (0, 1):
        go(seed, f"{seed} alone")
    threads = [Thread(target=go, args=(seed, seed)) for seed in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for seed in (0, 1):
        np.testing.assert_array_equal(ends[seed], ends[f"{seed} alone"])


def test_formula_with_intermediate_values_and_parameters():
    x = np.array([[0.8164965809277261, 0, 0], [0, 1.0, 0], [0, 0, 3.0]])
    system = system_of()
    integrator = SurfaceIntegrator(
        0.01, surfaces=[ExpressionSurface([0, 1], FORMULA), ExpressionSurface(2, "z-a", {"a": 3.0})], system=system
    )
    context = started(system, integrator, x, [[0, 1, 0], [1, 0, 0], [1, 1, 0]])
    integrator.step(100)
    there, _ = state_of(context)
    X, Y, Z = there[:2].T
    assert np.abs(1.5 * X**2 + Y**2 + 2 * Z**2 + 0.3 * X * Y * Z - 1).max() <= 1e-14
    assert there[2, 2] == pytest.approx(3.0, abs=1e-14)


def test_refused_parameters_of_a_formula():
    for values in ([1.0, 2.0], np.nan):
        with pytest.raises(InputError, match="one finite number"):
            ExpressionSurface([0], "x-a", {"a": values})


def test_leaves_room_for_the_groups_of_the_user():
    system = system_of()
    system.getForce(0).setForceGroup(31)
    integrator = SurfaceIntegrator(0.001, surfaces=ExpressionSurface([0], "x"), system=system)
    assert integrator.row_groups == {29, 30}
    assert integrator.getIntegrationForceGroups() & 0xFFFFFFFF == 0xFFFFFFFF ^ (1 << 30 | 1 << 29)


def bonded(system):
    system.addConstraint(1, 0, 1.0)


def barostat(system):
    forces = openmm.NonbondedForce()
    for _ in range(3):
        forces.addParticle(0, 0.1, 0)
    forces.setNonbondedMethod(forces.CutoffPeriodic)
    forces.setCutoffDistance(0.9)
    system.addForce(forces)
    system.addForce(openmm.MonteCarloBarostat(1.0, 300.0))


def center_remover(system):
    system.addForce(openmm.CMMotionRemover())


def massless(system):
    system.setParticleMass(0, 0.0)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (bonded, r"particle 0 is on a surface and in the System's constraint \(1, 0\)"),
        (barostat, "MonteCarloBarostat"),
        (center_remover, "CMMotionRemover"),
        (massless, "particle 0 has no mass"),
    ],
)
def test_systems_that_surfaces_do_not_go_with(spoil, words):
    surface = Sphere([0], [0, 0, 0], np.linalg.norm(POSITIONS[0]))
    system = system_of()
    spoil(system)
    with pytest.raises(UnsupportedError, match=words):
        SurfaceIntegrator(0.001, surfaces=surface, system=system)
    # Also where the System was not given.
    integrator = SurfaceIntegrator(0.001, surfaces=surface, n_particles=3)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions(POSITIONS)
    with pytest.raises(UnsupportedError, match=words):
        integrator.surfaces[0].check(context)


@pytest.mark.parametrize("kind", KINDS)
def test_positions_and_velocities_are_checked_and_can_be_put_right(kind):
    integrator, context = on_surface(kind, "rattle", 0.01)
    integrator.check(context)
    context.setPositions(POSITIONS + np.array([[0, 0, 0], [0.05, 0.02, -0.03], [0, 0, 0]]))
    with pytest.raises(InputError, match=r"particle 1 is .* nm from its surface") as caught:
        integrator.check(context)
    assert caught.value.atoms == (1,)
    integrator.applyConstraints(context)
    context.setVelocities(VELOCITIES)
    assert worst(integrator, context)[0] <= 1e-13
    with pytest.raises(InputError, match="across its surface"):
        integrator.check(context)
    integrator.applyVelocityConstraints(context)
    integrator.check(context)
    assert worst(integrator, context)[1] <= 1e-14
    integrator.step(3)
