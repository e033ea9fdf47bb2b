"""End to end with an expensive calculator: ethanol by GFN2-xTB, X-H bonds held."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest
from ase.build import molecule
from ase.md.velocitydistribution import thermalize_momenta
from ase_systems import FS, follow, off, random

from kcons.ase import ConstrainedDynamics, constrain
from kcons.constraints import Distance
from kcons.steppers import BlanesMoan4, Rattle

pytestmark = pytest.mark.skipif(find_spec("tblite") is None, reason="tblite is an extra")


def xtb():
    from tblite.ase import TBLite

    return TBLite(method="GFN2-xTB", accuracy=0.01, verbosity=0)


@pytest.mark.slow
def test_order_4_conserves_energy_better_than_verlet_at_equal_evaluations():
    start = molecule("CH3CH2OH")
    bonds = [[2, 3], [1, 4], [1, 5], [0, 6], [0, 7], [0, 8]]
    assert all(start.numbers[h] == 1 and start.get_distance(x, h) < 1.15 for x, h in bonds)
    constrain(start, Distance(bonds))
    thermalize_momenta(start, 300, rng=random())
    deviation = {}
    for stepper, timestep, steps in ((Rattle(), 0.5, 24), (BlanesMoan4(), 3.0, 4)):
        atoms = start.copy()
        atoms.calc = xtb()
        energies = follow(ConstrainedDynamics(atoms, timestep * FS, stepper), atoms.get_total_energy, steps)
        deviation[stepper.order] = np.abs(energies - energies[0]).max()
        assert off(atoms, atoms.constraints[0]) <= 1e-14
    assert deviation[2] > 1e-5  # eV
    assert deviation[4] < deviation[2] / 100
