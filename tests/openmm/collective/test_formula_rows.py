"""Formulas in OpenMM: as its expressions, and carried by the engine of kcons."""

from __future__ import annotations

import copy

import numpy as np
import openmm
import pytest
from openmm import unit

from kcons.constraints import Formula, VelocityFormula
from kcons.constraints.functions.expressions import FUNCTIONS, parsed
from kcons.errors import UnsupportedError
from kcons.openmm import CollectiveRows, ProjectedIntegrator, Row, hold
from kcons.openmm.collective.formula_rows import expression, formula_rows

X = np.array([[0.1, 0.2, 0.3], [0.3, 0.1, 0.25], [0.45, 0.3, 0.1], [0.2, 0.5, 0.4]])
REFERENCE = openmm.Platform.getPlatform("Reference")


def beads():
    system = openmm.System()
    springs = openmm.HarmonicBondForce()
    for i in range(4):
        system.addParticle(12.0 + i)
        for j in range(i):
            springs.addBond(j, i, 1.05 * float(np.linalg.norm(X[i] - X[j])), 900.0)
    system.addForce(springs)
    return system


def numbers_of(context):
    state = context.getState(positions=True, velocities=True)
    return np.hstack(
        [
            state.getPositions(asNumpy=True).value_in_unit(unit.nanometer),
            state.getVelocities(asNumpy=True).value_in_unit(unit.nanometer / unit.picosecond),
        ]
    )


def ran(system, part, steps=20):
    integrator = ProjectedIntegrator(0.002, parts=[part])
    context = openmm.Context(system, integrator, REFERENCE)
    context.setPositions(X)
    context.setVelocities(0.5 * X[::-1])
    (part.restore if hasattr(part, "restore") else part.apply_velocities)(context)
    integrator.step(steps)
    return numbers_of(context)


def test_every_operation_means_the_same():
    text = " + ".join(
        f"{name}(0.3 + x1*y2{', 2' if name == 'atan2' else ''})" for name in sorted(FUNCTIONS)
    ) + " - -x1**2**z1*(a - z2)/3.5 - 2**-x2/pi + (x1 - 1)**3 - 4 - (2 - 1)"  # fmt: skip
    tree = parsed(text, ["a"])[0]
    force = openmm.CustomCompoundBondForce(2, expression(tree, {"a": -1e-3}))
    force.addBond([0, 1], [])
    system = openmm.System()
    for _ in range(2):
        system.addParticle(1.0)
    system.addForce(force)
    context = openmm.Context(system, openmm.VerletIntegrator(1.0), REFERENCE)
    context.setPositions(X[:2])
    found = context.getState(energy=True).getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole)
    row = Formula(text, [0, 1], {"a": -1e-3}, None)
    assert found == pytest.approx(row.measure(X[None, :2], 0.0)[0], rel=1e-13)


def test_expressions_and_the_engine_hold_the_same():
    row = Formula("a*(x1 - x2)*(z1 - y2) + sqrt((y1 - y2)**2 + z2**2)", [[0, 1], [2, 3]], {"a": [2.0, 1.5]}, None)
    one, other = beads(), beads()
    expressed = ran(one, CollectiveRows(one, [row], positions=X))
    carried = ran(other, hold(other, copy.deepcopy(row), X))
    np.testing.assert_allclose(expressed, carried, atol=1e-10)
    values = row.measure(expressed[:, :3][row.atoms], 0.0)
    np.testing.assert_allclose(values, row.measure(X[row.atoms], 0.0), atol=1e-12)


def test_what_moves_is_carried_and_not_expressed():
    row = Formula("z1 - 0.3 - 0.01*sin(5*t)", 0)
    system = beads()
    with pytest.raises(UnsupportedError, match=r"moves with the time.*kcons.openmm.hold"):
        CollectiveRows(system, [row], positions=X)
    assert system.getNumForces() == 1
    end = ran(system, hold(system, row, X))
    assert end[0, 2] == pytest.approx(0.3 + 0.01 * np.sin(5 * 0.04), abs=1e-12)
    still = formula_rows(Formula("z1", 0, target=None))[0]
    assert isinstance(still, Row) and still.target is None


def test_velocities_are_carried_and_not_expressed():
    row = VelocityFormula("x1*vy1 - y1*vx1", 0)
    system = beads()
    with pytest.raises(UnsupportedError, match=r"holds velocities, not positions; hold it by kcons.openmm.hold"):
        CollectiveRows(system, [row], positions=X)
    end = ran(system, hold(system, row, X))
    assert abs(np.cross(end[0, :3], end[0, 3:])[2]) < 1e-10
