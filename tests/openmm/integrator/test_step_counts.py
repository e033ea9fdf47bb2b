"""What a step costs, counted from the program and by what OpenMM really calls."""

from __future__ import annotations

import copy

import numpy as np
import openmm
import pytest
from openmm_parts import HeldCoordinates
from openmm_systems import alanine, context_of, dumbbell, loose_alanine, started

from kcons.constraints import Distance, Plane, Sphere
from kcons.openmm import CollectiveRows, ProjectedIntegrator, SurfaceIntegrator
from kcons.openmm.callback_rows.callbacks import Engine
from kcons.openmm.callback_rows.hold import hold
from kcons.openmm.integrator.program import Program
from kcons.openmm.integrator.schemes import SCHEMES
from kcons.openmm.integrator.step_counts import count_step, forces_at_old_positions
from tests.openmm.collective.test_collective_rows import bond


class Spring:
    """An applied force that counts its evaluations."""

    def __init__(self):
        self.calls = 0

    def __call__(self, state):
        self.calls += 1
        x = np.array(state.getPositions(asNumpy=True)._value)
        return 50.0 * float(np.sum(x**2)), -100.0 * x


def test_by_hand():
    integrator = openmm.CustomIntegrator(0.001)
    p = Program(integrator)
    p.number("stage", "k")
    p.number("e", "energy")
    p.number("off", "0")
    p.table("share", [0.5, 0.5], "t")
    p.let_others_act()
    p.each("v", "v+dt*f/m", "1")
    p.let("stage", "0", "")
    with p.loop("stage < 2", ""):
        p.each("x", "x+share(stage)*dt*v", "2, twice")
        p.hold_positions("")
        p.let("stage", "stage+1", "")
    p.let("e", "energy3", "evaluates a row; its force is not asked for")
    with p.when("e > 0", "depends on positions"):
        p.each("v", "0", "not counted")
    with p.when("off = 0", ""):
        p.sum("e", "f3*x", "evaluates it again? no: both at once")
    p.hold_velocities("")
    counts = count_step(p)
    assert (counts.passes, counts.constraint_solves) == (4, 3)
    assert (counts.force_evaluations, counts.row_evaluations, counts.synchronisations) == (1, 1, 2)


@pytest.mark.parametrize("scheme", [*SCHEMES, "leapfrog"])
@pytest.mark.parametrize("part", [None, False, True], ids=["plain", "part", "part that evaluates"])
def test_force_evaluations(scheme, part):
    for block in (1, 10):
        system, x, v = dumbbell()
        system.removeForce(0)
        spring = Spring()
        system.addForce(openmm.PythonForce(spring))
        parts = [] if part is None else [HeldCoordinates([], 2, 0.0, 2, evaluates=part)]
        integrator = ProjectedIntegrator(1e-3, scheme, parts=parts)
        context = started(system, integrator, x, v)
        integrator.step(3)
        spring.calls = 0
        for _ in range(20 // block):
            integrator.step(block)
        seen, unseen = (integrator.counts(seen=seen).force_evaluations for seen in (True, False))
        assert seen == unseen == spring.calls / 20
        del context


def test_calls_of_a_carrier(monkeypatch):
    """Within a call of step there is one call for each step."""
    system, x, v = dumbbell()
    part = hold(system, Distance([[0, 1]]), x, take="all")
    calls = []
    answer = Engine.answer
    monkeypatch.setattr(Engine, "answer", lambda *a: calls.append(a[1]) or answer(*a))
    integrator = ProjectedIntegrator(1e-3, parts=[part])
    context = started(system, integrator, x, v)
    integrator.step(3)
    calls.clear()
    integrator.step(1)
    assert len(calls) == integrator.counts().row_evaluations == 4
    calls.clear()
    integrator.step(30)
    assert calls.count("land") == 30
    assert integrator.counts(seen=False).row_evaluations == 1
    # At the beginning of the call and of the last step positions are read as well; velocities, and then what rounding
    # took from them, in the last two steps.
    assert len(calls) == 30 + 2 + 2 * 2
    del context


def test_calls_of_a_carrier_beside_bonds(monkeypatch):
    """Force and energy come from one evaluation there, too."""
    system, x, v = loose_alanine()
    part = hold(system, Plane([0], [0, 0, 1]), x)
    calls = []
    answer = Engine.answer
    monkeypatch.setattr(Engine, "answer", lambda *a: calls.append(a[1]) or answer(*a))
    integrator = ProjectedIntegrator(1e-3, parts=[part])
    context = started(system, integrator, x, v)
    integrator.step(3)
    calls.clear()
    integrator.step(30)
    assert calls.count("land") == 30
    assert integrator.counts(seen=False).row_evaluations == 1
    del context


@pytest.mark.parametrize("compiled", [False, True])
def test_spheres_alone(compiled):
    system = openmm.System()
    for _ in range(3):
        system.addParticle(1.0)
    sphere = Sphere([0, 1, 2], [0, 0, 0], 1.0)
    integrator = SurfaceIntegrator(1e-3, surfaces=sphere, system=system, compiled=compiled)
    counts = integrator.counts(seen=False)
    assert counts.passes == (4 if compiled else 6)
    assert (counts.force_evaluations, counts.row_evaluations, counts.synchronisations) == (1, int(compiled), 1)


@pytest.mark.parametrize("count", [1, 4])
def test_rows_among_bonds(count):
    system, x, _ = alanine("HBonds")
    system = copy.deepcopy(system)
    rows = CollectiveRows(system, [bond(k, 21) for k in (4, 6, 8, 14)[:count]], positions=x)
    integrator = ProjectedIntegrator(1e-3, parts=[rows])
    context_of(system, integrator)
    few, many = (integrator.counts(seen=False, iterations=k) for k in (2, 3))
    # Gradients once, positions before the iteration and after each; of these numbers each row gives one.
    assert few.row_evaluations == 4 * count
    assert many.row_evaluations == 5 * count
    # A push is two passes and two solves of the System's constraints.
    assert many.passes - few.passes == 2
    assert many.constraint_solves - few.constraint_solves == 2
    assert integrator.counts().passes > few.passes


@pytest.mark.parametrize(("count", "waits"), [(1, 1), (4, 4)])
def test_waits_of_rows_on_a_gpu(count, waits):
    """One evaluation of each row where pushes are extrapolated."""
    system = openmm.System()
    for _ in range(5):
        system.addParticle(12.0)
    x = np.random.default_rng(1).normal(size=(5, 3))
    rows = CollectiveRows(system, [bond(k, 4) for k in range(count)], positions=x)
    integrator = ProjectedIntegrator(1e-3, parts=[rows])
    counts = integrator.counts(seen=False, iterations=0)
    assert counts.synchronisations == waits
    assert counts.row_evaluations == 2 * count
    assert counts.passes == 7 + count


def test_forces_at_old_positions():
    """x is kept as a difference until the next constraints, where any follow below."""

    def old(*lines):
        integrator = openmm.CustomIntegrator(0.001)
        p = Program(integrator)
        for line in lines:
            if line == "hold":
                p.hold_positions("")
            else:
                p.each(line[0], line[2:], "")
        return forces_at_old_positions(p)

    assert not old("x=x+v", "v=v+f/m")
    assert not old("x=x+v", "hold", "v=v+f/m")
    assert not old("x=x+v", "hold", "x=x+f3", "v=v+f/m")
    assert old("x=x+v", "v=v+f3", "hold")
    assert old("x=x+v", "hold", "x=x+f3", "v=f", "x=x+v", "hold")
