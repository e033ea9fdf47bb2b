"""Foreseen pushes: few waits for the host, the same motion, and measured again where they are not good enough."""

from __future__ import annotations

import numpy as np
import pytest
from openmm_systems import GPUS, loose_alanine, on_gpus, started, state_of, total_energy, water_box

from kcons.openmm import CollectiveRows, ProjectedIntegrator
from kcons.openmm.integrator.precision import Precision
from tests.openmm.collective.test_collective_rows import bond

PAIRS = ((4, 14), (4, 8), (6, 14), (8, 18))


def free_alanine():
    system, x, v = loose_alanine()
    for k in reversed(range(system.getNumConstraints())):
        system.removeConstraint(k)
    return system, x, v


def alanine_rows(count, platform, step=5e-4, sparing=None):
    system, x, v = free_alanine()
    part = CollectiveRows(system, [bond(i, j) for i, j in PAIRS[:count]], positions=x)
    integrator = ProjectedIntegrator(step, parts=[part], check_every=0)
    context = started(system, integrator, x, v, platform)
    integrator.step(20)
    if sparing is not None:
        integrator.program.set("sparing1", sparing)
    return integrator, context, part


def waits(integrator, count, steps):
    """Numbers that the host waits for in steps within a call, by the program's own counters; rows that all meet."""

    def so_far():
        measured, renewed = (integrator.getGlobalVariableByName(name) for name in ("measured1", "renewed1"))
        return count * measured + count * (count + 1) / 2 * renewed

    before = so_far()
    integrator.step(steps)
    return (so_far() - before) / steps


@pytest.mark.parametrize(
    ("count", "most", "platform"),
    [
        (1, 1.2, "Reference"),
        (4, 4.8, "Reference"),
        *(pytest.param(4, 4.8, *p.values, id=p.id) for p in GPUS if p.id.endswith("mixed")),
    ],
)
def test_in_mixed_precision_each_row_waits_once(count, most, platform):
    """And every 64th step twice. On a CPU, which waits for nothing, each push is measured."""
    integrator, context, part = alanine_rows(count, platform)
    found = waits(integrator, count, 192)
    if Precision(*platform.split()[:1], *(platform.split()[1:] or ["double"])).name == "mixed":
        assert found <= most
    else:
        assert found > 2.5 * count
    assert np.abs(part.residuals(context)).max() < 5e-7


@pytest.mark.parametrize("platform", ["Reference", *(p for p in on_gpus() if "single" not in p.id)])
def test_the_motion_is_the_same(platform):
    """As with each push measured, to what forces of this precision know, and the energy stays.

    In single precision trajectories part by rounding.
    """
    exact = not platform.endswith("mixed")
    ends, energies = [], []
    for sparing in (0.0, 1.0):
        integrator, context, part = alanine_rows(2, platform, sparing=sparing)
        first = total_energy(context)
        integrator.step(100)
        energies.append(total_energy(context) - first)
        ends.append(state_of(context)[0])
        assert np.abs(part.residuals(context)).max() < (1e-12 if exact else 5e-7)
    assert np.abs(ends[1] - ends[0]).max() < (1e-10 if exact else 1e-5)
    assert energies[1] == pytest.approx(energies[0], abs=0.05)


def test_doubles_are_held_to_their_tolerance_with_fewer_measurements():
    """On Reference, as on a GPU in double precision: of rows with a Gram matrix that changes."""
    measured = []
    for sparing in (0.0, 1.0):
        integrator, context, part = alanine_rows(4, "Reference", step=1e-3, sparing=sparing)
        before = integrator.getGlobalVariableByName("measured1")
        off = 0.0
        for _ in range(10):
            integrator.step(50)
            off = max(off, np.abs(part.residuals(context)).max())
        measured.append(integrator.getGlobalVariableByName("measured1") - before)
        assert off <= 1e-13
    assert measured[1] < 0.9 * measured[0]


def test_a_row_that_is_pulled_away_is_measured_until_it_holds():
    """What was foreseen is wrong where a target jumps."""
    system, x, v = free_alanine()
    part = CollectiveRows(system, [bond(4, 14)], positions=x)
    integrator = ProjectedIntegrator(1e-3, parts=[part], check_every=0)
    context = started(system, integrator, x, v)
    integrator.step(20)
    integrator.program.set("sparing1", 1.0)
    integrator.step(100)
    part.set_target(integrator, 0, float(part.targets(context)[0]) + 1e-3)
    integrator.step(1)
    assert np.abs(part.residuals(context)).max() <= 1e-13


def test_rows_among_constraints_of_the_system():
    system, x = water_box(27)
    v = 0.5 * np.random.default_rng(3).normal(size=x.shape)
    part = CollectiveRows(system, [bond(0, 3 * k) for k in (1, 2, 3)], positions=x)
    integrator = ProjectedIntegrator(1e-3, parts=[part], check_every=0)
    context = started(system, integrator, x, v)
    integrator.step(20)
    integrator.program.set("sparing1", 1.0)
    before = integrator.getGlobalVariableByName("measured1")
    for _ in range(5):
        integrator.step(40)
        assert np.abs(part.residuals(context)).max() <= 1e-13
    assert integrator.getGlobalVariableByName("measured1") - before < 5 * 40 * 4
    assert integrator.degrees_of_freedom() == 3 * 81 - 81 - 3


def test_other_parts_and_schemes_foresee_nothing():
    for scheme in ("suzuki4", "leapfrog"):
        system, x, _ = free_alanine()
        integrator = ProjectedIntegrator(1e-3, scheme, parts=[CollectiveRows(system, [bond(4, 14)], positions=x)])
        assert "sparing1" not in integrator.program.numbers
