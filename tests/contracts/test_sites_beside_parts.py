"""Virtual sites beside rows that kcons holds: the forces of a step are those of sites at its new positions."""

from __future__ import annotations

import copy
from functools import cache

import numpy as np
import openmm
import pytest
from openmm_systems import GPUS, LONG, holding, loose_alanine, started, state_of, total_energy
from virtual_site_systems import prepared

from kcons.constraints import Angle, Distance
from kcons.errors import KconsError, UnsupportedError
from kcons.openmm import CollectiveRows, Isokinetic, Langevin, NoseHoover, ProjectedIntegrator, Row, hold

pytestmark = pytest.mark.filterwarnings("ignore:the forces exert no torque")


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


def started_on_rows(kind, dt, platform="Reference", **options):
    system, x, v, part = with_rows(kind)
    tolerance = 1e-12 if platform == "Reference" else None
    integrator = ProjectedIntegrator(dt, tolerance=tolerance, parts=[part], **options)
    integrator.setRandomNumberSeed(3)
    context = started(system, integrator, x, v, platform)
    integrator.applyVelocityConstraints(context)
    return integrator, context, part


@pytest.mark.parametrize(
    ("platform", "kind"),
    [
        *((place, kind) for place in ("Reference", "CPU") for kind in ("hold", "collective")),
        # On GPUs a usual run has the rows that the program holds there itself.
        *(
            pytest.param(*p.values, kind, id=f"{p.id}-{kind}", marks=[*p.marks, LONG] if kind == "hold" else p.marks)
            for p in GPUS
            if p.id.endswith(("mixed", "none"))
            for kind in ("hold", "collective")
        ),
    ],
)
def test_energy_is_conserved_to_second_order_beside_parts(platform, kind):
    errors = energy_errors(platform, kind)
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.1)
    np.testing.assert_allclose(errors, energy_errors("Reference", kind), rtol=0.05)


@cache
def energy_errors(platform, kind):
    errors = []
    for dt in (2e-3, 1e-3):
        integrator, context, part = started_on_rows(kind, dt, platform)
        start, energies = total_energy(context), []
        for _ in range(round(0.02 / dt)):
            integrator.step(1)
            energies.append(total_energy(context) - start)
        assert part.worst_violation(context) is None
        assert (context.getState().getTime()._value, context.getStepCount()) == (pytest.approx(0.02), len(energies))
        errors.append(np.sqrt(np.mean(np.square(energies))))
        del context
    return errors


@pytest.mark.parametrize("kind", ["hold", "collective"])
@pytest.mark.parametrize(
    "ensemble", [None, Langevin(300, 20), Isokinetic(momentum="free"), NoseHoover(300, 20)], ids=str
)
def test_thermostats_beside_parts(ensemble, kind):
    """How steps are divided into calls changes nothing; what is conserved is so to second order."""
    ends = []
    for calls in ((6,), (1,) * 6, (2, 4)):
        integrator, context, _ = started_on_rows(kind, 1e-3, ensemble=ensemble)
        for steps in calls:
            integrator.step(steps)
        assert context.getStepCount() == 6
        ends.append(state_of(context))
        del context
    np.testing.assert_array_equal(ends[0], ends[1])
    np.testing.assert_array_equal(ends[0], ends[2])
    if ensemble is None or isinstance(ensemble, Langevin):
        return
    errors = []
    for dt in (2e-3, 1e-3):
        integrator, context, _ = started_on_rows(kind, dt, ensemble=ensemble)
        energies = []
        for _ in range(round(0.02 / dt)):
            integrator.step(1)
            energies.append(integrator.ensemble.conserved_energy(integrator))
        errors.append(np.std(energies))
        del context
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.25)


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
