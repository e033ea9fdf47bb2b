"""Schemes by name and their stages."""

from __future__ import annotations

import numpy as np
import pytest

from kcons import thermostats
from kcons.errors import InputError
from kcons.openmm import Isokinetic, Langevin, ProjectedIntegrator
from kcons.openmm.integrator.schemes import SCHEMES, operations_of, stages_of, to_scheme
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
    drifts, kicks = stages_of(operations_of(to_scheme(scheme)))
    assert len(kicks) == len(drifts) + 1
    assert sum(drifts) == pytest.approx(1, abs=1e-14)
    assert sum(kicks) == pytest.approx(1, abs=1e-14)
    if scheme != "leapfrog":
        np.testing.assert_allclose(kicks, kicks[::-1], atol=1e-15)
        np.testing.assert_allclose(drifts, drifts[::-1], atol=1e-15)
        evaluations = SCHEMES[scheme]().force_evaluations
        # The kick at the end of a step and that at the beginning of the next use the same forces.
        assert np.count_nonzero(kicks[1:]) == evaluations


@pytest.mark.parametrize("scheme", SCHEMES)
def test_steps_are_those_of_the_steppers_on_arrays(scheme):
    integrator = ProjectedIntegrator(1e-3, scheme)
    assert integrator.operations() == SCHEMES[scheme]().operations()
    for operation in integrator.operations():
        assert str(operation) in integrator.listing()


def test_thermostats_are_those_on_arrays():
    langevin = ProjectedIntegrator(1e-3, ensemble=Langevin(300, 1.0)).operations()
    assert langevin == thermostats.Langevin(1.0, 1.0, 1, substeps=1).operations()
    for order, scheme in ((2, "rattle"), (4, "isokinetic4"), (6, "isokinetic6")):
        isokinetic = ProjectedIntegrator(1e-3, scheme, ensemble=Isokinetic(300)).operations()
        assert isokinetic == thermostats.Isokinetic(1.0, order=order).operations()


def test_a_list_is_no_scheme():
    with pytest.raises(InputError, match="no scheme"):
        ProjectedIntegrator(1e-3, ["rattle"])
