"""Systems whose cell can change."""

from __future__ import annotations

import numpy as np
import pytest
from pressure_systems import gas, no_force

from kcons.constraints import Distance
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import InputError, NonFiniteError, UnsupportedError
from kcons.motion import Motion
from kcons.thermostats.pressure import CellSystem


def test_functions_see_the_present_cell():
    system, x = gas(n=3, force=lambda x, t, h: x * h[0, 0], potential=lambda x, t, h: h[2, 2], stress=lambda x, t, h: h)
    assert system.forces(x, x, 0.0, 0) == pytest.approx(12 * x)
    cell = np.diag([11.0, 12, 13])
    cell[1, 0] = 2.0
    system.set_cell(cell, x)
    assert np.array_equal(system.motion.lattice[0], cell)
    assert np.array_equal(system.cell, cell)
    assert system.forces(x, x, 0.0, 0) == pytest.approx(11 * x)
    assert system.energy(x, 0.0, 0) == 13
    assert system.stress(x, 0.0)[0, 1] == system.stress(x, 0.0)[1, 0] == 1.0


def test_a_pressure_is_an_energy_over_an_area_in_a_slab():
    """Whatever length the vector has that is not periodic."""
    x = np.array([[0.0, 0, 0], [1, 0, 0]])
    held = ConstraintSet(Distance([[0, 1]]), x, [1.0, 1.0], cell=[10.0, 10, 30], pbc=[True, True, False])
    system = CellSystem(Motion(held, x))
    state = system.initial_state(x)
    assert system.volume == pytest.approx(100)
    system.set_cell(np.diag([11.0, 10, 30]), x)
    assert system.volume == pytest.approx(110)
    system.enter(state)
    assert system.volume == pytest.approx(100)


def test_an_energy_that_is_none():
    for energy, error in ((None, InputError), ("-1", InputError), ([1.0], InputError), (1j, InputError)):
        system, x = gas(n=2, force=no_force, potential=lambda x, t, h, energy=energy: energy)
        with pytest.raises(error, match="potential"):
            system.energy(x, 0.0, 3)
    system, x = gas(n=2, force=no_force, potential=lambda x, t, h: -np.inf)  # every trial there was accepted
    with pytest.raises(NonFiniteError, match="-inf at step 3"):
        system.energy(x, 0.0, 3)


def test_a_cell_that_is_refused_changes_nothing():
    system, x = gas(n=3)
    with pytest.raises(InputError, match="half the box"):
        system.set_cell(np.eye(3) * 1.5, x)
    assert np.array_equal(system.cell, 12 * np.eye(3))
    assert np.array_equal(system.motion.lattice[0], 12 * np.eye(3))


def test_what_is_refused():
    x = np.array([[0.0, 0, 0], [1, 0, 0]])
    with pytest.raises(InputError, match="no cell"):
        CellSystem(Motion(ConstraintSet(Distance([[0, 1]]), x, [1.0, 1.0]), x))
    with pytest.raises(InputError, match="force and potential"):
        gas(n=2, force=no_force)
    system, x = gas(n=2, force=no_force, potential=lambda x, t, h: np.nan)
    with pytest.raises(UnsupportedError, match="MonteCarloBarostat"):
        system.stress(x, 0.0)
    with pytest.raises(NonFiniteError, match="step 7") as found:
        system.energy(x, 0.0, 7)
    assert found.value.step == 7
    system, x = gas(n=2, force=no_force, potential=lambda x, t, h: 0.0, stress=lambda x, t, h: h * np.nan)
    with pytest.raises(NonFiniteError, match="stress"):
        system.stress(x, 0.0)
