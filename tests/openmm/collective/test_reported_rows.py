"""What collective rows report: where they are, their multipliers, and why a step failed."""

from __future__ import annotations

import math

import numpy as np
import openmm
import pytest
from collective_cases import CHAIN, angle, bond, chain_system, context_of, held_chain, some_velocities, state_of
from openmm import unit

from kcons.errors import ConvergenceError, NonFiniteError, SingularGeometryError, UnsupportedError
from kcons.openmm import ProjectedIntegrator
from kcons.openmm.collective import CollectiveRows
from kcons.openmm.collective.row_forces import Row


def test_where_rows_are_and_how_fast():
    system, x, v = chain_system(), CHAIN, some_velocities()
    part = CollectiveRows(system, [Row(bond(0, 3), 0.3, rate=0.5)])
    context = context_of(system, ProjectedIntegrator(0.001, parts=[part]), x, v)
    arm = x[3] - x[0]
    length = float(np.linalg.norm(arm))
    assert part.values(context) == pytest.approx([length], rel=1e-12)
    assert part.targets(context) == pytest.approx([0.3]) and part.driven and not part.steered
    assert part.residuals(context) == pytest.approx([length - 0.3], rel=1e-10)
    assert part.rates(context) == pytest.approx([arm @ (v[3] - v[0]) / length - 0.5], rel=1e-10)
    assert part.rank(context) == 1
    miss = part.worst_miss(context)
    assert miss is not None and miss.row == 0 and miss.off == pytest.approx(length - 0.3, rel=1e-10)


@pytest.mark.parametrize(
    ("told", "error", "words"),
    [
        ({"singular1": 1.0}, SingularGeometryError, "row 0 .* vanishes"),
        ({"residual1": math.nan}, NonFiniteError, "is not a number"),
        ({"residual1": 0.0}, NonFiniteError, "velocities are not finite"),
        ({"residual1": 1.0, "sigma1_0": 0.25, "iterations1": 7.0}, ConvergenceError, "off by 0.25 after 7 iterations"),
    ],
)
def test_why_a_step_failed(told, error, words):
    _, integrator, part = held_chain([bond(0, 3)])
    for name, value in told.items():
        integrator.setGlobalVariableByName(name, value)
    found = part.failure(integrator, 12)
    assert type(found) is error
    with pytest.raises(error, match=f"step 12: .*{words}"):
        raise found


def test_multipliers_have_second_order():
    errors = []
    for dt in (0.002, 0.001):
        context, integrator, part = held_chain([bond(0, 3), angle(2, 3, 4)], dt=dt, constrained=True)
        integrator.step(round(0.04 / dt))
        exact = part.multipliers_at(context)
        integrator.step(1)
        errors.append(np.abs(part.multipliers(integrator) - exact).max())
    assert math.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.15)


def test_multipliers_of_a_static_load():
    # A weight hangs on a rod from a heavy anchor without motion: the rod pulls with its weight.
    system = openmm.System()
    system.addParticle(0.0)
    system.addParticle(4.0)
    load = openmm.CustomExternalForce("30*x")
    load.addParticle(1)
    system.addForce(load)
    part = CollectiveRows(system, [Row(bond(0, 1), 0.3 * unit.nanometer)])
    integrator = ProjectedIntegrator(0.002, parts=[part])
    context = context_of(system, integrator, [[0, 0, 0], [-0.3, 0, 0]], np.zeros((2, 3)))
    assert np.isnan([part.multipliers(integrator), part.mean_multipliers(integrator)]).all()
    integrator.step(10)
    # f = -30 along the rod, outwards: z = A^T lambda = +30, and grad r = -1 there.
    assert part.multipliers(integrator) == pytest.approx([-30.0], abs=1e-9)
    assert part.mean_multipliers(integrator) == pytest.approx([-30.0], abs=1e-9)
    assert part.multipliers_at(context) == pytest.approx([-30.0], abs=1e-9)


def test_multipliers_at_a_point_need_a_scheme_that_has_them():
    _, integrator, part = held_chain([bond(0, 3)], scheme="blanes-moan6")
    integrator.step(1)
    with pytest.raises(UnsupportedError, match="mean_multipliers"):
        part.multipliers(integrator)
    assert np.isfinite(part.mean_multipliers(integrator)).all()


def test_rows_that_become_singular_within_a_step_are_named_by_the_program():
    # The gradient of (r - 0.3)^2 vanishes as r goes to 0.3.
    system = openmm.System()
    system.addParticle(1.0)
    system.addParticle(1.0)
    force = openmm.CustomBondForce("(r-0.3)^2")
    force.addBond(0, 1)
    part = CollectiveRows(system, [Row(force, 0.01, rate=-0.5)])
    integrator = ProjectedIntegrator(0.001, parts=[part])
    context = context_of(system, integrator, [[0, 0, 0], [0.4, 0, 0]], np.zeros((2, 3)))
    part.restore(context)
    with pytest.raises((SingularGeometryError, ConvergenceError), match="row 0"):
        integrator.step(40)
    assert np.isfinite(state_of(context)[0]).all()
