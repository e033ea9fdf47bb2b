"""OpenMM as an MD engine of test systems: forces in their units."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest
from ase import units

from kcons.comparison import test_systems


@pytest.mark.skipif(find_spec("openmm") is None, reason="openmm is an extra")
def test_openmm_forces_of_water_agree_with_ewald_in_double_precision():
    import openmm

    from kcons.comparison.test_systems.openmm_engine import OpenMMEngine

    test_system = test_systems.build("water", 27, forces="openmm")
    # Two molecules far apart in a large box without periodicity: Coulomb's law and Lennard-Jones by hand.
    system = openmm.System()
    force = openmm.NonbondedForce()
    for q in (0.4, -0.4):
        system.addParticle(1.0)
        force.addParticle(q, 0.3, 0.5)
    system.addForce(force)
    pair = OpenMMEngine(lambda: system).potential()
    r = 4.0
    x = np.array([[0.0, 0, 0], [r, 0, 0]])
    epsilon, s6 = 0.5 * units.kJ / units.mol, (3.0 / r) ** 6
    coulomb = -0.16 * units.Hartree * units.Bohr / r
    assert pair.energy(x) == pytest.approx(coulomb + 4 * epsilon * (s6**2 - s6), rel=1e-6)
    pull = coulomb / r + 4 * epsilon * (12 * s6**2 - 6 * s6) / r
    assert pair.forces(x)[1, 0] == pytest.approx(pull, rel=1e-6)
    # No constraint of OpenMM's own is left in the box.
    assert test_system.potential.name.startswith("PME, OpenMM")
    assert np.abs(test_system.potential.forces(test_system.positions).sum(axis=0)).max() < 1e-2
