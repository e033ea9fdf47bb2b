"""Carried constraint objects, surfaces among them, and collective rows in one integrator."""

import numpy as np
import pytest
from ensemble_runs import two_parts
from openmm_systems import started, state_of

from kcons.openmm import ProjectedIntegrator


def test_what_cannot_be_reached_leaves_positions_as_they_were():
    """That the rows are held: `test_every_ensemble`."""
    system, x, parts = two_parts()
    integrator = ProjectedIntegrator(0.002, parts=parts)
    x[5] = 0.0  # the center of the sphere: no nearest point
    context = started(system, integrator, x)
    with pytest.raises(Exception, match=r"Sphere\(5\)|particle 5|row") as caught:
        integrator.applyConstraints(context)
    assert type(caught.value).__module__ == "kcons.errors"
    assert np.array_equal(state_of(context)[0], x)
