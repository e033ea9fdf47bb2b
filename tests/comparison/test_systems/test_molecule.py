"""Ethanol: its rows and its forces."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest
from small_test_systems import small

from kcons.comparison.test_systems import molecule
from kcons.motion import Motion


def test_ethanol_topology():
    system = small("ethanol")
    bonds = system.angle_bonds
    assert len(bonds) == 8
    assert len(system.angles) == 13
    symbols = np.array(system.symbols)
    assert sorted("".join(sorted(symbols[pair])) for pair in bonds) == ["CC"] + ["CH"] * 5 + ["CO"] + ["HO"]
    assert system.motion.rank == 19
    assert system.motion.degrees_of_freedom == 8
    # The same set by distances alone.
    assert Motion(system.constraint_set, system.positions).rank == 19
    assert len(system.bonds) == 21


@pytest.mark.skipif(find_spec("tblite") is None, reason="tblite is an extra")
def test_ethanol_prefers_xtb():
    assert "xTB" in molecule.build().potential.name
