"""Units of a run in those of MDAnalysis."""

from __future__ import annotations

import numpy as np
import pytest

from kcons.errors import InputError
from kcons.mdanalysis import OPENMM_UNITS, RunUnits


def test_units_of_velocities_and_forces_follow():
    assert OPENMM_UNITS.velocity == 10.0 and OPENMM_UNITS.force == 0.1


@pytest.mark.parametrize("name", ["length", "time", "energy"])
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_units_that_are_none_are_refused(name, value):
    with pytest.raises(InputError) as caught:
        RunUnits(**{name: value})
    assert caught.value.item == name
