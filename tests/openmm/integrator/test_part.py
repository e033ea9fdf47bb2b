"""What parts have in common, and how a row that is off is named."""

from __future__ import annotations

import numpy as np
import pytest
from collective_cases import bond
from openmm_systems import started, state_of
from tied_cluster import X, cluster

from kcons.constraints import Distance
from kcons.openmm import CollectiveRows, Isokinetic, Langevin, ProjectedIntegrator, Row, hold


def held(kind):
    """A distance of two particles."""
    system, start = cluster(), float(np.linalg.norm(X[0] - X[7]))
    if kind == "collective":
        return system, CollectiveRows(system, [Row(bond(0, 7), start)])
    return system, hold(system, Distance([[0, 7]], (lambda t: start + 0.03 * t) if kind == "moving" else start), X)


@pytest.mark.parametrize(
    ("kind", "first", "second"),
    [
        ("carried", {"ensemble": Isokinetic(300, momentum="free")}, {"ensemble": Isokinetic(200, momentum="free")}),
        ("carried", {"scheme": "suzuki4"}, {"scheme": "blanes-moan4"}),
        ("moving", {"scheme": "blanes-moan4"}, {"scheme": "rattle"}),
        ("moving", {"ensemble": Langevin(300, 0.0)}, {"scheme": "rattle"}),
        ("collective", {"ensemble": Langevin(300, 0.0)}, {"scheme": "rattle"}),
        ("collective", {"ensemble": Isokinetic(300, momentum="free")}, {"scheme": "rattle"}),
    ],
)
def test_integrators_in_turn_hold_the_same_part(kind, first, second):
    """As each does alone: to warm up with one and go on with another is what scripts do."""
    v = 0.3 * np.random.default_rng(1).normal(size=X.shape)

    def begun(made, options):
        system, part = made
        integrator = ProjectedIntegrator(0.002, parts=[part], **options)
        return integrator, started(system, integrator, X, v)

    together, alone = held(kind), [held(kind), held(kind)]
    shared = [begun(together, options) for options in (first, second)]
    single = [begun(made, options) for made, options in zip(alone, (first, second), strict=True)]
    for steps in (3, 1, 4):
        for integrator, _ in (*shared, *single):
            integrator.step(steps)
    # A few units of the last place of 1 nm/ps: where the part was another's, the start of a step is looked at anew.
    for (_, one), (_, other) in zip(shared, single, strict=True):
        np.testing.assert_allclose(state_of(one), state_of(other), rtol=0, atol=1e-15)
