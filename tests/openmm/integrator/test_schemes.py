"""Schemes by name and their stages."""

from __future__ import annotations

import numpy as np
import pytest

from kcons.errors import InputError
from kcons.openmm.integrator.schemes import SCHEMES, stages_of, to_scheme
from kcons.steppers import Rattle


def test_names():
    assert to_scheme("leapfrog") is None
    assert isinstance(to_scheme("rattle"), Rattle)
    own = Rattle()
    assert to_scheme(own) is own
    with pytest.raises(InputError, match=r"known: .*leapfrog"):
        to_scheme("verlet")


@pytest.mark.parametrize("scheme", [*SCHEMES, "leapfrog"])
def test_stages_add_up_to_a_step(scheme):
    drifts, kicks = stages_of(to_scheme(scheme))
    assert len(kicks) == len(drifts) + 1
    assert sum(drifts) == pytest.approx(1, abs=1e-14)
    assert sum(kicks) == pytest.approx(1, abs=1e-14)
    if scheme != "leapfrog":
        np.testing.assert_allclose(kicks, kicks[::-1], atol=1e-15)
        np.testing.assert_allclose(drifts, drifts[::-1], atol=1e-15)
        evaluations = SCHEMES[scheme]().force_evaluations
        # The kick at the end of a step and that at the beginning of the next use the same forces.
        assert np.count_nonzero(kicks[1:]) == evaluations
