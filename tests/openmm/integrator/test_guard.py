"""What an integrator sees of its Context, before and during a run."""

from __future__ import annotations

import copy
import re

import numpy as np
import openmm
import pytest
from collective_cases import bond, dihedral, points, with_variable
from ensemble_runs import in_calls, run
from openmm_systems import (
    DEVICE,
    PLATFORMS,
    alanine,
    dumbbell,
    field,
    free_alanine,
    hexagon,
    holding,
    image,
    loose_alanine,
    pairs_force,
    particles,
    residuals,
    started,
    state_of,
    with_and_without_device,
)

from kcons.constraints import Plane, Sphere
from kcons.errors import ConvergenceError, InputError, KconsError, NonFiniteError, UnsupportedError
from kcons.openmm import CollectiveRows, Isokinetic, Langevin, NoseHoover, ProjectedIntegrator, Row, hold
from kcons.openmm.integrator import guard

platforms = pytest.mark.parametrize("platform", PLATFORMS)


# -- its Context ------------------------------------------------------------------------------------


def test_finds_its_context(monkeypatch):
    """Looked for once."""
    system, x, v = dumbbell()
    first, second, third = (ProjectedIntegrator(1e-3) for _ in range(3))
    with pytest.raises(UnsupportedError, match="belongs to no Context"):
        first.step(1)
    contexts = [started(system, integrator, x, v) for integrator in (first, second, third)]
    vars(contexts[1])  # attributes are a dictionary of their own then
    for k, integrator in enumerate((first, second, third)):
        assert integrator.context is contexts[k]
    with pytest.raises(InputError, match="another integrator"):
        first.attach(contexts[1])
    asked, find = [], guard.gc.get_referrers
    monkeypatch.setattr(guard.gc, "get_referrers", lambda *given: asked.append(1) or find(*given))
    for _ in range(3):
        second.step(2)
        second.degrees_of_freedom()
        second.check()
    assert len(asked) <= 3 and contexts[1].getStepCount() == 6
    asked.clear()
    second.step(2)
    assert not asked
    third.attach(contexts[2])
    third.step(1)
    assert contexts[2].getStepCount() == 1
    contexts.pop()
    with pytest.raises(UnsupportedError, match="belongs to no Context"):
        third.step(1)


@with_and_without_device
def test_compound_integrator(device):
    """OpenMM runs the bare program; checks and steps of its own are to be had once it knows the Context."""
    system, x, v = alanine()
    alone, ours = (ProjectedIntegrator(1e-3, device=device) for _ in range(2))
    lonely = run(system, alone, x, v, 10)
    compound, other = openmm.CompoundIntegrator(), openmm.VerletIntegrator(1e-3)
    compound.addIntegrator(ours)
    compound.addIntegrator(other)
    context = started(system, compound, x, v)
    with pytest.raises(UnsupportedError, match=r"call integrator\.attach"):
        ours.step(1)
    compound.step(10)
    ours.attach(context)
    ours.check()
    # On the device each step ends there, so that tolerances come in more often.
    np.testing.assert_allclose(state_of(context), state_of(lonely), rtol=0, atol=1e-8 if device else 1e-9)
    assert ours.degrees_of_freedom() == alone.degrees_of_freedom()
    compound.setCurrentIntegrator(1)
    compound.step(2)
    compound.setCurrentIntegrator(0)
    ours.step(2)
    assert context.getStepCount() == 14


def test_a_member_of_a_compound_integrator_stops_where_a_part_fails():
    """Nothing moves from there on, and `check` tells."""
    system, x, v = loose_alanine()
    compound, ours = openmm.CompoundIntegrator(), ProjectedIntegrator(1e-3, parts=[holding(steepest=-1.0)])
    compound.addIntegrator(ours)
    context = started(system, compound, x, v)
    before = state_of(context)
    compound.step(5)
    np.testing.assert_array_equal(state_of(context), before)
    ours.attach(context)
    with pytest.raises(ConvergenceError, match="too steep"):
        ours.check()


# -- the start --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("stretch", "speed", "error", "words"),
    [
        (0.03, 1.0, InputError, r"constraint \d+ of the System .* at the start; minimize"),
        (None, 1.0, InputError, "at the start; set positions first"),
        (0.0, np.nan, NonFiniteError, "velocity of particle 0"),
        (0.003, 1.0, None, r"the start was put right: constraint \d+ of the System"),
    ],
    ids=["off the constraints", "without positions", "not finite", "a little off"],
)
def test_starts_that_are_refused_or_put_right(stretch, speed, error, words, caplog):
    system, x, v = alanine()
    x[4] += stretch or 0.0
    x = 0 * x if stretch is None else x
    context = started(system, integrator := ProjectedIntegrator(1e-3), x, speed * v)
    if error is None:
        integrator.step(1)
        assert re.search(words, caplog.text) and residuals(system, context)[0] < 1e-9
        caplog.clear()
        integrator.step(3)
        assert not caplog.text
        return
    with pytest.raises(error, match=words) as caught:
        integrator.step(5)
    np.testing.assert_array_equal(state_of(context), [x, speed * v])
    assert context.getStepCount() == 0
    if stretch:
        assert 4 in caught.value.atoms
        integrator.applyConstraints(context)
        integrator.step(5)
        assert residuals(system, context)[0] < 1e-9


#: Rows of each kind, on their targets at x.
NEARLY = {
    "distance": lambda system, x: CollectiveRows(system, [Row(bond(4, 14))], positions=x),
    "dihedral": lambda system, x: CollectiveRows(system, [Row(dihedral(4, 6, 8, 14))], positions=x),
    "sphere": lambda system, x: hold(system, Sphere([3], center=(0.0, 0.0, 0.0)), x),
    "plane": lambda system, x: hold(system, Plane([3], normal=(0.0, 0.0, 1.0)), x),
}


@pytest.mark.parametrize("kind", NEARLY)
@pytest.mark.parametrize(("off", "near"), [(0.006, True), (0.2, False)])
def test_rows_that_are_near_are_put_right_in_the_first_step(kind, off, near, caplog):
    """As constraints of the System are: with a note in the log; farther ones are refused and nothing moves."""
    system, x, v = free_alanine()
    part = NEARLY[kind](system, x)
    x[[3, 4]] += off * np.array([0.3, 0.5, 0.8])
    integrator = ProjectedIntegrator(1e-3, parts=[part])
    context = started(system, integrator, x, v)
    if near:
        assert part.worst_violation(context, velocities=False).near
        with caplog.at_level("WARNING", logger="kcons.openmm"):
            integrator.step(1)
        assert "the start was put right: the positions are off row" in caplog.text
        assert part.worst_violation(context) is None
        assert np.abs(state_of(context)[0] - x).max() < 3 * off
        return
    with pytest.raises(KconsError, match=r"call restore|apply_positions"):
        integrator.step(1)
    np.testing.assert_array_equal(state_of(context), [x, v])


def test_rows_that_constraints_of_the_system_pull_off_are_put_right_too():
    """A row that shares particles with them, on its target at the start, as coordinates of a file are."""
    system, x, _ = alanine()
    x = x + np.random.default_rng(1).normal(0, 1e-6, x.shape)
    rows = CollectiveRows(system, [bond(0, 10)], positions=x, meets_system=True)
    context = started(system, integrator := ProjectedIntegrator(1e-3, parts=[rows]), x)
    integrator.step(2)
    assert abs(rows.residuals(context)[0]) < 1e-10
    integrator.check()


@pytest.mark.parametrize("together", [False, True])
def test_a_row_that_is_far_off_keeps_the_others_where_they_are(together):
    system, x, v = free_alanine()
    planes = [Plane([k], (0.0, 0.0, 1.0), float(x[k, 2]) + off) for k, off in ((3, 0.004), (9, 0.5))]
    integrator = ProjectedIntegrator(1e-3, parts=[hold(system, rows, x) for rows in ([planes] if together else planes)])
    context = started(system, integrator, x, v)
    with pytest.raises(InputError, match="apply_positions"):
        integrator.step(1)
    np.testing.assert_array_equal(state_of(context), [x, v])


# -- checks during a run ----------------------------------------------------------------------------


@platforms
@pytest.mark.parametrize(("rows", "error"), [(9, ConvergenceError), (12, NonFiniteError)])
def test_solvers_that_do_not_converge_are_found(rows, error, platform):
    """A planar ring by many of its distances breaks OpenMM's solver, which says nothing."""
    system, x = hexagon(rows)
    v = np.random.default_rng(0).normal(size=x.shape)
    integrator = ProjectedIntegrator(2e-3, check_every=5)
    context = started(system, integrator, x, v, platform)
    with pytest.raises(error) as caught:
        integrator.step(100)
    assert np.isfinite(state_of(context)).all()
    assert context.getStepCount() % 5 == 0
    assert "hand them over" in str(caught.value)
    if rows == 9:
        # The state that is left is on the constraints, and is that of a run with as many steps.
        assert residuals(system, context)[0] <= 2.1e-10
        assert len(caught.value.atoms) == 2
        assert caught.value.residual > 2e-10
        assert caught.value.step == context.getStepCount() + 5
        shorter = ProjectedIntegrator(2e-3)
        other = run(system, shorter, x, v, context.getStepCount(), platform)
        np.testing.assert_array_equal(state_of(context), state_of(other))


@pytest.mark.parametrize(("given", "number"), [({}, 2), ({"check_every": 100}, 104)])
def test_checks_that_would_take_too_long_come_later(monkeypatch, given, number):
    """No share of the time is left for them here; an interval that was asked for is kept."""
    monkeypatch.setattr(guard, "SHARE", 0.0)
    checks = []
    check = guard.Guard.check
    monkeypatch.setattr(guard.Guard, "check", lambda self: checks.append(1) or check(self))
    system, x, v = dumbbell()
    integrator = ProjectedIntegrator(1e-4, **given)
    context = run(system, integrator, x, v, 100 * 104)
    # Of the first it is not known how long it takes; after it, a hundred are put off each time.
    assert len(checks) == number
    assert context.getStepCount() == 10400


#: With motion removers, which meet complete velocities: half a kick has momentum where forces add up to something.
BATHS = {
    "Isokinetic": Isokinetic(300, momentum="free"),
    "Langevin": Langevin(300, 0.0),
    "NoseHoover": NoseHoover(300, 5.0, momentum="free"),
}


def the_same_in_any_calls(system, x, v, steps, **options):
    """Where steps lead, however they are divided into calls."""

    def begun():
        integrator = ProjectedIntegrator(1e-3, tolerance=1e-13, **options)
        return integrator, started(system, integrator, x, v)

    return state_of(in_calls(begun, ([steps], [5, steps - 5], [1] * steps), 1e-11, 1e-9)[0][1])


def external(n):
    return field("50*((x-1)^2+y^2+z^2)", n)


def collective(n):
    return with_variable("20*pull", pull=points("500*x1^2", [0]))


@pytest.mark.parametrize(
    ("kind", "force"),
    [
        *((kind, external) for kind in ("constant energy", *BATHS, "carried")),
        pytest.param("device", external, marks=DEVICE.marks),
        ("Langevin", collective),
    ],
)
def test_a_motion_remover_meets_complete_velocities_beside_forces_that_know_a_place(kind, force):
    system, x, v = alanine()
    system.addForce(force(len(x)))
    assert openmm.CMMotionRemover in {type(force) for force in system.getForces()}
    end = the_same_in_any_calls(system, x, v, 12, ensemble=BATHS.get(kind), device=kind == "device")
    if kind == "carried":
        carried = copy.deepcopy(system)
        same = the_same_in_any_calls(carried, x, v, 12, parts=[hold(carried, [], x, take="all")])
        np.testing.assert_allclose(same[0], end[0], rtol=0, atol=1e-11)
        np.testing.assert_allclose(same[1], end[1], rtol=0, atol=1e-8)


@pytest.mark.parametrize("kind", [*BATHS, "constant energy", pytest.param("device, images", marks=DEVICE.marks)])
def test_a_motion_remover_meets_complete_velocities_beside_particles_without_mass(kind):
    """They take up momentum that forces between particles give, and images turn it: half a kick has some."""
    rng, pairs = np.random.default_rng(1), [(j, k) for k in range(5) for j in range(k)]
    springs = pairs_force(openmm.CustomBondForce("200*(r-0.3)^2"), *pairs)
    system = particles([0.0, 0.0, 20.0, 25.0, 30.0], springs, openmm.CMMotionRemover())
    x = np.array([[0, 0, 0], [0.4, 0, 0], [0.1, 0.3, 0], [0.2, 0.1, 0.3], [0.3, 0.3, 0.3]])
    v = np.vstack([np.zeros((2, 3)), rng.normal(size=(3, 3))])
    for k in (0, 1) if "images" in kind else ():
        system.setVirtualSite(k, image(k + 2))
    the_same_in_any_calls(system, x, v, 40, ensemble=BATHS.get(kind), device="device" in kind)


def test_rows_beside_a_motion_remover_know_no_place():
    """Steps leave out what only an observer needs there: forces that carry rows are none."""
    system, x, v = alanine()
    part = hold(system, [], x, take="all")
    context = started(system, integrator := ProjectedIntegrator(1e-3, parts=[part]), x, v)
    integrator.step(1)
    assert integrator._guard.undisturbed
    del context
