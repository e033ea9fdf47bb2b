"""Virtual sites: where they are, and that their forces do the same work on the parents."""

from __future__ import annotations

import numpy as np
import openmm
from snapshots import WATER

from kcons.topology.rigid_groups import VirtualSites

RNG = np.random.default_rng(7)


def sites():
    """M of TIP4P, and the two lone pairs of TIP5P."""
    return VirtualSites(
        np.array([3, 4, 5]),
        np.tile([0, 1, 2], (3, 1)),
        np.array([[0.128, 0.128, 0.0], [-0.34, -0.34, 0.64], [-0.34, -0.34, -0.64]]),
    )


def test_place_is_what_openmm_computes():
    x = np.concatenate([WATER, np.zeros((3, 3))]) + RNG.normal(size=3)
    system = openmm.System()
    for mass in (16.0, 1.0, 1.0, 0.0, 0.0, 0.0):
        system.addParticle(mass)
    for site, (a, b, c) in zip((3, 4, 5), sites().coefficients, strict=True):
        system.setVirtualSite(site, openmm.OutOfPlaneSite(0, 1, 2, a, b, c))
    context = openmm.Context(system, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatformByName("Reference"))
    context.setPositions(x)
    context.computeVirtualSites()
    there = np.array(context.getState(positions=True).getPositions(asNumpy=True)._value)
    np.testing.assert_allclose(sites().place(x), there, rtol=0, atol=1e-14)


def test_spread_forces_do_the_same_work():
    x = sites().place(np.concatenate([WATER, np.zeros((3, 3))]))
    f = RNG.normal(size=(6, 3))
    spread = sites().spread_forces(x, f)
    assert not spread[3:].any()
    for _ in range(3):
        direction = np.concatenate([RNG.normal(size=(3, 3)), np.zeros((3, 3))])
        h = 1e-6
        moved = (sites().place(x + h * direction) - sites().place(x - h * direction)) / (2 * h)
        np.testing.assert_allclose(np.sum(spread * direction), np.sum(f * moved), rtol=0, atol=1e-8)
    np.testing.assert_allclose(spread.sum(0), f.sum(0), atol=1e-13)
    np.testing.assert_allclose(np.cross(x, spread).sum(0), np.cross(x, f).sum(0), atol=1e-13)


def test_units_scale():
    x = sites().place(np.concatenate([WATER, np.zeros((3, 3))]) + 3.0)
    np.testing.assert_allclose(sites().in_unit(0.1).place(x / 10), x / 10, atol=1e-14)
