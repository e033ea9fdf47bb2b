"""Surfaces: expressions of rows; what is checked, put right and refused."""

from __future__ import annotations

import numpy as np
import openmm
import pytest
from openmm import unit
from openmm_systems import context_of
from surface_cases import (
    FORMULA,
    KINDS,
    POSITIONS,
    VELOCITIES,
    on_surface,
    started,
    state_of,
    system_of,
    worst,
)

from kcons.constraints import Formula, Sphere, Torus
from kcons.errors import ConvergenceError, InputError, UnsupportedError
from kcons.openmm import (
    Isokinetic,
    Langevin,
    NoseHooverMiddle,
    ProjectedIntegrator,
    SurfaceIntegrator,
    surface_parts,
)


@pytest.mark.parametrize("kind", [ProjectedIntegrator, SurfaceIntegrator])
@pytest.mark.parametrize(
    "options",
    [
        {"ensemble": Langevin(300, 0.0)},
        {"ensemble": Isokinetic(300, momentum="free")},
        {"ensemble": NoseHooverMiddle(300, 5.0)},
    ],
    ids=repr,
)
def test_surfaces_are_held_in_every_ensemble(kind, options):
    system = system_of()
    spheres = [Sphere([k], [0.0, 0.0, 0.0], float(np.linalg.norm(POSITIONS[k]))) for k in (0, 2)]
    parts = surface_parts(spheres, system=system)
    context = context_of(system, integrator := kind(0.01, parts=parts, device=False, **options), "Reference")
    context.setPositions(POSITIONS)
    context.setVelocities(VELOCITIES)
    integrator.applyVelocityConstraints(context)
    integrator.step(20)
    integrator.check()
    x, v = state_of(context)
    for k in (0, 2):
        assert np.linalg.norm(x[k]) == pytest.approx(np.linalg.norm(POSITIONS[k]), abs=1e-14)
        assert abs(x[k] @ v[k]) <= 1e-13


def test_a_step_without_landing_is_told_in_every_ensemble():
    system = system_of()
    parts = surface_parts(Sphere([0], [0, 0, 0], float(np.linalg.norm(POSITIONS[0]))), system=system)
    integrator = SurfaceIntegrator(1.0 * unit.picosecond, parts=parts, ensemble=Langevin(300, 0.0), device=False)
    context = context_of(system, integrator, "Reference")
    context.setPositions(POSITIONS)
    context.setVelocities(100 * VELOCITIES)
    with pytest.raises(ConvergenceError, match=r"step 1: .*Sphere\(0\)"):
        integrator.step(1)


def test_a_landing_where_the_surface_looks_the_other_way_is_none():
    """From the inner equator of a torus to the one across."""
    system = system_of([1.0], "320*x", 0)
    torus = Torus([0], [0, 0, 0], [0, 0, 1], 1.0, 0.2)
    integrator = SurfaceIntegrator(0.1 * unit.picosecond, surfaces=torus, system=system, device=False)
    context = started(system, integrator, [[0.8, 0, 0]], [[0, 0, 0]])
    integrator.check(context)
    with pytest.raises(ConvergenceError, match="finds no position"):
        integrator.step(1)


def test_formulas_with_parameters():
    x = np.array([[0.8164965809277261, 0, 0], [0, 1.0, 0], [0, 0, 3.0]])
    system = system_of()
    surfaces = [Formula(FORMULA, [0, 1], {"b": 1.5}, target=1.0), Formula("z1-a", 2, {"a": 3.0})]
    integrator = SurfaceIntegrator(0.01, surfaces=surfaces, system=system, device=False)
    context = started(system, integrator, x, [[0, 1, 0], [1, 0, 0], [1, 1, 0]])
    integrator.step(100)
    there, _ = state_of(context)
    X, Y, Z = there[:2].T
    assert np.abs(1.5 * X**2 + Y**2 + 2 * Z**2 + 0.3 * X * Y * Z - 1).max() <= 1e-14
    assert there[2, 2] == pytest.approx(3.0, abs=1e-14)


@pytest.mark.parametrize(
    "formula",
    [
        "x1**2 - 3*y1/z1 + pi*z1**-2 - (x1*y1)**0.5",
        "sin(x1)*cos(y1) + atan2(z1, x1) + asin(0.1*x1) + acos(0.1*y1) + atan(z1) + tan(0.2*x1)",
        "-exp(-x1)**2 + log(y1) + abs(z1 - 5) + sinh(x1) + cosh(y1) + tanh(z1) + 1e-3*x1**3.5",
    ],
)
def test_formulas_are_read_by_openmm(formula):
    """Value and gradient, where powers, signs and functions of both agree."""
    item = Formula(formula, [0], target=0.25)
    r = np.array([[0.7, 1.3, 2.1]])
    system = system_of([1.0], "0", 0)
    (part,) = surface_parts(item, system=system)
    context = context_of(system, openmm.VerletIntegrator(1e-3), "Reference")
    context.setPositions(r)
    one, two = (context.getState(energy=True, forces=True, groups={group}) for group in sorted(part.groups))
    value, slope = item.measure(r[None], 0.0)[0] - 0.25, item.gradient(r[None], 0.0)[0, 0]
    assert one.getPotentialEnergy()._value == pytest.approx(value, rel=1e-13)
    assert two.getPotentialEnergy()._value == pytest.approx(0.5 * value**2, rel=1e-13)
    np.testing.assert_allclose(one.getForces(asNumpy=True)._value[0], -slope, rtol=1e-13)
    np.testing.assert_allclose(two.getForces(asNumpy=True)._value[0], -value * slope, rtol=1e-13)


def test_what_is_no_expression_is_refused():
    class Winds(Sphere):
        @staticmethod
        def row(r, p, t, out):
            Sphere.row(r, p, t, out)
            out[0] = np.rint(out[0])

    with pytest.raises(UnsupportedError, match="'rint' in it"):
        surface_parts(Winds([0], [0, 0, 0], 1.0), system=system_of())


def test_leaves_room_for_the_groups_of_the_user():
    system = system_of()
    system.getForce(0).setForceGroup(31)
    integrator = SurfaceIntegrator(0.001, surfaces=Formula("x1", [0]), system=system, device=False)
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
        SurfaceIntegrator(0.001, surfaces=surface, system=system, device=False)
    # Also where that was done later.
    system = system_of()
    integrator = SurfaceIntegrator(0.001, surfaces=surface, system=system, device=False)
    spoil(system)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions(POSITIONS)
    with pytest.raises(UnsupportedError, match=words):
        integrator.parts[0].check(context)


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
