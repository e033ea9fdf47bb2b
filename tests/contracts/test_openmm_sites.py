"""Virtual sites, alone and beside rows that kcons holds: forces in a step are those of sites at its new positions."""

from __future__ import annotations

import copy
from functools import cache

import numpy as np
import openmm
import pytest
from ensemble_runs import in_calls, twice_kinetic
from openmm import app, unit
from openmm_systems import (
    GPUS,
    LONG,
    PLATFORMS,
    dumbbell,
    forces_at,
    holding,
    loose_alanine,
    masses_of,
    on_gpus,
    residuals,
    started,
    state_of,
    total_energy,
)

from kcons.constraints import Angle, Distance
from kcons.errors import KconsError, UnsupportedError
from kcons.openmm import CollectiveRows, Isokinetic, Langevin, NoseHoover, ProjectedIntegrator, Row, hold
from kcons.openmm.ensembles.isokinetic_ensemble import GAS_CONSTANT
from kcons.openmm.integrator.guard import parts_of_steps

pytestmark = pytest.mark.filterwarnings("ignore:the forces exert no torque")

MODELS, PARTS = ("tip4pew", "tip4pd", "tip5p", "mixed"), ("hold", "collective")


def water(model, molecules=8):
    """Some molecules of a box of water, without walls."""
    field = app.ForceField("tip5p.xml" if model == "tip5p" else "amber14/tip4pew.xml")
    box = app.Modeller(app.Topology(), [])
    box.addSolvent(field, model="tip5p" if model == "tip5p" else "tip4pew", boxSize=openmm.Vec3(1.9, 1.9, 1.9))
    box.delete(list(box.topology.residues())[molecules:])
    system = field.createSystem(box.topology, removeCMMotion=False)
    if model == "tip4pd":
        nonbonded = next(f for f in system.getForces() if isinstance(f, openmm.NonbondedForce))
        for first in range(0, system.getNumParticles(), 4):
            for k, charge in enumerate((0.0, 0.58, 0.58, -1.16)):
                nonbonded.setParticleParameters(first + k, charge, 0.3165, 0.0 if k else 0.936554)
            share = 0.01546 / (2 * 0.09572 * np.cos(np.radians(104.52 / 2)))
            place = openmm.ThreeParticleAverageSite(first, first + 1, first + 2, 1 - 2 * share, share, share)
            system.setVirtualSite(first + 3, place)
    return system, box.positions


def mixed_sites():
    """Two rigid triangles, whose charges sit on an average of two, an out-of-plane and a local-coordinates site."""
    system = openmm.System()
    force = openmm.NonbondedForce()
    x = []
    for n in range(2):
        first = system.getNumParticles()
        for m in (16.0, 2.0, 3.0, 0.0, 0.0, 0.0):
            system.addParticle(m)
            force.addParticle(0.0, 0.25, 0.4 if m == 16.0 else 0.0)
        a, b, c, pair, plane, local = range(first, first + 6)
        for i, j, d in ((a, b, 0.1), (a, c, 0.12), (b, c, 0.15)):
            system.addConstraint(i, j, d)
        system.setVirtualSite(pair, openmm.TwoParticleAverageSite(b, c, 0.3, 0.7))
        system.setVirtualSite(plane, openmm.OutOfPlaneSite(a, b, c, -0.3, -0.3, 4.0))
        system.setVirtualSite(
            local,
            openmm.LocalCoordinatesSite(
                [a, b, c], [0.5, 0.3, 0.2], [-1.0, 0.5, 0.5], [0.0, -1.0, 1.0], openmm.Vec3(0.03, 0.02, -0.04)
            ),
        )
        for site, charge in ((pair, 0.8), (plane, -0.5), (local, -0.3)):
            force.setParticleParameters(site, charge, 0.1, 0.0)
        for i in range(6):
            for j in range(i):
                force.addException(first + i, first + j, 0, 1, 0)
        height = (0.1**2 - 0.12**2 + 0.15**2) / 0.3
        x += [[0, np.sqrt(0.1**2 - height**2), 0.32 * n], [-height, 0, 0.32 * n], [0.15 - height, 0, 0.32 * n]]
        x += [[0.0, 0.0, 0.0]] * 3
    system.addForce(force)
    return system, np.array(x)


@cache
def prepared(model):
    """A System, and a start at 300 K on its constraints."""
    system, positions = mixed_sites() if model == "mixed" else water(model)
    context = started(system, ProjectedIntegrator(1e-3, tolerance=1e-12), positions)
    integrator = context.getIntegrator()
    context.computeVirtualSites()
    openmm.LocalEnergyMinimizer.minimize(context, 1, 200)
    integrator.applyConstraints(context)
    integrator.setVelocitiesToTemperature(context, 300, 1)
    integrator.step(100)
    x, v = state_of(context)
    masses = masses_of(system)[:, None]
    return system, x, np.where(masses > 0, v - np.sum(masses * v, axis=0) / masses.sum(), 0.0)


def with_particles():
    """Eight molecules of TIP4P-Ew and three charged particles with two bonds."""
    system, x, v = prepared("tip4pew")
    system, n = copy.deepcopy(system), len(x)
    far = x.mean(axis=0) + np.array([[0.0, 0.0, 0.9], [0.15, 0.0, 0.9], [0.2, 0.14, 0.9]])
    bonds, nonbonded = (
        openmm.HarmonicBondForce(),
        next(force for force in system.getForces() if isinstance(force, openmm.NonbondedForce)),
    )
    for charge in (0.3, -0.5, 0.2):
        system.addParticle(12.0)
        nonbonded.addParticle(charge, 0.3, 0.3)
    for i, j in ((0, 1), (1, 2), (0, 2)):
        nonbonded.addException(n + i, n + j, 0.0, 1.0, 0.0)
        if j == i + 1:
            bonds.addBond(n + i, n + j, np.linalg.norm(far[i] - far[j]), 1e5)
    system.addForce(bonds)
    own = np.random.default_rng(0).normal(scale=0.3, size=(3, 3))  # the water has no total momentum, nor have these
    return system, np.vstack([x, far]), np.vstack([v, own - own.mean(axis=0)])


def with_rows(kind):
    """A bond and an angle of the three particles, or two distances, one of them from the water."""
    system, x, v = with_particles()
    n = len(x) - 3
    if kind == "hold":
        return system, x, v, hold(system, [Angle([[n, n + 1, n + 2]]), Distance([[n, n + 1]])], x)
    forces = []
    for i, j in ((n, n + 2), (4, n)):
        forces.append(openmm.CustomBondForce("r"))
        forces[-1].addBond(i, j, [])
    return system, x, v, CollectiveRows(system, forces, positions=x)


def begun(what, dt, platform="Reference", scheme="rattle", **options):
    """Molecules with sites, or with rows beside them, at a start at 300 K; (integrator, context, System, part)."""
    system, x, v, part = with_rows(what) if what in PARTS else (*prepared(what), None)
    tolerance = 1e-13 if platform == "Reference" else None
    parts = [] if part is None else [part]
    integrator = ProjectedIntegrator(dt, scheme, tolerance=tolerance, parts=parts, **options)
    integrator.setRandomNumberSeed(3)
    context = started(system, integrator, x, v, platform)
    integrator.applyVelocityConstraints(context)
    return integrator, context, system, part


def steps_of(what):
    """Time steps of which the last halves the one before."""
    return np.array([2e-3, 1e-3] if what in PARTS else [2e-3, 1e-3, 5e-4]) / (2 if what == "mixed" else 1)


def order(what, errors):
    return np.polyfit(np.log(steps_of(what)), np.log(errors), 1)[0]


# -- where sites are -------------------------------------------------------------------------------


def test_which_steps_are_made_in_parts():
    """Forces of the middle of a program are those of sites at its beginning, on Reference and CPU."""
    system, x, v = prepared("tip4pew")
    for platform in PLATFORMS:
        plain = openmm.CustomIntegrator(1e-3)
        plain.addPerDofVariable("seen", 0)
        plain.addComputePerDof("x", "x+dt*v")
        plain.addConstrainPositions()
        plain.addComputePerDof("seen", "f")
        context = started(system, plain, x, v, platform)
        plain.step(1)
        seen, now = np.array(plain.getPerDofVariableByName("seen")), forces_at(context)
        massive = masses_of(system) > 0
        assert np.abs(seen - now)[massive].max() > 1e-3 * np.abs(now).max()
        del context
        context = started(system, integrator := ProjectedIntegrator(1e-3), x, v, platform)
        assert parts_of_steps(context, integrator)
        del context
    system, x, v = dumbbell()
    context = started(system, integrator := ProjectedIntegrator(1e-3), x, v)
    assert not parts_of_steps(context, integrator)


@pytest.mark.parametrize("platform", on_gpus("mixed"))
def test_gpus_place_sites_where_positions_are_constrained(platform):
    system, x, v = prepared("tip4pew")
    integrator = ProjectedIntegrator(1e-3)
    context = started(system, integrator, x, v, platform)
    assert not parts_of_steps(context, integrator)


# -- what is conserved ------------------------------------------------------------------------------


@cache
def energy_errors(what, scheme, platform):
    """How far the total energy is off along a run, root mean square, by time step."""
    errors = []
    for dt in steps_of(what):
        integrator, context, system, part = begun(what, dt, platform, scheme)
        start, energies = total_energy(context), []
        for _ in range(round(0.02 / dt)):
            integrator.step(1)
            energies.append(total_energy(context) - start)
        assert (context.getState().getTime()._value, context.getStepCount()) == (pytest.approx(0.02), len(energies))
        assert residuals(system, context)[0] < 1e-7 if part is None else part.worst_violation(context) is None
        errors.append(np.sqrt(np.mean(np.square(energies))))
        del context
    return errors


@pytest.mark.parametrize(
    ("what", "scheme", "platform"),
    [
        *((model, "rattle", "Reference") for model in MODELS),
        *(("tip5p", scheme, "Reference") for scheme in ("geodesic", "yoshida4")),
        *((what, "rattle", place) for what in PARTS for place in PLATFORMS),
        # On GPUs a usual run has the rows that the program holds there itself.
        *(
            pytest.param(what, "rattle", *p.values, id=f"{p.id}-{what}", marks=[*p.marks, *[LONG] * (what == "hold")])
            for p in GPUS
            if p.id.endswith(("mixed", "none"))
            for what in PARTS
        ),
    ],
)
def test_energy_is_conserved_to_the_order_of_the_scheme(what, scheme, platform):
    errors = energy_errors(what, scheme, platform)
    expected = 4 if scheme == "yoshida4" else 2
    assert order(what, errors) == pytest.approx(expected, abs=0.1 if what in PARTS else 0.25)
    np.testing.assert_allclose(errors, energy_errors(what, scheme, "Reference"), rtol=0.05)


@pytest.mark.parametrize("what", ["tip4pew", "mixed", *PARTS])
@pytest.mark.parametrize("ensemble", [Isokinetic(momentum="free"), NoseHoover(300, 20)], ids=str)
def test_energies_of_thermostats_are_conserved_to_second_order(what, ensemble):
    errors = []
    for dt in steps_of(what):
        integrator, context, *_ = begun(what, dt, ensemble=ensemble)
        integrator.step(1)
        energies, kinetic = [], []
        for _ in range(round(0.02 / dt)):
            integrator.step(1)
            energies.append(integrator.ensemble.conserved_energy(integrator))
            kinetic.append(integrator.kinetic_energy()._value)
        assert (np.ptp(kinetic) < 1e-12 * kinetic[0]) == (type(ensemble) is Isokinetic)
        errors.append(np.std(energies))
        del context
    assert order(what, errors) == pytest.approx(2, abs=0.25)


@pytest.mark.parametrize("model", MODELS)
def test_the_motion_is_that_of_openmm(model):
    """VerletIntegrator, whose velocities are half a step behind, has the same positions."""
    system, x, v = prepared(model)
    dt, tolerance = 1e-3, 1e-12
    verlet = openmm.VerletIntegrator(dt)
    verlet.setConstraintTolerance(tolerance)
    context = started(system, verlet, x, v)
    inverse = np.divide(1, masses_of(system), out=np.zeros(len(x)), where=masses_of(system) > 0)
    # Half a kick back, with accelerations along the constraints.
    context.setVelocities(inverse[:, None] * forces_at(context))
    context.applyVelocityConstraints(tolerance)
    context.setVelocities(v - 0.5 * dt * state_of(context)[1])
    ours = started(system, integrator := ProjectedIntegrator(dt, tolerance=tolerance), x, v)
    for steps in (1, 4, 25):
        verlet.step(steps)
        integrator.step(steps)
        assert np.abs(state_of(ours)[0] - state_of(context)[0]).max() < 1e-8
    assert np.abs(state_of(context)[0] - x).max() > 1e-3


@pytest.mark.parametrize(
    ("what", "options"),
    [
        *(("tip4pew", options) for options in ({}, {"scheme": "blanes-moan4"}, {"ensemble": Isokinetic()})),
        *((what, {}) for what in PARTS),
        *(
            (what, {"ensemble": ensemble})
            for what in PARTS
            for ensemble in (Langevin(300, 20), Isokinetic(momentum="free"), NoseHoover(300, 20))
        ),
    ],
    ids=str,
)
def test_how_steps_are_divided_into_calls_changes_nothing(what, options):
    made = in_calls(lambda: begun(what, 1e-3, **options), ([12], [1] * 12, [5, 7]), 0, 0)
    assert all(context.getStepCount() == 12 for _, context, *_ in made)


def test_a_step_costs_one_evaluation_of_forces():
    system, x, v = prepared("tip4pew")
    system, calls = copy.deepcopy(system), []

    def nothing(state):
        calls.append(1)
        return 0.0, np.zeros((len(x), 3))

    system.addForce(openmm.PythonForce(nothing))
    for integrator in (
        ProjectedIntegrator(1e-3),
        ProjectedIntegrator(1e-3, ensemble=Langevin(300, 1)),
        ProjectedIntegrator(1e-3, ensemble=Isokinetic(momentum="conserved")),
    ):
        context = started(system, integrator, x, v)
        integrator.step(1)
        calls.clear()
        integrator.step(10)
        assert len(calls) == 10
        del context


@pytest.mark.parametrize("platform", on_gpus("mixed"))
def test_gpus_place_sites_within_steps(platform):
    """As on Reference, as far as forces and lengths of the precision go."""
    system, x, v = prepared("tip4pew")
    for made in (
        lambda: ProjectedIntegrator(1e-3),
        lambda: ProjectedIntegrator(1e-3, "yoshida4"),
    ):
        ends = []
        for place in ("Reference", platform):
            context = started(system, integrator := made(), x, v, place)
            integrator.step(10)
            ends.append(state_of(context)[0])
        assert np.abs(ends[1] - ends[0]).max() < 2e-6


def test_temperature_of_a_simulation_does_not_count_sites():
    system, x, v = prepared("tip5p")
    integrator = ProjectedIntegrator(1e-3)
    context = started(system, integrator, x, v)
    integrator.step(3)
    freedom = 6 * 8
    assert integrator.degrees_of_freedom() == freedom
    found = integrator.computeSystemTemperature() / unit.kelvin
    assert found == pytest.approx(twice_kinetic(system, state_of(context)[1]) / (freedom * GAS_CONSTANT))


# -- what cannot be done ----------------------------------------------------------------------------


def test_programs_that_openmm_runs_by_itself_are_refused():
    """A CompoundIntegrator runs programs as wholes; where sites are placed at their ends, forces would be old."""
    system, x, v = prepared("tip4pew")
    compound = openmm.CompoundIntegrator()
    ours = ProjectedIntegrator(1e-3)
    compound.addIntegrator(ours)
    compound.addIntegrator(openmm.VerletIntegrator(1e-3))
    context = started(system, compound, x, v)
    with pytest.raises(UnsupportedError, match=r"particle 3 is a virtual site.*CompoundIntegrator.*integrator alone"):
        ours.attach(context)


def test_a_failure_beside_parts_takes_the_whole_step_back():
    """A target that cannot be reached; then the run goes on as if nothing had happened."""
    ends = []
    for fails in (False, True):
        system, x, v = with_particles()
        stretch = openmm.CustomBondForce("r")
        n = len(x) - 3
        stretch.addBond(n, n + 1, [])
        rows = CollectiveRows(system, [Row(stretch, target=0.15)], positions=x)
        context = started(system, integrator := ProjectedIntegrator(1e-3, parts=[rows]), x, v)
        integrator.applyVelocityConstraints(context)
        integrator.step(3)
        if fails:
            before = state_of(context)
            rows.set_target(integrator, 0, -1.0)
            with pytest.raises(KconsError):
                integrator.step(3)
            np.testing.assert_array_equal(state_of(context), before)
            rows.set_target(integrator, 0, 0.15)
        integrator.step(3)
        ends.append(state_of(context))
        del context
    np.testing.assert_allclose(ends[1], ends[0], atol=1e-9)


def test_steps_of_several_drifts_beside_parts_are_refused_where_sites_come_late():
    system, x, v, part = with_rows("hold")
    context = started(system, integrator := ProjectedIntegrator(1e-3, "yoshida4", parts=[part]), x, v)
    with pytest.raises(UnsupportedError, match=r"particle 3 is a virtual site.*several drifts.*scheme='rattle'"):
        integrator.step(1)
    np.testing.assert_array_equal(state_of(context), [x, v])


def test_rows_that_were_held_before_the_sites_came_are_refused():
    system, x, v = loose_alanine()
    part = holding()
    system.addParticle(0.0)
    for force in system.getForces():
        if isinstance(force, openmm.NonbondedForce):
            force.addParticle(0.0, 0.1, 0.0)
    system.setVirtualSite(len(x), openmm.TwoParticleAverageSite(1, 2, 0.5, 0.5))
    x, v = np.vstack([x, (x[1] + x[2]) / 2]), np.vstack([v, np.zeros(3)])
    integrator = ProjectedIntegrator(1e-3, parts=[part])
    context = started(system, integrator, x, v)
    with pytest.raises(UnsupportedError, match=rf"particle {len(x) - 1} is a virtual site.*hold rows after"):
        integrator.step(1)
    np.testing.assert_array_equal(state_of(context), [x, v])
