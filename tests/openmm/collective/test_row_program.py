"""Collective rows in motion: multipliers, orders, reversibility, moving targets."""

from __future__ import annotations

import math

import numpy as np
import openmm
import pytest
from collective_cases import (
    CHAIN,
    angle,
    bond,
    chain_system,
    context_of,
    dipeptide,
    energy_of,
    held_chain,
    some_velocities,
    state_of,
    with_variable,
)
from openmm import app, unit
from openmm_systems import DATA

from kcons.constraints import Dihedral
from kcons.errors import ConstraintError, ConvergenceError, InputError
from kcons.openmm import Langevin, NoseHooverMiddle, ProjectedIntegrator, hold
from kcons.openmm.collective import CollectiveRows
from kcons.openmm.collective.row_forces import Row

# -- multipliers ----------------------------------------------------------------------------------------


# -- order, reversibility, energy -----------------------------------------------------------------------


@pytest.mark.parametrize("constraints", [app.AllBonds, app.HBonds], ids=["allbonds", "hbonds"])
@pytest.mark.parametrize(("scheme", "order"), [("rattle", 2), ("suzuki4", 4), ("kahan-li6", 6)])
def test_order_with_bonds_and_dihedrals(scheme, order, constraints):
    span = 0.008  # ps
    ends = {}
    steps = {"rattle": (16, 32, 512), "suzuki4": (8, 16, 64), "kahan-li6": (4, 8, 32)}[scheme]
    for n in steps:
        context, integrator, part = dipeptide(constraints, scheme=scheme, dt=span / n)
        integrator.step(n)
        ends[n] = state_of(context)[0]
        assert np.abs(part.residuals(context)).max() <= 1e-12
        assert np.abs(part.rates(context)).max() <= 1e-12
    errors = [np.abs(ends[n] - ends[steps[-1]]).max() for n in steps[:2]]
    assert math.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.15)


# A step of blanes-moan6 consists of 99 drifts, some of which last 1e-5 ps only.
@pytest.mark.parametrize(
    ("scheme", "steps", "platform"),
    [
        ("rattle", 50, "CPU"),
        ("rattle", 50, "Reference"),
        ("suzuki4", 20, "Reference"),
        ("blanes-moan6", 5, "Reference"),
    ],
)
def test_reversible(platform, scheme, steps):
    context, integrator, _ = dipeptide(platform=platform, scheme=scheme)
    x, v = state_of(context)
    integrator.step(steps)
    context.setVelocities(-state_of(context)[1])
    integrator.step(steps)
    back, turned = state_of(context)
    assert np.abs(back - x).max() <= 1e-12
    assert np.abs(turned + v).max() <= 1e-9


@pytest.mark.slow
def test_energy_neither_rises_nor_falls():
    context, integrator, _ = dipeptide(app.HBonds, dt=0.0005)
    energies = []
    for _ in range(200):
        integrator.step(10)
        energies.append(energy_of(context, integrator))
    time = 0.005 * np.arange(200)
    slope = np.polyfit(time, energies, 1)[0]
    # kJ/mol in a ps; the kinetic energy is about 60.
    assert abs(slope) < 0.05
    assert np.ptp(energies) < 0.5


# -- moving targets -------------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", ["rattle", "suzuki4", "leapfrog"])
@pytest.mark.parametrize("constrained", [False, True], ids=["free", "constrained"])
def test_a_drive_moves_its_coordinate(scheme, constrained):
    start = float(np.linalg.norm(CHAIN[0] - CHAIN[3]))
    rows = [Row(bond(0, 3), None, rate=0.2 * unit.nanometer / unit.picosecond), angle(2, 3, 4)]
    context, integrator, part = held_chain(rows, scheme, constrained=constrained)
    integrator.step(50)
    assert part.values(context)[0] == pytest.approx(start + 0.2 * 0.1, abs=1e-12)
    assert part.targets(context)[0] == pytest.approx(start + 0.2 * 0.1, abs=1e-13)
    assert np.abs(part.residuals(context)).max() <= 1e-12
    if scheme != "leapfrog":
        assert np.abs(part.rates(context)).max() <= 1e-12


def test_work_of_a_drive_is_the_change_of_energy():
    changes, works = [], []
    for dt in (0.002, 0.001):
        context, integrator, part = held_chain([Row(bond(0, 3), None, rate=0.5)], dt=dt)
        start = energy_of(context, integrator)
        integrator.step(round(0.1 / dt))
        changes.append(energy_of(context, integrator) - start)
        works.append(part.work(integrator)[0])
    assert abs(changes[1]) > 1.0
    errors = np.abs(np.array(works) - changes)
    assert errors[1] < 0.01 * abs(changes[1])
    assert errors[1] < 0.5 * errors[0]


def test_a_step_that_failed_does_not_move_the_target():
    context, integrator, part = held_chain([Row(bond(0, 3), None, rate=0.2)])
    integrator.step(5)
    x, v = state_of(context)
    integrator.setStepSize(2.0 * unit.picosecond)
    with pytest.raises(ConvergenceError):
        integrator.step(1)
    integrator.setStepSize(0.002)
    assert np.array_equal(state_of(context)[0], x)
    assert np.array_equal(state_of(context)[1], v)
    integrator.step(5)
    start = float(np.linalg.norm(CHAIN[0] - CHAIN[3]))
    assert part.values(context)[0] == pytest.approx(start + 0.2 * 0.02, abs=1e-12)


def test_constraints_applied_alone_do_not_move_the_target():
    context, integrator, part = held_chain([Row(bond(0, 3), None, rate=0.2)])
    integrator.step(5)
    before = part.targets(context)[0]
    integrator.applyVelocityConstraints(context)
    integrator.applyConstraints(context)
    integrator.applyVelocityConstraints(context)
    assert part.targets(context)[0] == before
    integrator.step(5)
    start = float(np.linalg.norm(CHAIN[0] - CHAIN[3]))
    assert part.values(context)[0] == pytest.approx(start + 0.2 * 0.02, abs=1e-12)


def test_target_that_is_a_context_parameter():
    system = chain_system()
    knob = with_variable("0*d*target", d=bond(0, 1))
    knob.addGlobalParameter("target", float(np.linalg.norm(CHAIN[0] - CHAIN[3])))
    knob.addGlobalParameter("speed", 0.0)
    system.addForce(knob)
    part = CollectiveRows(system, [Row(bond(0, 3), "target", rate="speed")])
    integrator = ProjectedIntegrator(0.001, parts=[part])
    context = context_of(system, integrator, CHAIN, some_velocities())
    part.restore(context)
    integrator.step(5)
    context.setParameter("speed", 0.3)
    part.apply_velocities(context)
    for _ in range(10):
        context.setParameter("target", context.getParameter("target") + 0.3 * 0.001)
        integrator.step(1)
        assert abs(part.residuals(context)[0]) <= 1e-12
        assert abs(part.rates(context)[0]) <= 1e-12
    assert part.values(context)[0] == pytest.approx(context.getParameter("target"), abs=1e-12)


def test_another_target_from_now_on():
    context, integrator, part = held_chain([bond(0, 3)])
    part.set_target(integrator, 0, 2.5 * unit.angstrom)
    with pytest.raises(ConstraintError, match="restore"):
        part.check(context)
    part.restore(context)
    integrator.step(3)
    assert part.values(context) == pytest.approx([0.25], abs=1e-12)
    with pytest.raises(InputError, match="without a rate"):
        part.set_target(integrator, 0, 0.25, rate=1.0)


# -- a bath between two halves of the drift -------------------------------------------------------------

PEPTIDE = app.PDBFile(str(DATA / "alanine-dipeptide-implicit.pdb"))
PHI = [4, 6, 8, 14]


def held_peptide(ensemble, dt, carried=False):
    """Alanine dipeptide with bonds of hydrogen held by the System and phi by rows."""
    field = app.ForceField("amber14-all.xml")
    system = field.createSystem(PEPTIDE.topology, constraints=app.HBonds, removeCMMotion=False)
    force = openmm.CustomTorsionForce("theta")
    force.addTorsion(*PHI, [])
    x = PEPTIDE.positions
    part = hold(system, [Dihedral([PHI])], x) if carried else CollectiveRows(system, [force], positions=x)
    integrator = ProjectedIntegrator(dt, parts=[part], ensemble=ensemble)
    integrator.setRandomNumberSeed(3)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions(x)
    integrator.applyConstraints()
    return context, integrator, part


@pytest.mark.filterwarnings("ignore:total momentum is not zero")
@pytest.mark.parametrize(
    "ensemble", [Langevin(300, 0), NoseHooverMiddle(300, 1e-6)], ids=["Langevin", "NoseHooverMiddle"]
)
def test_the_second_half_of_a_drift_begins_in_the_middle(ensemble):
    """Where the bath does nothing: the trajectory of rows held by `hold`, whose code is another one."""
    ends, starts = [], []
    v = np.random.default_rng(5).normal(size=(22, 3))
    for carried in (False, True):
        context, integrator, _ = held_peptide(ensemble, 0.001, carried)
        if starts:
            context.setPositions(starts[0])
        starts.append(state_of(context)[0])
        context.setVelocities(v - v.mean(axis=0))
        integrator.applyVelocityConstraints()
        integrator.step(40)
        ends.append(np.hstack(state_of(context)))
    np.testing.assert_allclose(ends[0], ends[1], rtol=0, atol=1e-7)


def test_langevin_beside_constraints_of_the_system_goes_on():
    """Three picoseconds at 2 fs with a coordinate of atoms that the System constrains."""
    context, integrator, rows = held_peptide(Langevin(300, 5), 0.002)
    integrator.setVelocitiesToTemperature(context, 300, 1)
    integrator.step(1500)
    assert abs(rows.residuals(context)[0]) < 1e-12
