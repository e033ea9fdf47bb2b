"""A calculator that fails in the middle of a run: what is said, and what is left."""

from __future__ import annotations

import numpy as np
import pytest
from ase import units
from ase.build import molecule
from ase.calculators.emt import EMT

from kcons.ase import ConstrainedDynamics, constrain, draw_velocities, rigid_water


class Tired(EMT):
    """Gives up after some evaluations, by an error of its own."""

    def __init__(self, most):
        super().__init__()
        self.left = most

    def calculate(self, *words):
        self.left -= 1
        if self.left < 0:
            raise RuntimeError("SCF not converged")
        super().calculate(*words)


def test_the_step_and_the_temperature_are_named():
    atoms = molecule("H2O")
    atoms.calc = Tired(3)
    constrain(atoms, rigid_water(atoms))
    draw_velocities(atoms, 300, rng=1)
    dynamics = ConstrainedDynamics(atoms, 1 * units.fs)
    dynamics.run(2)
    before, temperature = atoms.positions.copy(), atoms.get_temperature()
    with pytest.raises(RuntimeError, match="SCF not converged") as caught:
        dynamics.run(2)
    assert np.array_equal(atoms.positions, before)
    said = " ".join(caught.value.__notes__)
    assert "in step 3" in said and f"the kinetic temperature was {temperature:.0f} K there" in said
