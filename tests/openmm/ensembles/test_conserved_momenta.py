"""Momenta that a System conserves: found, warned of, or refused."""

import copy
import warnings

import numpy as np
import openmm
import pytest
from collective_cases import bond
from ensemble_runs import run, tied
from openmm_systems import dumbbell, field, image, masses_of, particles, started, with_and_without_device

from kcons.constraints import Ellipsoid, Formula, Plane, Sphere
from kcons.openmm import CollectiveRows, Isokinetic, NoseHoover, NoseHooverMiddle, ProjectedIntegrator, Row, hold

pytestmark = pytest.mark.filterwarnings("ignore:the forces exert no torque")


def test_momenta_that_are_conserved_are_found():
    system, x, v = dumbbell()

    def counted(momentum="auto"):
        bath = Isokinetic(300.0, momentum=momentum)
        context = run(system, integrator := ProjectedIntegrator(1e-4, ensemble=bath), x, v, 1)
        return bath.count(integrator) if context else None

    assert counted() == 5  # the field stands in space
    system.getForce(0).setEnergyFunction("k*max(0,x^2+y^2+z^2-9)^2+c*0")
    assert counted() == 5  # as a wall that is not touched does
    system.getForce(0).setEnergyFunction("k*x^2+c*0")
    with pytest.warns(UserWarning, match="total momentum is not zero"):
        assert counted() == 3  # along y and z nothing acts
    assert counted("free") == 5


def springs(state):
    """Of all pairs, at rest in PLACES, where rounding is left of them."""
    x = state.getPositions(asNumpy=True)._value
    return 0.0, 7.3 * x.mean(axis=0) - 7.3 * x - 7.3 * (np.mean(PLACES, axis=0) - PLACES)


def test_forces_that_are_rounding_where_the_particles_are_break_no_momentum():
    system = particles([20.0] * 4, openmm.PythonForce(springs))
    context = started(system, integrator := ProjectedIntegrator(1e-4, ensemble=(bath := Isokinetic(300.0))), PLACES)
    assert bath.count(integrator) == 9
    del context


@pytest.mark.filterwarnings("ignore:total momentum is not zero")
@with_and_without_device
def test_forces_are_looked_at_with_the_parameters_of_the_context(device):
    """Those of each call: a field that is switched on takes momentum."""
    system, x, v = dumbbell(stiffness=0.0)
    bath = NoseHoover(300.0, 5.0)
    context = started(system, integrator := ProjectedIntegrator(1e-4, ensemble=bath, device=device), x, v)
    for stiffness, g in ((50.0, 5), (0.0, 2), (50.0, 5)):
        context.setParameter("k", stiffness)
        integrator.step(1)
        assert bath.count(integrator) == integrator.program.settings["momenta"] == g


PLACES = [[0.5, 0.1, -0.2], [-0.1, 0.4, 0.3], [0.2, -0.6, 0.4], [-0.4, -0.2, -0.5]]
CALM = "0.1*r^-1"
FOUR = [0, 1, 2, 3]


def carried(*rows):
    return lambda system, x: [hold(system, rows, x)]


def from_a_fixed_place(system, x):
    """A collective row: the distance of particle 0 from (0.1, 0.2, 0)."""
    return [CollectiveRows(system, [Row(field("sqrt((x-0.1)^2+(y-0.2)^2+z^2)", 1))], positions=x)]


def between_two(system, x):
    """A collective row: a distance."""
    return [CollectiveRows(system, [Row(bond(0, 1))], positions=x)]


SPHERE = Sphere(FOUR, [0, 0, 0], 0.6)
CYLINDER = Ellipsoid(FOUR, [0.1, 0, 0], [0.5, 0.5, np.inf])
FLAT = Ellipsoid(FOUR, [0, 0, 0], [0.6, 0.6, 0.4])
BALL = Formula("x1**2+y1**2+z1**2-0.36", FOUR)
LOPSIDED = "30*(x-0.1)^2+40*y^2+20*(z+0.3)^2+9*x*y*z"


@pytest.mark.parametrize(
    ("parts", "text", "warned"),
    [
        (carried(SPHERE), "", True),
        (carried(SPHERE), "20*z^2", True),
        (carried(SPHERE), LOPSIDED, False),
        (carried(BALL), "", True),
        (carried(BALL), LOPSIDED, False),
        (carried(CYLINDER), "20*z^2", True),
        (carried(CYLINDER), "20*x^2", False),
        (carried(FLAT), "", True),
        (carried(Ellipsoid(FOUR, [0, 0, 0], [0.6, 0.5, 0.4])), "", False),
        (from_a_fixed_place, "", True),
        (from_a_fixed_place, "20*(x^2+y^2+z^2)", True),
        (from_a_fixed_place, LOPSIDED, False),
        (between_two, "", True),
        (between_two, LOPSIDED, False),
        (lambda system, x: [], "20*((x-0.1)^2+y^2+z^2)", True),
        (lambda system, x: [], LOPSIDED, False),
    ],
)
def test_angular_momentum_about_the_axes_of_what_is_held_is_said(parts, text, warned):
    """Pairs that repel exert no torque, and rows none about some axis; a field across it does."""
    system, x = tied([20.0] * 4, CALM, PLACES)
    if text:
        system.addForce(field(text, 4))
    assert said(system, x, NoseHoover(300.0, 5.0), parts(system, x)) == warned


def test_thermostats_without_noise_say_so_where_a_temperature_is_asked_for():
    system, x = tied([20.0] * 4, CALM, PLACES)
    parts = [hold(system, SPHERE, x)]
    assert said(system, x, Isokinetic(300.0), parts)
    assert said(system, x, NoseHooverMiddle(300.0, 5.0), parts)
    assert not said(system, x, Isokinetic(), parts)
    assert not said(system, x, Isokinetic(300.0, momentum="free"), parts)


def test_two_degrees_of_freedom_at_constant_kinetic_energy_are_said():
    system, x = particles([20.0] * 2, field(LOPSIDED, 2)), np.array([[0.0, 0.6, 0.0], [0.6, 0.0, 0.0]])
    parts = [hold(system, [Sphere([0, 1], [0, 0, 0], 0.6), Plane([0, 1], [0, 0, 1], 0.0)], x)]
    assert said(system, x, Isokinetic(300.0), parts, "two degrees of freedom")
    assert not said(system, x, Isokinetic(), parts) and not said(system, x, NoseHoover(300.0, 5.0), parts)


def said(system, x, bath, parts=(), words="exert no torque about an axis"):
    """Whether the first step warns with these words."""
    integrator = ProjectedIntegrator(1e-4, parts=parts, ensemble=bath)
    context = started(system, integrator, x)
    integrator.applyConstraints(context)
    v = np.random.default_rng(2).standard_normal(x.shape)
    v -= masses_of(system) @ v / masses_of(system).sum()
    context.setVelocities(np.where(masses_of(system)[:, None] > 0, v, 0.0))
    integrator.applyVelocityConstraints(context)
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        integrator.step(1)
    told = [one for one in heard if words in str(one.message)]
    assert all(one.filename == __file__ for one in told)
    assert all(one in told or "total momentum is not zero" in str(one.message) for one in heard)
    return bool(told)


@pytest.mark.parametrize(("fixed", "warned"), [([0], True), ([0, 1], True), ([0, 1, 2], False)])
def test_particles_without_mass_leave_turns_about_them(fixed, warned):
    """About one, about the line through two; a virtual site holds nothing."""
    masses = np.array([20.0] * 5)
    masses[fixed] = 0
    system, x = tied(masses, CALM, [*PLACES, [0.9, 0.9, 0.0]])
    site = system.addParticle(0.0)
    system.setVirtualSite(site, openmm.TwoParticleAverageSite(3, 4, 0.5, 0.5))
    x = np.vstack([x, (x[3] + x[4]) / 2])
    system.getForce(0).addBond(0, site)
    assert said(system, x, NoseHoover(300.0, 5.0)) == warned


@pytest.mark.parametrize("make", [Isokinetic, lambda *given, **more: NoseHoover(*given, 5.0, **more)])
@pytest.mark.parametrize(
    ("tied_to_it", "remover", "g"),
    [(1, 1, 9), (0, 1, 9), (1, 0, 12), ((-1, -1, -1), 0, 12), ((-1, 1, -1), 0, 11), ((1, 1, -1), 0, 10)],
)
def test_a_motion_remover_takes_momentum_beside_particles_without_mass(make, tied_to_it, remover, g):
    """It acts on particles with mass only, whether another holds them, is a ghost or an image of one of them."""
    masses = [20.0] * 4 + [0.0]
    system, x = tied(masses if tied_to_it else masses[:4], CALM, [*PLACES, [0.9, 0.9, 0.0]])
    if not tied_to_it:
        system.addParticle(0.0)
    if tied_to_it not in (0, 1):
        system.setVirtualSite(4, image(0, tied_to_it))
    v = np.random.default_rng(2).standard_normal(x.shape)
    v = np.where(np.array(masses)[:, None] > 0, v - v[:4].mean(axis=0), 0.0)
    if remover:
        system.addForce(openmm.CMMotionRemover())
    for momentum in ("auto", "conserved") if remover else ("auto",):
        bath = make(300.0, momentum=momentum)
        context = started(system, integrator := ProjectedIntegrator(1e-4, ensemble=bath), x, v)
        integrator.step(1)
        assert bath.count(integrator) == g
        assert integrator.degrees_of_freedom() == 12 - 3 * remover
    del context


def test_a_motion_remover_leaves_turns_about_the_center_of_mass():
    """A round trap elsewhere leaves one, about the line between both; a trap with an axis elsewhere none."""
    system, x = tied([20.0] * 4, CALM, PLACES)
    system.addForce(openmm.CMMotionRemover())
    bath = Isokinetic(300.0)
    assert said(system, x, bath)
    system.addForce(trap := field("20*((x-0.1)^2+y^2)+k*z^2", 4, k=20.0))
    assert said(system, x, bath)
    trap.setGlobalParameterDefaultValue(0, 9.0)
    assert not said(system, x, bath)
    system.removeForce(1)
    assert said(system, x, bath)
    system.getForce(1).setEnergyFunction("20*((x-0.1)^2+1.1*y^2)+k*z^2")
    assert not said(system, x, bath)
    system.removeForce(1)
    system.addForce(openmm.CMMotionRemover())
    system.addForce(openmm.PythonForce(lambda state: (0.0, np.zeros((4, 3)))))  # which cannot be copied
    assert said(system, x, bath)


def test_a_box_is_not_turned(monkeypatch):
    """Nothing is computed for it, either."""
    system, x = tied([20.0] * 4, CALM, PLACES)
    system.getForce(0).setUsesPeriodicBoundaryConditions(True)
    monkeypatch.setattr("kcons.openmm.ensembles.conserved_momenta._totals", None)
    assert not said(system, x, Isokinetic(300.0))
    held = copy.deepcopy(system)
    assert not said(held, x, Isokinetic(300.0), [hold(held, SPHERE, x)])
    system.addForce(field("x^2", 1))
    system.addForce(openmm.CMMotionRemover())
    assert not said(system, x, Isokinetic(300.0))


def test_forces_that_do_not_act_take_no_momentum():
    """Of the groups that `setIntegrationForceGroups` leaves out."""
    system = particles([12.0] * 4, field("100*(x-0.1)^2", 4, group=3))
    integrator = ProjectedIntegrator(1e-3, ensemble=Isokinetic(300))
    integrator.setIntegrationForceGroups({0})
    v = np.random.default_rng(1).normal(size=(4, 3))
    context = started(system, integrator, np.eye(4)[:, :3], v - v.mean(axis=0))
    assert integrator.degrees_of_freedom(context) == integrator.ensemble.count(integrator) + 3 == 12
