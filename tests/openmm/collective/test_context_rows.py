"""Multipliers of collective rows at the state of a Context."""

from __future__ import annotations

import math

import numpy as np
import openmm
import pytest
from collective_cases import (
    angle,
    bond,
    context_of,
    held_chain,
)
from openmm import unit

from kcons.errors import UnsupportedError
from kcons.openmm import ProjectedIntegrator
from kcons.openmm.collective import CollectiveRows
from kcons.openmm.collective.row_forces import Row


def rotor(scheme="rattle", dt=0.002, row=None):
    """A dumbbell of two masses, turning freely: the bond pulls with lambda = -mu omega^2 d."""
    system = openmm.System()
    system.addParticle(2.0)
    system.addParticle(3.0)
    part = CollectiveRows(system, [Row(bond(0, 1), 0.2)] if row is None else [row])
    integrator = ProjectedIntegrator(dt, scheme, parts=[part])
    x = np.array([[0.0, 0, 0], [0.2, 0, 0]])
    v = np.array([[0.0, -3.0, 0], [0.0, 2.0, 0]])
    context = context_of(system, integrator, x, v)
    return context, integrator, part


ROTOR = -(2.0 * 3.0 / 5.0) * 5.0**2 / 0.2


@pytest.mark.parametrize("scheme", ["rattle", "suzuki4", "blanes-moan6", "geodesic"])
def test_multiplier_of_a_rotor(scheme):
    context, integrator, part = rotor(scheme, dt=0.001)
    integrator.step(5)
    assert part.multipliers_at(context) == pytest.approx([ROTOR], rel=1e-9)
    # An impulse along a chord: (omega dt)^2 off.
    assert part.mean_multipliers(integrator) == pytest.approx([ROTOR], rel=2e-3)


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
    integrator.step(10)
    # f = -30 along the rod, outwards: z = A^T lambda = +30, and grad r = -1 there.
    assert part.multipliers(integrator) == pytest.approx([-30.0], abs=1e-9)
    assert part.mean_multipliers(integrator) == pytest.approx([-30.0], abs=1e-9)
    assert part.multipliers_at(context) == pytest.approx([-30.0], abs=1e-9)


def test_multipliers_at_a_point_need_a_scheme_that_has_them():
    _, integrator, part = rotor("blanes-moan6")
    integrator.step(1)
    with pytest.raises(UnsupportedError, match="mean_multipliers"):
        part.multipliers(integrator)
