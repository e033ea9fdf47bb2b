"""Collective rows in motion: multipliers, orders, reversibility, moving targets."""

from __future__ import annotations

import itertools
import math

import numpy as np
import openmm
import pytest
from collective_cases import CHAIN, angle, bond, dihedral, dipeptide, energy_of, held_chain
from ensemble_runs import run
from openmm import app, unit
from openmm_systems import loose_alanine, pairs_force, particles, state_of

from kcons.constraints import Dihedral
from kcons.errors import ConstraintError
from kcons.openmm import CollectiveRows, Langevin, NoseHooverMiddle, ProjectedIntegrator, hold
from kcons.openmm.collective.coordinates import Row

# -- order, reversibility, energy -----------------------------------------------------------------------


@pytest.mark.parametrize(("scheme", "order"), [("rattle", 2), ("suzuki4", 4), ("kahan-li6", 6)])
def test_order_with_bonds_and_dihedrals(scheme, order):
    span = 0.008  # ps
    ends = {}
    steps = {"rattle": (16, 32, 512), "suzuki4": (8, 16, 64), "kahan-li6": (4, 8, 32)}[scheme]
    for n in steps:
        context, integrator, part = dipeptide(app.AllBonds, scheme=scheme, dt=span / n)
        integrator.step(n)
        ends[n] = state_of(context)[0]
        assert np.abs(part.residuals(context)).max() <= 1e-12
        assert np.abs(part.rates(context)).max() <= 1e-12
    errors = [np.abs(ends[n] - ends[steps[-1]]).max() for n in steps[:2]]
    assert math.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.15)


# -- moving targets -------------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", ["rattle", "suzuki4"])
@pytest.mark.parametrize("constrained", [False, True], ids=["free", "constrained"])
def test_a_drive_moves_its_coordinate(scheme, constrained):
    start = float(np.linalg.norm(CHAIN[0] - CHAIN[3]))
    rows = [Row(bond(0, 3), None, rate=0.2 * unit.nanometer / unit.picosecond), angle(2, 3, 4)]
    context, integrator, part = held_chain(rows, scheme, constrained=constrained)
    integrator.step(50)
    assert part.values(context)[0] == pytest.approx(start + 0.2 * 0.1, abs=1e-12)
    assert part.targets(context)[0] == pytest.approx(start + 0.2 * 0.1, abs=1e-13)
    assert np.abs(part.residuals(context)).max() <= 1e-12
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


def test_what_a_bath_does_across_a_row_is_no_work():
    context, integrator, part = held_chain([Row(bond(0, 3), None, rate=0.5)], dt=0.001, ensemble=Langevin(0, 50))
    forces = [part.multipliers(context)[0] for _ in map(integrator.step, [0, *50 * [1]])]
    assert part.work(integrator)[0] == pytest.approx(0.5 * 0.001 * np.trapezoid(forces), rel=0.01)


# -- a bath between two halves of the drift -------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:total momentum is not zero", "ignore:the forces exert no torque")
@pytest.mark.parametrize(
    "ensemble", [Langevin(300, 0), NoseHooverMiddle(300, 1e-6)], ids=["Langevin", "NoseHooverMiddle"]
)
def test_the_second_half_of_a_drift_begins_in_the_middle(ensemble):
    """Where the bath does nothing: the trajectory of rows held by `hold`, whose code is another one."""
    ends, phi = [], (4, 6, 8, 14)
    for carried in (False, True):
        system, x, v = loose_alanine()  # whose bonds of hydrogen the System holds
        part = hold(system, Dihedral([phi]), x) if carried else CollectiveRows(system, [dihedral(*phi)], positions=x)
        integrator = ProjectedIntegrator(0.001, parts=[part], ensemble=ensemble)
        context = run(system, integrator, x, v, 40)
        ends.append(np.hstack(state_of(context)))
        assert carried or part.meets_system
    np.testing.assert_allclose(ends[0], ends[1], rtol=0, atol=1e-7)


def molecule():
    """A System of three particles, and a Force that is the distance of two of them."""
    return particles([12.0, 16.0, 14.0], pairs_force(openmm.HarmonicBondForce(), (1, 2, 0.15, 1e4))), bond(0, 1)


def test_a_state_of_another_program_has_no_time_of_targets():
    """The pull begins anew there; the error says how to go on instead, and that way ends where one run would."""
    states = []
    for scheme in ("rattle", "geodesic"):
        system, length = molecule()
        rows = CollectiveRows(system, [Row(length, 0.15, 0.5)])
        integrator = ProjectedIntegrator(0.002, scheme, parts=[rows])
        context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
        context.setPositions([[0.0, 0.0, 0.0], [0.15, 0.0, 0.0], [0.15, 0.15, 0.0]])
        if states:
            context.setState(states[0])
            with pytest.raises(ConstraintError, match=r"call restore.*set_target\(integrator, 0, 0\.17\)"):
                integrator.step(1)
            rows.set_target(integrator, 0, 0.17)
        integrator.step(20)
        states.append(context.getState(positions=True, velocities=True))
    assert abs(rows.values(context)[0] - (0.15 + 0.5 * 0.002 * 40)) < 1e-12
    context.setPositions([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.3, 0.15, 0.0]])
    with pytest.raises(ConstraintError) as caught:  # the time of these targets is known
        rows.check(context)
    assert "call restore" in str(caught.value) and "set_target" not in str(caught.value)


# -- what programs do where nobody looks ----------------------------------------------------------------


ASKED = []


def counted(state):
    """A distance that counts how often it is asked."""
    ASKED.append(1)
    x = state.getPositions(asNumpy=True)._value
    arm = x[3] - x[0]
    r = np.linalg.norm(arm)
    force = np.zeros_like(x)
    force[0], force[3] = arm / r, -arm / r
    return r, force


def test_many_steps_look_less_often():
    """A last push that is good enough for sure is not measured."""
    counts = []
    for block in (100, 1):
        context, integrator, part = held_chain([Row(openmm.PythonForce(counted), 0.3)], dt=1e-3, tolerance=1e-5)
        integrator.step(2)
        ASKED.clear()
        for _ in range(100 // block):
            integrator.step(block)
        counts.append(len(ASKED))
        assert np.abs(part.residuals(context)).max() <= 1e-5
    assert counts[0] < 0.85 * counts[1]


@pytest.mark.parametrize("count", [3, 7])
def test_the_iteration_learns_from_each_push(count):
    """Rows that share particles, and pushes that turn their gradients: each takes far more iterations without."""
    rows = [bond(i, j) for i, j in list(itertools.combinations(range(6), 2))[:count]]
    context, integrator, part = held_chain(rows, dt=0.004)
    for _ in range(5):
        integrator.step(1)
        assert integrator.getGlobalVariableByName("iterations1") <= 6
    assert np.abs(part.rates(context)).max() <= 1e-12


def test_products_are_summed_only_where_rows_meet():
    part = CollectiveRows(particles([1.0] * 8), [Row(bond(2 * k, 2 * k + 1), 0.1) for k in range(4)])
    integrator = ProjectedIntegrator(0.002, parts=[part])
    sums = [integrator.getComputationStep(k)[2] for k in range(integrator.getNumComputations())]
    assert sum(text.startswith("m*row1_") for text in sums) == 3 * 4  # where a call begins, in it, where it ends
