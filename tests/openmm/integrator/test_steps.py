"""Steps and calls of them: parts are held, failures taken back, and what is left out where nobody looks is no loss."""

from __future__ import annotations

import numpy as np
import openmm
import pytest
from collective_cases import bond
from constraint_cases import blade
from ensemble_runs import in_calls, run
from openmm import unit
from openmm_parts import HeldCoordinates
from openmm_systems import (
    DEVICE,
    alanine,
    context_of,
    dumbbell,
    holding,
    loose_alanine,
    masses_of,
    on_gpus,
    pairs_force,
    particles,
    residuals,
    rows_of,
    started,
    state_of,
    water_box,
)
from tied_cluster import KINDS, carried_at, row_at

from kcons.constraints import Plane
from kcons.errors import ConvergenceError, InputError, NonFiniteError
from kcons.openmm import CollectiveRows, Isokinetic, Langevin, LangevinRespa, ProjectedIntegrator, Row, hold

#: The trap of `tied_cluster` is round.
pytestmark = pytest.mark.filterwarnings("ignore:the forces exert no torque")
PS = unit.picosecond


# -- parts ------------------------------------------------------------------------------------------


class Reluctant(HeldCoordinates):
    """Fails to project velocities where the global variable `reluctant` is 1."""

    def declare(self, program):
        super().declare(program)
        program.number("reluctant", "1 where velocities cannot be projected")

    def project(self, program):
        super().project(program)
        program.let("failed", f"select(reluctant,{self.code},failed)", "told to")


@pytest.mark.parametrize("scheme", ["geodesic", "suzuki4"])
def test_a_failed_step_is_taken_back_and_not_counted(scheme):
    """Where all its drifts went well."""
    system, x, v = loose_alanine()
    integrator = ProjectedIntegrator(1e-3, scheme, parts=[Reluctant([0], 2, x[0, 2], 22)], tolerance=1e-13)
    context = run(system, integrator, x, v, 7)
    before = state_of(context)
    integrator.setGlobalVariableByName("reluctant", 1.0)
    for _ in range(2):
        with pytest.raises(ConvergenceError, match="too steep") as caught:
            integrator.step(5)
        assert caught.value.step == 8
    np.testing.assert_array_equal(state_of(context), before)
    assert context.getStepCount() == 7 and context.getTime() / PS == pytest.approx(0.007, rel=1e-12)
    integrator.setGlobalVariableByName("reluctant", 0.0)
    integrator.step(5)
    undisturbed = ProjectedIntegrator(1e-3, scheme, parts=[Reluctant([0], 2, x[0, 2], 22)], tolerance=1e-13)
    other = run(system, undisturbed, x, v, 12)
    np.testing.assert_allclose(state_of(context), state_of(other), rtol=0, atol=1e-12)


#: Kinds whose steps of a picosecond fail, and the platform.
FAIL = {
    "collective": (row_at, {}),
    "collective, CPU": (row_at, {"platform": "CPU"}),
    "collective beside a constraint": (row_at, {"bonded": True, "scheme": "suzuki4"}),
    "collective, moving, beside a constraint": (row_at, {"bonded": True, "rate": 0.2}),
    "collective, moving": (row_at, {"rate": 0.2}),
    "carried": (carried_at, {}),
    "carried, CPU": (carried_at, {"platform": "CPU"}),
}


@pytest.mark.parametrize("kind", FAIL)
def test_a_step_without_a_solution_is_taken_back(kind):
    """With clocks of targets, which constraints alone do not move, either."""
    make, options = FAIL[kind]
    made = make(**options)
    integrator, context, part = made.integrator, made.context, made.part

    made.run(3)
    before, target = state_of(context), part.targets(context) if make is row_at else None
    integrator.setStepSize(1.0 * PS)
    with pytest.raises(ConvergenceError, match="step 4: ") as caught:
        integrator.step(2)
    assert caught.value.step == 4
    if make is row_at:
        assert "row 0 (my bond) is off by" in str(caught.value) and "iterations" in str(caught.value)
        assert caught.value.row == 0 and caught.value.iterations > 1 and caught.value.residual > part.tolerance
    else:
        assert "time step too large" in str(caught.value) and caught.value.atoms == (0, 7)
    np.testing.assert_array_equal(state_of(context), before)
    assert context.getStepCount() == 3 and context.getTime() / PS == pytest.approx(0.006, rel=1e-12)
    integrator.setStepSize(0.002)
    integrator.applyVelocityConstraints(context)
    integrator.applyConstraints(context)
    assert target is None or part.targets(context) == target
    integrator.step(3)
    integrator.check()
    ends = state_of(context)[0][[0, 7]]
    assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(0.3 + options.get("rate", 0.0) * 0.012, abs=1e-12)
    undisturbed = make(**options)
    undisturbed.run(6)
    np.testing.assert_allclose(state_of(context), state_of(undisturbed.context), rtol=0, atol=1e-11)


def test_change_of_the_box():
    """OpenMM keeps the forces of a CustomIntegrator when the box is changed; `step` sees that."""
    system, x = water_box(27)
    wider = 1.02 * np.array([row._value for row in system.getDefaultPeriodicBoxVectors()])
    context = started(system, integrator := ProjectedIntegrator(1e-3, tolerance=1e-12), x, np.zeros_like(x))
    integrator.step(5)
    context.setPeriodicBoxVectors(*wider)
    fresh = context_of(system, other := ProjectedIntegrator(1e-3, tolerance=1e-12))
    fresh.setPeriodicBoxVectors(*wider)
    fresh.setPositions(state_of(context)[0])
    fresh.setVelocities(state_of(context)[1])
    integrator.step(5)
    other.step(5)
    # SETTLE has lengths in single precision.
    np.testing.assert_allclose(state_of(context)[0], state_of(fresh)[0], rtol=0, atol=1e-7)
    np.testing.assert_allclose(state_of(context)[1], state_of(fresh)[1], rtol=0, atol=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_parameters_of_forces_are_used_in_the_next_step(kind):
    made, fresh, old = KINDS[kind](), KINDS[kind](), KINDS[kind]()
    for one in (made, fresh, old) if "Langevin" in kind else ():
        one.integrator.setFriction(0)
    made.run(5)
    state = made.context.getState(positions=True, velocities=True)
    for one in (made, fresh):
        force = one.context.getSystem().getForce(0)
        force.setBondParameters(0, 1, 0, 0.3, 5000.0)
        force.updateParametersInContext(one.context)
    fresh.context.setState(state)
    made.run(1)
    fresh.run(1)
    np.testing.assert_allclose(state_of(made.context), state_of(fresh.context), rtol=0, atol=1e-9)
    old.context.setState(state)
    old.run(1)
    assert np.abs(state_of(old.context)[1] - state_of(made.context)[1]).max() > 1e-2


# -- calls ------------------------------------------------------------------------------------------

LEAN = ["part", "moving row", "carried", "carried beside bonds", "carried, with a velocity"]


def held(kind, **arguments):
    """An integrator of this kind in its Context, and its part."""
    system, x, v = loose_alanine()
    if kind == "carried":
        system, x, v = alanine()
        part = hold(system, [], x, take="all")
    elif kind == "carried beside bonds":
        part = hold(system, Plane([0], [0, 0, 1]), x)
        assert system.getNumConstraints()
    elif kind == "carried, with a velocity":
        part = hold(system, blade([8, 20]), x)
    elif kind.endswith("row"):
        part = CollectiveRows(system, [Row(bond(4, 20), rate=0.05), Row(bond(0, 9))], positions=x)
    else:
        part = holding(**arguments)
    integrator = ProjectedIntegrator(1e-3, parts=[part], tolerance=1e-13)
    context = started(system, integrator, x, v)
    integrator.applyVelocityConstraints(context)
    return integrator, context, part


@pytest.mark.parametrize("kind", LEAN)
def test_calls_of_any_length_make_the_same_motion(kind):
    """Within a call steps leave out what only a reader of velocities needs."""
    made = in_calls(lambda: held(kind), ([12], [5, 7], [1] * 12, [3, 1, 8]), v=3e-11)
    (one, there, ours), (other, _, theirs) = made[0], made[2]
    if kind.endswith("row"):
        np.testing.assert_allclose(ours.work(one), theirs.work(other), rtol=1e-7, atol=1e-6)
        assert np.abs(ours.rates(there)).max() <= 1e-12


@pytest.mark.parametrize(
    ("make", "more"),
    [
        (lambda system, x: ProjectedIntegrator(1e-3), 0),
        (lambda system, x: ProjectedIntegrator(1e-3, "blanes-moan4"), 0),
        (lambda system, x: ProjectedIntegrator(1e-3, ensemble=Langevin(300, 1.0)), 0),
        (lambda system, x: ProjectedIntegrator(1e-3, ensemble=Isokinetic(300, momentum="free")), 0),
        # Beside parts, one more a call: OpenMM keeps the forces of the last groups only.
        (
            lambda system, x: ProjectedIntegrator(1e-3, parts=[CollectiveRows(system, [Row(bond(2, 5))], positions=x)]),
            1,
        ),
        (lambda system, x: ProjectedIntegrator(1e-3, parts=[hold(system, Plane([5], [0, 0, 1]), x)]), 1),
    ],
    ids=["rattle", "blanes-moan4", "Langevin", "Isokinetic", "collective", "carried"],
)
def test_evaluations_of_forces_in_tens(make, more):
    """OpenMM evaluates the forces once a step (five times in that of order 4), in however many calls."""
    whole, x, v = alanine()
    system = particles(masses_of(whole), held=() if more else rows_of(whole)[0].tolist(), x=x)
    evaluations = []

    def nothing(state):
        evaluations.append(1)
        return 0.0, np.zeros(x.shape)

    system.addForce(openmm.PythonForce(nothing))
    integrator = make(system, x)
    context = run(system, integrator, x, v, 10)
    each = integrator.scheme.force_evaluations
    evaluations.clear()
    for _ in range(5):
        integrator.step(10)
    assert len(evaluations) == 50 * each + 5 * more
    assert context.getStepCount() == 60


def test_failure_where_nobody_looked():
    """The state is complete, that of the step before, and the run can go on."""
    integrator, context, _ = held("part", steepest=2e-4)
    with pytest.raises(ConvergenceError) as caught:
        integrator.step(1000)
    done = context.getStepCount()
    assert caught.value.step == done + 1
    assert 3 < done < 97
    assert context.getTime() / PS == pytest.approx(1e-3 * done, rel=1e-9)
    x, v = state_of(context)
    assert v[0, 2] == 0
    assert residuals(context.getSystem(), context)[1] <= 1e-12
    other, twin, _ = held("part")
    other.step(done)
    np.testing.assert_allclose(state_of(twin)[0], x, rtol=0, atol=1e-14)
    assert np.abs(state_of(twin)[1] - v).max() <= 1e-12
    integrator.setGlobalVariableByName("steepest", np.inf)
    integrator.step(20)
    other.step(20)
    assert np.abs(state_of(twin)[0] - state_of(context)[0]).max() <= 1e-12


@pytest.mark.parametrize("kind", ["constant energy", "carried"])
def test_a_number_of_steps_that_is_none_is_refused(kind):
    """Nothing moves; whole numbers of any kind are taken."""
    made = KINDS[kind]()
    for wrong in (2.5, "3", None, -1, True):
        with pytest.raises(InputError, match=r"steps is .*; give a whole number, 0 or more") as caught:
            made.integrator.step(wrong)
        assert caught.value.item == "steps"
    assert made.context.getStepCount() == 0
    for steps in (0, 2, 3.0, np.int64(4)):
        made.integrator.step(steps)
    assert made.context.getStepCount() == 9


@pytest.mark.parametrize("before", [100, 0])
def test_checks_that_come_more_often_make_no_step_more(before):
    """Steps since the last check may be more than the new interval."""
    system, x, v = dumbbell()
    integrator = ProjectedIntegrator(1e-3, check_every=before)
    context = run(system, integrator, x, v, 50)
    integrator.check_every = 10
    integrator.step(100)
    assert context.getStepCount() == 150
    at_once = ProjectedIntegrator(1e-3)
    other = run(system, at_once, x, v, 150)
    np.testing.assert_array_equal(state_of(context)[0], state_of(other)[0])


# -- a look where a call ends ------------------------------------------------------------------------

LOOKING = {
    "rattle": {},
    "suzuki4": {"scheme": "suzuki4"},
    "Langevin": {"ensemble": Langevin(300, 1.0)},
    "LangevinRespa": {"ensemble": LangevinRespa(300, 1.0, {0: 1, 1: 2})},
    "device": {"device": True},
    "device, Langevin": {"device": True, "ensemble": Langevin(300, 1.0)},
}


def springs(n=8):
    """A chain of stiff springs that no step of 20 fs can follow, and none of the solvers of constraints notice."""
    force = pairs_force(openmm.HarmonicBondForce(), *((k - 1, k, 0.1, 3e5) for k in range(1, n)))
    force.setForceGroup(1)
    system = particles([12.0] * n, force)
    x = np.c_[0.1 * np.arange(n), 0.05 * (np.arange(n) % 2), np.zeros(n)]
    v = np.random.default_rng(2).normal(0, 0.4, x.shape)
    return system, x, v - v.mean(axis=0)


@pytest.mark.parametrize(
    ("name", "call", "platform"),
    [
        ("rattle", 1, "Reference"),
        *(pytest.param(name, 10, "Reference", marks=DEVICE.marks if "device" in name else ()) for name in LOOKING),
        *(pytest.param("rattle", 10, *p.values, id=p.id, marks=p.marks) for p in on_gpus("mixed")),
        *(pytest.param("device", 10, *p.values, id=f"device-{p.id}", marks=p.marks) for p in on_gpus("mixed")),
    ],
)
def test_an_explosion_is_told_where_its_call_ends(name, call, platform):
    """Without any check but the first: lengths do not become 1e62 nm without a word."""
    system, x, v = springs()
    integrator = ProjectedIntegrator(20 * unit.femtosecond, check_every=0, **LOOKING[name])
    context = started(system, integrator, x, v, platform)
    x, v = state_of(context)
    with pytest.raises(NonFiniteError, match="take a smaller time step") as caught:
        for _ in range(200):
            integrator.step(call)
            assert np.abs(state_of(context)[1]).max() < 1e6
    assert caught.value.step % call == 0 and 0 <= caught.value.atom < 8
    np.testing.assert_array_equal(state_of(context), [x, v])
    assert context.getStepCount() == 0
    integrator.setStepSize(0.5 * unit.femtosecond)
    integrator.step(call)


def test_light_is_the_limit_and_no_smaller_speed():
    """Particles may be fast: 1 dalton at a tenth of the speed of light is no explosion of a System of many."""
    system, x, _ = springs()
    integrator = ProjectedIntegrator(1e-6 * unit.femtosecond, check_every=0)
    context = run(system, integrator, x, np.eye(8)[:, :3] * 3e4, 1)
    context.setVelocities(np.full((8, 3), 3e5))
    with pytest.raises(NonFiniteError, match=r"particle \d has a velocity of 5.2e\+05 nm/ps at step 2"):
        integrator.step(1)
