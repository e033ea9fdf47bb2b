"""Multipliers of collective rows at the state of a Context."""

from __future__ import annotations

import numpy as np
import openmm
import pytest
from collective_cases import (
    bond,
    context_of,
)

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
