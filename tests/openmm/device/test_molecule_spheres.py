"""Isokinetic spheres of molecules on the device, beside those on arrays."""

import numpy as np
import openmm
import pytest
from device_systems import dumbbells, waters
from openmm_systems import context_of, field, forces_at, masses_of, rows_of, started, state_of

from kcons import ConstraintSet, Motion, System, run
from kcons.constraints import Distance
from kcons.errors import ConvergenceError, InputError, UnsupportedError
from kcons.openmm import IsokineticSpheres, ProjectedIntegrator
from kcons.openmm.device import build
from kcons.openmm.device.clusters import Shape
from kcons.openmm.quantities import GAS_CONSTANT
from kcons.steppers import State
from kcons.thermostats import IsokineticSpheres as OnArrays

pytestmark = pytest.mark.skipif(bool(build.refusal()), reason=build.refusal())
#: Next to none: the noise of both is another.
NO_BATH = 1e-18


def system_of():
    """Waters, a free atom and a dumbbell in a field, and the constraints as kcons has them."""
    system, x, v = waters()
    system.removeForce(0)
    for mass in (40.0, 14.0, 14.0):
        system.addParticle(mass)
    n = system.getNumParticles()
    system.addConstraint(n - 2, n - 1, 0.125)
    x = np.vstack([x, [[0.9, 0.8, 0.7], [0.9, 0.2, 0.1], [0.9, 0.325, 0.1]]])
    v = np.vstack([v, [[0.2, -0.3, 0.1], [0.4, 0.1, -0.2], [-0.3, 0.1, 0.3]]])
    system.addForce(field("400*(x*x+1.2*y*y+0.8*z*z)+60*sin(20*x)*cos(17*y+11*z)", n))
    return system, x, v, Motion(ConstraintSet(Distance(*rows_of(system)), x, masses_of(system)), x)


def forces(system):
    context = context_of(system, openmm.VerletIntegrator(0.001))

    def force(x, t):
        context.setPositions(x.reshape(-1, 3))
        return forces_at(context)

    return force


def in_order(auxiliary_variables, integrator, layout, auxiliary):
    """The auxiliary variables of the device in the order of the array version, sphere by sphere.

    On the device they come by kinds of clusters, the spheres of a cluster one after another; single atoms are last.
    """
    held = np.concatenate([shape.atoms.ravel() for shape in integrator.rows.shapes])
    shapes = [*integrator.rows.shapes, Shape(np.setdiff1d(np.arange(27), held)[:, None])]
    found, at = np.zeros(auxiliary_variables.size), 0
    for shape in shapes:
        for atoms in shape.atoms:
            spheres = layout.spheres[layout.cluster[atoms[0]]]
            for sphere in dict.fromkeys(spheres[spheres >= 0].tolist()):
                here = slice(sphere * auxiliary, (sphere + 1) * auxiliary)
                found[here] = auxiliary_variables[at : at + auxiliary]
                at += auxiliary
    assert at == found.size
    return found


@pytest.mark.parametrize(("kind", "auxiliary"), [("split", 0), ("split", 2), ("axes", 1), ("axes", 4), ("cluster", 1)])
def test_trajectories_are_those_on_arrays(kind, auxiliary):
    system, x, v, motion = system_of()
    made = {"spheres": kind, "auxiliary": auxiliary}
    integrator = ProjectedIntegrator(
        0.002, ensemble=IsokineticSpheres(300.0, NO_BATH, **made), device=True, tolerance=1e-13
    )
    context = started(system, integrator, x, v)
    integrator.step(1)
    here = integrator.read("auxiliary")
    x1, v1 = state_of(context)
    integrator.step(20)
    bath = OnArrays(GAS_CONSTANT * 300.0, NO_BATH, 1, **made)
    whole = System(motion, forces(system))
    start = run(whole, whole.initial_state(x1, v1), 1e-12, 1, stepper=bath)
    layout = bath.layout(whole, x1)
    known = start.thermostat.copy()
    here = here[: layout.freedom.size * auxiliary]  # there is one number where there is none
    known[1 : 1 + here.size] = in_order(here, integrator, layout, auxiliary)
    begun = State(x1, v1, 0.0, start.forces, 1, thermostat=known)
    end = run(whole, begun, 0.002, 20, stepper=bath)
    assert np.abs(state_of(context)[0] - end.positions).max() < 1e-8
    assert np.abs(state_of(context)[1] - end.velocities).max() < 1e-5
    assert np.abs(end.positions - x1).max() > 0.005


def test_configurations_are_canonical_at_long_steps():
    """Of dumbbells in a harmonic field, with fast and slow forces apart and a bath."""
    n, stiffness = 200, 800.0
    fields = [field(f"{share * stiffness}*(x*x+y*y+z*z)", 2 * n, group=k) for k, share in enumerate((0.2, 0.8))]
    system, x = dumbbells(n, (12.0, 12.0), *fields)
    for kind, auxiliary in (("split", 1), ("axes", 4), ("cluster", 2)):
        bath = IsokineticSpheres(300.0, 10.0, {0: 1, 1: 2}, spheres=kind, auxiliary=auxiliary)
        integrator = ProjectedIntegrator(0.006, ensemble=bath, device=True)
        context = started(system, integrator, x, platform="CPU")
        integrator.setVelocitiesToTemperature(context, 300.0, 3)
        integrator.step(150)
        found, kinetic = [], []
        for _ in range(75):
            integrator.step(10)
            now = state_of(context)[0]
            kinetic.append(integrator.computeSystemTemperature()._value)
            found.append(4 * stiffness * np.square((now[::2] + now[1::2]) / 2).sum() / (3 * n * GAS_CONSTANT))
        assert [np.mean(found), np.mean(kinetic)] == pytest.approx([300.0, 300.0], abs=8.0)


def test_a_failure_puts_auxiliary_variables_back():
    system, x, v, _ = system_of()
    bath = IsokineticSpheres(300.0, 1.0, spheres="split", auxiliary=2)
    context = started(system, integrator := ProjectedIntegrator(0.002, ensemble=bath, device=True), x, v)
    integrator.step(5)
    integrator.check()
    before = [*state_of(context), integrator.read("auxiliary")]
    integrator.setStepSize(0.5 * openmm.unit.picosecond)
    with pytest.raises(ConvergenceError, match="The Context is back at step 5"):
        integrator.step(20)
    for now, then in zip([*state_of(context), integrator.read("auxiliary")], before, strict=True):
        np.testing.assert_array_equal(now, then)


def test_what_is_refused():
    system, x, v, _ = system_of()
    bath = IsokineticSpheres(300.0, 1.0, spheres="axes", auxiliary=0)
    context = started(system, integrator := ProjectedIntegrator(0.001, ensemble=bath, device=True), x, v)
    with pytest.raises(InputError, match="radius 0"):
        integrator.step(1)
    del context
    with pytest.raises(UnsupportedError, match="scheme of its own"):
        ProjectedIntegrator(0.001, "suzuki4", ensemble=IsokineticSpheres(300.0, 1.0), device=True)
