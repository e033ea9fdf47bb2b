"""Surfaces given by formulas."""

from __future__ import annotations

import numpy as np
import openmm
import pytest
from surface_cases import (
    FORMULA,
    started,
    state_of,
    system_of,
)

from kcons.errors import InputError, UnsupportedError
from kcons.openmm.surfaces.formulas import ExpressionSurface
from kcons.openmm.surfaces.surface_integrator import SurfaceIntegrator


def test_formula_with_intermediate_values_and_parameters():
    x = np.array([[0.8164965809277261, 0, 0], [0, 1.0, 0], [0, 0, 3.0]])
    system = system_of()
    integrator = SurfaceIntegrator(
        0.01, surfaces=[ExpressionSurface([0, 1], FORMULA), ExpressionSurface(2, "z-a", {"a": 3.0})], system=system
    )
    context = started(system, integrator, x, [[0, 1, 0], [1, 0, 0], [1, 1, 0]])
    integrator.step(100)
    there, _ = state_of(context)
    X, Y, Z = there[:2].T
    assert np.abs(1.5 * X**2 + Y**2 + 2 * Z**2 + 0.3 * X * Y * Z - 1).max() <= 1e-14
    assert there[2, 2] == pytest.approx(3.0, abs=1e-14)


def test_refused_parameters_of_a_formula():
    for values in ([1.0, 2.0], np.nan):
        with pytest.raises(InputError, match="one finite number"):
            ExpressionSurface([0], "x-a", {"a": values})


def test_no_force_groups_left():
    system = system_of()
    for group in range(32):
        force = openmm.CustomExternalForce("0")
        force.setForceGroup(group)
        system.addForce(force)
    with pytest.raises(UnsupportedError, match="force groups"):
        SurfaceIntegrator(0.001, surfaces=ExpressionSurface([0], "x"), system=system)


def test_leaves_room_for_the_groups_of_the_user():
    system = system_of()
    system.getForce(0).setForceGroup(31)
    integrator = SurfaceIntegrator(0.001, surfaces=ExpressionSurface([0], "x"), system=system)
    assert integrator.row_groups == {29, 30}
    assert integrator.getIntegrationForceGroups() & 0xFFFFFFFF == 0xFFFFFFFF ^ (1 << 30 | 1 << 29)
