"""Potentials: what is counted, and what is handed out."""

from __future__ import annotations

import numpy as np
import pytest
from ase import Atoms
from ase.calculators.calculator import CalculationFailed, Calculator
from small_test_systems import small

from kcons.comparison.test_systems.potential import of_calculator
from kcons.errors import CalculatorError


def test_potential_counts_points_not_calls():
    system = small("chain")
    system.potential.forget()
    x = system.positions
    system.potential.forces(x)
    system.potential.energy(x)
    system.potential.forces(x.copy())
    assert system.potential.evaluations == 1
    system.potential.forces(x + 0.1)
    assert system.potential.evaluations == 2


def test_a_calculator_that_fails_is_told_of():
    class Failing(Calculator):
        implemented_properties = ["energy", "forces"]

        def calculate(self, *_, **__):
            raise CalculationFailed("SCF not\n converged")

    potential = of_calculator(Atoms("H2", [[0, 0, 0], [0, 0, 1]]), Failing(), "ASE's failing")
    with pytest.raises(CalculatorError, match="ASE's failing failed: SCF not converged; mend the start"):
        potential.forces(np.zeros((2, 3)))


def test_potential_hands_out_copies():
    system = small("chain")
    first = system.potential.forces(system.positions)
    first[:] = 0.0
    assert np.abs(system.potential.forces(system.positions)).max() > 0
