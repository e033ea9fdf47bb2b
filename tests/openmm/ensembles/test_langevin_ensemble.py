"""Langevin dynamics on the constraints in OpenMM, with one time step and with several."""

import numpy as np
import openmm
import pytest
from ensemble_runs import run
from openmm import unit
from openmm_parts import HeldCoordinates
from openmm_systems import (
    DEVICE,
    GPUS,
    PLATFORMS,
    alanine,
    context_of,
    field,
    masses_of,
    particles,
    rows_of,
    started,
    state_of,
    water_box,
)

from kcons import ConstraintSet, Motion, State, System
from kcons import run as steps_of
from kcons.constraints import Distance
from kcons.errors import InputError, UnsupportedError
from kcons.openmm import IsokineticSpheres, Langevin, LangevinRespa, ProjectedIntegrator
from kcons.openmm.quantities import forces_at
from kcons.thermostats import ForceGroups
from kcons.thermostats import LangevinRespa as CoreRespa

pytestmark = pytest.mark.filterwarnings("ignore:the forces exert no torque")


# -- Langevin ------------------------------------------------------------------------------------------


def test_langevin_without_friction_is_the_drift_in_two_halves():
    """Order 2, and no noise."""
    system, x, v = alanine()
    exact = state_of(run(system, ProjectedIntegrator(2.5e-4, "blanes-moan6", tolerance=1e-13), x, v, 64))[0]
    errors = []
    for n in (16, 32, 64):
        integrator = ProjectedIntegrator(0.016 / n, tolerance=1e-13, ensemble=Langevin(300.0, 0.0))
        errors.append(np.abs(state_of(run(system, integrator, x, v, n))[0] - exact).max())
    assert np.polyfit(np.log([4, 2, 1]), np.log(errors), 1)[0] == pytest.approx(2, abs=0.15)


# -- several time steps ---------------------------------------------------------------------------


TWO = {0: 1, 1: 4}
KT = 300 * unit.MOLAR_GAS_CONSTANT_R.value_in_unit(unit.kilojoule_per_mole / unit.kelvin)


def grouped():
    """Alanine dipeptide: bonds held, angles and torsions fast (group 1), the rest slow (group 0)."""
    system, x, v = alanine()
    for force in system.getForces():
        force.setForceGroup(0 if isinstance(force, openmm.NonbondedForce | openmm.CustomNonbondedForce) else 1)
    return system, x, v


def trapped(n=4):
    """Free atoms in a trap with a softer slow force."""
    fast, slow = field("40*(x^2+2*y^2+z^2)", n, group=1), field("10*(cos(3*x)+y^4+z*y)", n)
    system = particles(10.0 + np.arange(n), fast, slow)
    rng = np.random.default_rng(2)
    return system, 0.1 * rng.normal(size=(n, 3)), 0.3 * rng.normal(size=(n, 3))


@pytest.mark.parametrize("slow_kicks", ["ends", "middle"])
@pytest.mark.parametrize("steps", [TWO, {0: 1, 2: 2, 1: 4}], ids=["two groups", "three groups"])
@pytest.mark.usefixtures("without_device")
def test_it_makes_the_steps_of_the_core(steps, slow_kicks):
    """Without friction."""
    system, x, v = grouped()
    if 2 in steps:
        system.getForces()[1].setForceGroup(2)
    probe = context_of(system, openmm.VerletIntegrator(1e-3))

    def of(group):
        def force(x, time):
            probe.setPositions(x)
            return forces_at(probe, {group})

        return force

    rows, masses = Distance(*rows_of(system)), masses_of(system)
    held = System(Motion(ConstraintSet(rows, x, masses), x), ForceGroups({str(g): of(g) for g in steps}))
    named = {str(group): count for group, count in steps.items()}
    core = CoreRespa(KT, 0.0, 3, steps=named, substeps=1, slow_kicks=slow_kicks)
    end = steps_of(held, State(x, held.motion.project_velocities(x, v)), 2e-3, 5, stepper=core)
    integrator = ProjectedIntegrator(2e-3, tolerance=1e-13, ensemble=LangevinRespa(300, 0.0, steps, slow_kicks))
    found = state_of(run(system, integrator, x, v, 5))
    np.testing.assert_allclose(found[0], end.positions, rtol=0, atol=2e-11)
    np.testing.assert_allclose(found[1], end.velocities, rtol=0, atol=1e-8)
    assert "forces of group 1 act" in integrator.listing()


@pytest.mark.parametrize("platform", [*PLATFORMS, *GPUS[-2:-1]])
def test_constraints_are_held_and_a_seed_repeats(platform):
    system, x, v = grouped()
    ends = []
    for _ in range(1 if "OpenCL" in platform else 2):  # where kernels are compiled for each Context
        integrator = ProjectedIntegrator(4e-3, ensemble=LangevinRespa(300, 5.0, TWO))
        integrator.setRandomNumberSeed(5)
        context = run(system, integrator, x, v, 10, platform)
        integrator.check()
        ends.append(state_of(context))
    assert np.abs(ends[0][0] - ends[-1][0]).max() <= 1e-6
    assert np.abs(ends[0][0] - x).max() > 1e-3


GROUPED = {
    "LangevinRespa": {"ensemble": LangevinRespa(300, 1.0, TWO)},
    "spheres": {"ensemble": IsokineticSpheres(300.0, 1.0, TWO), "device": True},
}
grouped_kinds = pytest.mark.parametrize(
    "kind", ["LangevinRespa", pytest.param("spheres", id="spheres, device", marks=DEVICE.marks)]
)


@grouped_kinds
def test_forces_whose_group_has_no_number_of_steps_or_does_not_act_are_refused(kind):
    """Nobody would compute the first; the others acted all the same."""
    system, x, v = trapped()
    integrator = ProjectedIntegrator(1e-3, **GROUPED[kind])
    integrator.setIntegrationForceGroups({1})
    context = started(system, integrator, x, v)
    with pytest.raises(InputError, match="group 0 is left out by setIntegrationForceGroups"):
        integrator.step(1)
    np.testing.assert_array_equal(state_of(context), (x, v))
    system.getForces()[0].setForceGroup(7)
    context = started(system, integrator := ProjectedIntegrator(1e-3, **GROUPED[kind]), x, v)
    with pytest.raises(InputError, match="CustomExternalForce is in force group 7, which has no number of steps"):
        integrator.step(1)


def test_virtual_sites_and_parts_are_refused():
    system, x, v = trapped()
    system.addParticle(0.0)
    system.setVirtualSite(4, openmm.TwoParticleAverageSite(0, 1, 0.5, 0.5))
    for force in system.getForces():
        force.addParticle(3)
    sites = np.vstack([x, 0.5 * (x[0] + x[1])]), np.vstack([v, 0 * v[0]])
    with pytest.raises(UnsupportedError, match="virtual sites"):
        run(system, ProjectedIntegrator(1e-3, ensemble=LangevinRespa(300, 1.0, TWO)), *sites, 1)
    with pytest.raises(UnsupportedError, match="and no parts"):
        ProjectedIntegrator(1e-3, parts=[HeldCoordinates([0], 0, 0.0, 5)], ensemble=LangevinRespa(300, 1.0, TWO))


def test_temperature_and_friction():
    ensemble = LangevinRespa(300, 1.0, TWO, "middle")
    assert ensemble == LangevinRespa(300, 1.0, {1: 4, 0: 1}, "middle") != LangevinRespa(300, 1.0, TWO)
    assert repr(ensemble) == "LangevinRespa(300 K, 1/ps, steps {0: 1, 1: 4}, slow kicks in the middle)"
    integrator = ProjectedIntegrator(2e-3, ensemble=ensemble)
    integrator.setTemperature(310)
    integrator.setFriction(2.0)
    assert integrator.ensemble == LangevinRespa(310, 2.0, TWO, "middle")
    assert isinstance(ensemble, Langevin)


def test_forces_in_reciprocal_space_have_a_number_of_steps_too():
    """Those of a group of their own would be left out."""
    system, x = water_box(8, spacing=0.4)
    force = next(force for force in system.getForces() if isinstance(force, openmm.NonbondedForce))
    force.setNonbondedMethod(openmm.NonbondedForce.PME)
    force.setReciprocalSpaceForceGroup(2)
    integrator = ProjectedIntegrator(1e-3, ensemble=LangevinRespa(300, 1.0, {0: 1, 1: 2}))
    context = started(system, integrator, x)
    with pytest.raises(InputError, match="force group 2"):
        integrator.step(1)
    integrator = ProjectedIntegrator(1e-3, ensemble=LangevinRespa(300, 1.0, {0: 2, 2: 1}))
    context = started(system, integrator, x)
    integrator.step(1)
    assert np.isfinite(context.getState(energy=True).getPotentialEnergy()._value)


@pytest.mark.parametrize(
    ("check_every", "faster", "kind"),
    [
        *((5, 1.0, "LangevinRespa"), (1000, 1e9, "LangevinRespa")),
        pytest.param(5, 1.0, "spheres", id="spheres, device", marks=DEVICE.marks),
    ],
)
def test_a_force_that_gets_another_group_leaves_the_state_that_was_checked(check_every, faster, kind):
    """It would act no more; told at the next check, or where velocities have become infinite before."""
    system, x, v = trapped()
    integrator = ProjectedIntegrator(1e-3, check_every=check_every, **GROUPED[kind])
    context = run(system, integrator, x, v, 5)
    if faster > 1:
        context.setVelocities(faster * v)
    kept = state_of(context)
    context.getSystem().getForces()[0].setForceGroup(7)
    with pytest.raises(InputError, match=r"CustomExternalForce is in force group 7.*back at step"):
        integrator.step(5)
    if faster > 1:
        assert np.abs(state_of(context)[0]).max() < 100
    else:
        np.testing.assert_array_equal(state_of(context), kept)
