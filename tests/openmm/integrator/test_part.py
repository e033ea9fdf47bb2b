"""What parts have in common, and how a row that is off is named."""

from __future__ import annotations

import numpy as np
import openmm
import pytest
from collective_cases import bond
from openmm_systems import pairs_force, particles, started, state_of

from kcons.constraints import Distance
from kcons.openmm import CollectiveRows, Isokinetic, Langevin, ProjectedIntegrator, Row, hold


def held(kind):
    """Three particles in a chain, a distance of the first two held."""
    springs = pairs_force(openmm.HarmonicBondForce(), (1, 2, 0.15, 1e4), (0, 2, 0.2, 1e2))
    system = particles([12.0, 16.0, 14.0], springs)
    x = np.array([[0.0, 0.0, 0.0], [0.15, 0.0, 0.0], [0.15, 0.15, 0.0]])
    if kind == "collective":
        return system, CollectiveRows(system, [Row(bond(0, 1), 0.15)]), x
    target = (lambda t: 0.15 + 0.03 * t) if kind == "moving" else 0.15
    return system, hold(system, Distance([[0, 1]], target), x), x


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
    v = np.array([[0.0, 0.3, 0.1], [0.1, -0.2, 0.3], [-0.1, 0.0, 0.2]])

    def begun(made, options):
        system, part, x = made
        integrator = ProjectedIntegrator(0.002, parts=[part], **options)
        return integrator, started(system, integrator, x, v)

    together, alone = held(kind), [held(kind), held(kind)]
    shared = [begun(together, options) for options in (first, second)]
    single = [begun(made, options) for made, options in zip(alone, (first, second), strict=True)]
    for steps in (3, 1, 4):
        for integrator, _ in (*shared, *single):
            integrator.step(steps)
    # A few units of the last place of 1 nm/ps: where the part was another's, the start of a step is looked at anew.
    for (_, one), (_, other) in zip(shared, single, strict=True):
        np.testing.assert_allclose(state_of(one), state_of(other), rtol=0, atol=1e-15)
