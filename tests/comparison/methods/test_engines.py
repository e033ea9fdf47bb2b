"""One adapter for each MD engine: what is advanced is what the engine does by itself, and can be observed and put."""

from __future__ import annotations

import numpy as np
import pytest
from ase import Atoms
from ase.constraints import FixAtoms, FixBondLengths, FixInternals
from ase.md.verlet import VelocityVerlet

from kcons import ConstraintSet
from kcons.ase import Constraints
from kcons.comparison.methods.engines import InAse, InOpenMM, OnArrays, ase_constraints, seen
from kcons.constraints import Distance
from kcons.motion import Motion
from kcons.steppers import Rattle, State, System

X = np.array([[0.0, 0, 0], [1, 0, 0]])
V = np.array([[0.0, 0.5, 0], [0, -0.5, 0.25]])
DT, STEPS = 0.1, 4


def on_arrays():
    held = ConstraintSet(Distance([[0, 1]]), X, [1.0, 1.0])
    system = System(Motion(held, X))
    return OnArrays(system, system.with_forces(State(X, V)), Rattle(), DT, STEPS)


class Free:
    """A calculator without forces."""

    def get_forces(self, atoms=None):
        return np.zeros((2, 3))

    def calculation_required(self, atoms, quantities):
        return False


def in_ase():
    atoms = Atoms("XX", positions=X, masses=[1.0, 1.0], calculator=Free())
    atoms.set_velocities(V)
    atoms.set_constraint(Constraints([Distance([[0, 1]], [1.0])]))
    return InAse(atoms, VelocityVerlet(atoms, timestep=DT), DT, STEPS)


def in_openmm(length=1.0, speed=1.0):
    openmm = pytest.importorskip("openmm")
    system = openmm.System()
    for _ in X:
        system.addParticle(1.0)
    system.addConstraint(0, 1, length)
    integrator = openmm.VerletIntegrator(DT)
    integrator.setConstraintTolerance(1e-12)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions(length * X)
    context.setVelocities(speed * V)
    return InOpenMM(context, integrator, DT, STEPS, length, speed)


ENGINES = {"arrays": on_arrays, "ASE": in_ase, "OpenMM": in_openmm}


@pytest.mark.parametrize("make", ENGINES.values(), ids=ENGINES)
def test_steps_are_those_of_the_dumbbell(make):
    """Each step of RATTLE turns a free dumbbell by asin(omega dt)."""
    run = make()
    assert run.time == 0 and not run.finished
    run.advance()
    run.march(2)
    assert run.time == pytest.approx(3 * DT) and not run.finished
    x, v = run.observe()
    np.testing.assert_array_equal(x, run.positions)
    np.testing.assert_array_equal(v, run.velocities)
    d, w = X[0] - X[1], V[0] - V[1]
    angle = 3 * np.arcsin(DT * np.linalg.norm(w))
    turned = np.cos(angle) * d + np.sin(angle) * w / np.linalg.norm(w)
    np.testing.assert_allclose(x[0] - x[1], turned, atol=1e-9)
    np.testing.assert_allclose(x.sum(axis=0), X.sum(axis=0) + 3 * DT * V.sum(axis=0), atol=1e-12)
    run.advance()
    assert run.finished


@pytest.mark.parametrize("make", ENGINES.values(), ids=ENGINES)
def test_positions_are_put_as_they_are(make):
    run = make()
    run.advance()
    velocities = run.velocities.copy()
    run.put(run.positions + np.array([3.0, 0, 0]))
    np.testing.assert_array_equal(run.velocities, velocities)
    before = run.positions.copy()
    run.advance()
    assert 0 < np.abs(run.positions - before).max() < 0.1


def test_units_of_openmm():
    one, other = in_openmm(), in_openmm(0.1, 0.1)
    for run in (one, other):
        run.march(3)
    np.testing.assert_allclose(one.positions, other.positions, atol=1e-12)
    np.testing.assert_allclose(seen(other.context)[0], 0.1 * other.positions, atol=1e-15)
    for run in (one, other):
        run.put(X)
    np.testing.assert_allclose(other.positions, X, atol=1e-15)


def test_arrays_are_rewound():
    run = on_arrays()
    run.march(2)
    run.rewind()
    np.testing.assert_array_equal(run.positions, X)
    assert run.time == pytest.approx(2 * DT)


def test_constraints_of_ase():
    pairs, lengths = [(0, 1), (1, 2)], [1.0, 1.5]
    kinds = [type(c) for c in ase_constraints([3], pairs, lengths, internals=False)]
    assert kinds == [FixAtoms, FixBondLengths]
    assert ase_constraints([], [], [], internals=False) == []
    (held,) = ase_constraints([], pairs, lengths, [(0, 1, 2)], [104.5], internals=True, epsilon=1e-10)
    assert isinstance(held, FixInternals) and held.epsilon == 1e-10
    assert held.bonds == [[1.0, [0, 1]], [1.5, [1, 2]]] and held.angles[0][1] == [0, 1, 2]
