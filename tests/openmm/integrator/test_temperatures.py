"""States on constraints: velocities of a temperature, and degrees of freedom by rank."""

import numpy as np
import openmm
import pytest
from openmm_systems import context_of, dumbbell, masses_of, started, state_of, water_box

from kcons.errors import InputError
from kcons.openmm import ProjectedIntegrator


def test_velocities_of_a_temperature_are_tangent():
    system, x = water_box()[:2]
    integrator = ProjectedIntegrator(0.001)
    context = context_of(system, integrator)
    context.setPositions(x)
    integrator.applyConstraints(context)
    integrator.setVelocitiesToTemperature(context, 300 * openmm.unit.kelvin, 5)
    positions, v = state_of(context)
    pairs = np.array([system.getConstraintParameters(k)[:2] for k in range(system.getNumConstraints())])
    d = positions[pairs[:, 0]] - positions[pairs[:, 1]]
    along = np.einsum("ij,ij->i", d, v[pairs[:, 0]] - v[pairs[:, 1]])
    assert np.abs(along).max() < 1e-12
    # 27 molecules of six degrees of freedom: 20 % are three standard deviations.
    warmth = masses_of(system) @ np.sum(v * v, axis=1) / (8.314462618e-3 * integrator.degrees_of_freedom(context))
    assert warmth == pytest.approx(300.0, rel=0.35)
    integrator.setVelocitiesToTemperature(context, 300, 5)
    assert np.array_equal(state_of(context)[1], v)  # the same seed, and kelvins without a unit
    with pytest.raises(InputError, match="temperature"):
        integrator.setVelocitiesToTemperature(context, 300 * openmm.unit.nanometer)
    assert np.array_equal(state_of(context)[1], v)


def test_degrees_of_freedom_are_counted_by_rank():
    """Five particles by all ten distances, nine of them independent: six, and three less with a motion remover."""
    system, x = openmm.System(), 0.1 * np.random.default_rng(1).normal(size=(5, 3))
    for i in range(5):
        system.addParticle(12.0)
        for j in range(i):
            system.addConstraint(i, j, float(np.linalg.norm(x[i] - x[j])))
    integrator = ProjectedIntegrator(0.001)
    context = context_of(system, integrator)
    context.setPositions(x)
    assert integrator.degrees_of_freedom(context) == integrator.independent_momenta(context) == 6
    other = openmm.XmlSerializer.clone(system)
    other.addForce(openmm.CMMotionRemover())
    integrator = ProjectedIntegrator(0.001)
    context = context_of(other, integrator)
    context.setPositions(x)
    assert integrator.degrees_of_freedom(context) == 3 and integrator.independent_momenta(context) == 6


@pytest.mark.parametrize(
    ("call", "given"),
    [
        ("setVelocitiesToTemperature", {"temperature": -5}),
        ("setVelocitiesToTemperature", {"temperature": float("nan")}),
        ("setVelocitiesToTemperature", {"temperature": 300, "rng": 2.7}),
        ("setVelocitiesToTemperature", {"temperature": 300, "rng": 2**31}),
        ("minimizeEnergy", {"tolerance": float("nan")}),
        ("minimizeEnergy", {"tolerance": -1}),
        ("minimizeEnergy", {"maxIterations": 2.5}),
        ("applyConstraints", {"tolerance": -1}),
        ("applyVelocityConstraints", {"tolerance": "small"}),
    ],
)
def test_what_is_no_number_for_it_is_refused(call, given):
    """Velocities of a negative temperature were no numbers."""
    system, x, v = dumbbell()
    integrator = ProjectedIntegrator(1e-3)
    context = started(system, integrator, x, v)
    with pytest.raises(InputError):
        getattr(integrator, call)(context=context, **given)
    np.testing.assert_array_equal(state_of(context), (x, v))
