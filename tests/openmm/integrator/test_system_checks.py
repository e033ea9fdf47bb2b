"""Systems that cannot be propagated, and the rows of a System."""

from __future__ import annotations

import numpy as np
import openmm
import pytest
from openmm_systems import BAROSTATS, context_of, particles, started, water_box

from kcons.errors import InputError, UnsupportedError
from kcons.openmm import Langevin, ProjectedIntegrator, worst_length
from kcons.openmm.integrator.guard import SystemRows

# -- what cannot be propagated ----------------------------------------------------------------------


def test_rows_of_a_system():
    """Triangles with two equal sides go to SETTLE, and only if nothing else holds their atoms."""
    waters = [((a, a + 1, 0.1), (a, a + 2, 0.11 if a == 6 else 0.1), (a + 1, a + 2, 0.16)) for a in (0, 3, 6)]
    held = [*(pair for water in waters for pair in water), (5, 9, 0.2), (11, 12, 0.3)]
    system = particles([16.0, 1.0, 1.0] * 3 + [12.0, 12.0, 0.0, 0.0], held=held)
    rows = SystemRows.of(system)
    assert rows.n_rows == 10
    np.testing.assert_array_equal(rows.numbers, range(10))
    np.testing.assert_array_equal(rows.settled, [True] * 3 + [False] * 7)
    np.testing.assert_array_equal(rows.lengths[:3], np.float32([0.1, 0.1, 0.16]).astype(float))
    np.testing.assert_array_equal(rows.lengths[3:], [0.1, 0.1, 0.16, 0.1, 0.11, 0.16, 0.2])
    assert rows.name(9) == "constraint 9 of the System (particles 5 and 9, 0.2 nm)"
    x = np.random.default_rng(0).normal(size=(13, 3))
    assert rows.rank(x) == 10


@pytest.mark.parametrize("kind", [ProjectedIntegrator, openmm.VerletIntegrator])
def test_the_length_that_is_off_most(kind):
    system = particles([12.0] * 3, held=[(0, 1, 0.1), (1, 2, 0.2)])
    context = started(system, kind(0.001), [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.1, 0.21, 0.0]])
    name, off = worst_length(context)
    assert "constraint 1 of the System (particles 1 and 2, 0.2 nm)" in name and off == pytest.approx(0.05)
    context.applyConstraints(1e-8)
    assert worst_length(context)[1] < 1e-7
    with pytest.raises(InputError, match=r"context is a System; give the Context, such as simulation\.context"):
        worst_length(system)


def test_lengths_of_rigid_water_are_compared_with_those_of_the_system():
    """Not with those in single precision that OpenMM makes of them."""
    lengths = np.array([0.09572, 0.09572, 0.15139])
    system = particles([16.0, 1.0, 1.0], held=[(0, 1, lengths[0]), (0, 2, lengths[1]), (1, 2, lengths[2])])
    x = [[0.0, 0.05858, 0.0], [-0.0757, 0.0, 0.0], [0.0757, 0.0, 0.0]]
    context = started(system, openmm.VerletIntegrator(0.001), x)
    context.applyConstraints(1e-12)
    rounding = np.abs(lengths.astype(np.float32) / lengths - 1).max()
    assert worst_length(context)[1] == pytest.approx(rounding, rel=1e-6)
    context = context_of(particles([1.0]), openmm.VerletIntegrator(0.001))
    assert worst_length(context) == ("no constraint of the System", 0.0)


@pytest.mark.parametrize(
    ("pairs", "rigid"),
    [
        ([], True),
        ([(0, 1)], True),
        ([(0, 1), (2, 3)], True),
        ([(0, 1), (1, 2)], False),
        ([(0, 1), (1, 2), (0, 2)], True),
        ([(0, 1), (1, 2), (2, 1)], False),
        ([(0, 1), (1, 2), (0, 2), (3, 4)], True),
        ([(0, 1), (1, 2), (0, 2), (2, 3)], False),
        ([(i, j) for i in range(4) for j in range(i)], True),
    ],
)
def test_rigid_bodies_hold_all_their_distances(pairs, rigid):
    assert SystemRows.of(particles([1.0] * 5, held=[(*pair, 0.1) for pair in pairs])).rigid is rigid


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 0, 2), (2, 1, 0)])
@pytest.mark.parametrize("heavier", [0, 1, 2])
def test_triangles_with_unequal_masses_beside_the_apex_are_refused(order, heavier):
    """OpenMM's SETTLE: HDO gains momentum from nothing. Heavy apexes are the rule."""
    x = np.array([[0.0, 0.0585882, 0.0], [-0.075695, 0.0, 0.0], [0.075695, 0.0, 0.0]])
    masses = np.array([16.0, 1.0, 1.0])
    masses[heavier] *= 2
    held = [(i, j, 0.15139 if 0 not in (order[i], order[j]) else 0.09572) for i, j in ((0, 1), (0, 2), (1, 2))]
    system, integrator = particles(masses[list(order)], held=held), ProjectedIntegrator(1e-3)
    context = started(system, integrator, x[list(order)])
    if heavier == 0:
        integrator.applyConstraints(context)
        integrator.step(1)
        return
    with pytest.raises(UnsupportedError, match=r"particles 0, 1 and 2 .* SETTLE"):
        integrator.step(1)


@pytest.mark.parametrize("length", [0.0, -0.1, np.nan, np.inf])
def test_a_length_that_cannot_be_held_is_refused(length):
    # Between particles without mass OpenMM holds nothing.
    system = particles([23.0, 23.0, 0.0, 0.0], held=[(2, 3, length), (0, 1, 0.1)])
    x = np.array([[0.0, 0, 0], [0.1, 0, 0], [1.0, 0, 0], [1.0, 0, 0]])
    kept = started(system, integrator := ProjectedIntegrator(2e-3), x)
    integrator.step(1)
    del kept
    system.setConstraintParameters(1, 0, 1, length)
    for ask in (lambda context: integrator.step(1), worst_length):
        context = started(system, integrator := ProjectedIntegrator(2e-3), x)
        with pytest.raises(
            InputError, match=r"constraint 1 of the System \(particles 0 and 1\) has a length of"
        ) as caught:
            ask(context)
        assert caught.value.atoms == (0, 1)


@pytest.mark.parametrize(
    ("one", "two"), [("isotropic", "isotropic"), ("isotropic", "membrane"), ("anisotropic", "flexible")]
)
def test_two_barostats_are_refused(one, two):
    system, x = water_box(8)
    for name in (one, two):
        system.addForce(BAROSTATS[name](300))
    context = started(system, integrator := ProjectedIntegrator(2e-3, ensemble=Langevin(300, 1.0)), x)
    with pytest.raises(UnsupportedError, match=r"the System has 2 barostats \(.*Remove all but one"):
        integrator.step(1)
    system.getForce(system.getNumForces() - 1).setFrequency(0)  # switched off
    context = started(system, integrator := ProjectedIntegrator(2e-3, ensemble=Langevin(300, 1.0)), x)
    integrator.step(1)
    assert context.getStepCount() == 1
