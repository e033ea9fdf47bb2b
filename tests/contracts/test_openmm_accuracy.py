"""How exact the integrator is: order, constraints, reversibility, and against independent implementations."""

from __future__ import annotations

import numpy as np
import openmm
import pytest
from openmm import app
from openmm_systems import (
    DATA,
    PLATFORMS,
    alanine,
    forces_at,
    masses_of,
    residuals,
    rows_of,
    started,
    state_of,
    water_box,
)

from kcons.constraints import Distance, projection
from kcons.constraints.constraint_set import ConstraintSet
from kcons.openmm import SCHEMES, ProjectedIntegrator

TIME = 0.048  # ps
#: Order, and time steps in fs that divide the time, where the leading term rules and rounding does not. Other schemes
#: are the same program with other fractions, those of arrays.
ORDERS = {
    "rattle": (2, (1.0, 0.5, 0.25)),
    "suzuki4": (4, (2.0, 1.0, 0.5)),
    "blanes-moan4": (4, (1.5, 1.0, 0.75)),
    "blanes-moan6a": (6, (3.0, 2.4, 2.0)),
}


def flown(scheme, dt):
    """Positions and velocities after the time, as one array."""
    system, x, v = alanine()
    context = started(system, integrator := ProjectedIntegrator(dt, scheme, tolerance=1e-13), x, v)
    steps = round(TIME / dt)
    assert steps * dt == pytest.approx(TIME, rel=1e-12)
    integrator.step(steps)
    return np.array(state_of(context))


@pytest.fixture(scope="module")
def truth():
    return flown("blanes-moan6a", 1e-3)


@pytest.mark.parametrize("scheme", ORDERS)
def test_order_with_all_bonds_held(scheme, truth):
    order, steps = ORDERS[scheme]
    errors = [np.abs(flown(scheme, 1e-3 * dt) - truth).max(axis=(1, 2)) for dt in steps]
    for name, column in zip(("positions", "velocities"), np.transpose(errors), strict=True):
        slope = np.polyfit(np.log(steps), np.log(column), 1)[0]
        assert slope == pytest.approx(order, abs=0.15), name


def test_far_fewer_force_evaluations_than_rattle(truth):
    """At 5e-7 nm after 48 fs, from the error of RATTLE, which falls as the square of its step."""
    rattle = np.abs(flown("rattle", 1e-3 / 16)[0] - truth[0]).max()
    steps_of_rattle = 16000 * np.sqrt(rattle / 5e-7)
    assert np.abs(flown("blanes-moan6", 6e-3)[0] - truth[0]).max() <= 5e-7
    evaluations = SCHEMES["blanes-moan6"]().force_evaluations / 6e-3
    assert steps_of_rattle / evaluations >= 10


# -- constraints ------------------------------------------------------------------------------------


@pytest.mark.parametrize("platform", PLATFORMS)
@pytest.mark.parametrize("scheme", ["rattle", "blanes-moan6"])
def test_constraints_of_water(scheme, platform):
    """SETTLE rounds its distances to single precision: with lengths that are floats it is exact."""
    worst = []
    for exact in (True, False):
        system, x = water_box(exact=exact)
        integrator = ProjectedIntegrator(1e-3, scheme, tolerance=1e-13)
        context = started(system, integrator, x, platform=platform)
        integrator.minimizeEnergy(context, maxIterations=20)
        integrator.setVelocitiesToTemperature(context, 300, 1)
        integrator.step(20)
        distance, along = residuals(system, context)
        assert along <= 1e-12
        worst.append(distance)
    assert worst[0] <= 1e-12
    assert 1e-12 < worst[1] <= 6e-8


# -- back in time -----------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", ORDERS)
def test_reversible(scheme):
    """20 steps there and back. OpenMM takes no negative steps; velocities are turned round instead."""
    system, x, v = alanine()
    integrator = ProjectedIntegrator(2e-3, scheme, tolerance=1e-14)
    context = started(system, integrator, x, v)
    integrator.step(1)
    x, v = state_of(context)
    integrator.step(20)
    context.setVelocities(-state_of(context)[1])
    integrator.step(20)
    after, back = state_of(context)
    assert np.abs(after - x).max() <= 1e-12
    assert np.abs(back + v).max() <= 1e-10 * np.abs(v).max()


# -- against others ---------------------------------------------------------------------------------


def mixture():
    """Alanine dipeptide with its bonds held, and rigid water: CCMA and SETTLE in one System."""
    pdb = app.PDBFile(str(DATA / "alanine-dipeptide-implicit.pdb"))
    box = app.Modeller(pdb.topology, pdb.positions)
    field = app.ForceField("amber14-all.xml", "amber14/tip3p.xml")
    box.addSolvent(field, boxSize=openmm.Vec3(1.8, 1.8, 1.8))
    system = field.createSystem(
        box.topology, nonbondedMethod=app.PME, nonbondedCutoff=0.8, constraints=app.AllBonds, rigidWater=True
    )
    return system, box.positions


def test_projector_against_the_dense_oracle():
    """v := f/m, constrained, is M_par^+ f; also where SETTLE rounds its lengths: it projects at x as it is."""
    system, positions = mixture()
    integrator = ProjectedIntegrator(1e-3, tolerance=1e-13)
    context = started(system, integrator, positions)
    integrator.minimizeEnergy(context, maxIterations=10)
    x, f, masses = state_of(context)[0], forces_at(context), masses_of(system)
    # The molecule and the first 40 waters: rows of different molecules do not mix.
    atoms = np.arange(22 + 3 * 40)
    pairs, lengths = rows_of(system)
    mine = (pairs < len(atoms)).all(axis=1)
    held = ConstraintSet([Distance(pairs[mine], lengths[mine])], x[atoms], masses[atoms])
    exact = projection.constrained_inverse(held.jacobian(x[atoms]).toarray(), masses[atoms]) @ f[atoms].ravel()
    context.setVelocities(f / masses[:, None])
    integrator.applyVelocityConstraints(context)
    found = state_of(context)[1][atoms].ravel()
    assert np.abs(found - exact).max() <= 1e-12 * np.abs(exact).max()


@pytest.mark.slow
def test_a_protein_as_verlet_integrator():
    """Dihydrofolate reductase with 2523 bonds held, 50 steps: the same positions (nm) within the tolerance.

    The forces of the CPU platform are single precision, which a much finer tolerance would show.
    """
    tolerance = 1e-8
    pdb = app.PDBFile(str(DATA / "5dfr_minimized.pdb"))
    system = app.ForceField("amber99sb.xml").createSystem(pdb.topology, constraints=app.AllBonds, rigidWater=False)
    dt = 1e-3
    ours, theirs = ProjectedIntegrator(dt, tolerance=tolerance), openmm.VerletIntegrator(dt)
    theirs.setConstraintTolerance(tolerance)
    context = started(system, ours, pdb.positions, platform="CPU")
    ours.applyConstraints(context, 1e-12)
    ours.setVelocitiesToTemperature(context, 300, 1)
    x, v = state_of(context)
    other = started(system, theirs, x, platform="CPU")
    other.setVelocities(v - 0.5 * dt * forces_at(other) / masses_of(system)[:, None])
    ours.step(50)
    theirs.step(50)
    assert np.abs(state_of(context)[0] - state_of(other)[0]).max() <= tolerance
    assert ours.degrees_of_freedom() == 3 * system.getNumParticles() - system.getNumConstraints() - 3
