"""Steps that a Simulation asks for in tens: the same motion, and the same work, as in one long call."""

from __future__ import annotations

import contextlib
import gc
from collections import Counter

import numpy as np
import openmm
import pytest
from openmm import app, unit
from openmm_systems import (
    PLATFORMS,
    alanine,
    context_of,
    dumbbell,
    on_gpus,
    residuals,
    started,
    state_of,
)

from kcons.errors import InputError, KconsError, NonFiniteError
from kcons.openmm import Isokinetic, Langevin, LangevinRespa, ProjectedIntegrator, RattleIntegrator
from kcons.openmm.integrator.states import calls
from tests.openmm.integrator.states.test_settings import KINDS, carried_at

#: The trap of `cluster` is round.
pytestmark = pytest.mark.filterwarnings("ignore:the forces exert no torque")

kinds = pytest.mark.parametrize("kind", KINDS)


def topology_of(system):
    topology = app.Topology()
    residue = topology.addResidue("X", topology.addChain())
    for k in range(system.getNumParticles()):
        topology.addAtom(f"C{k}", app.element.carbon, residue)
    return topology


def simulated(made):
    """A Simulation of what there is."""
    simulation = app.Simulation.__new__(app.Simulation)
    simulation.context, simulation.integrator, simulation.reporters = made.context, made.integrator, []
    simulation._usesPBC = False
    return simulation


class Look:
    """A reporter that keeps what it is shown."""

    def __init__(self, every, **include):
        self.every, self.include, self.seen = every, list(include), []

    def describeNextReport(self, simulation):
        return {"steps": self.every - simulation.currentStep % self.every, "periodic": False, "include": self.include}

    def report(self, simulation, state):
        arrays = [np.array(state.getPositions(asNumpy=True)._value), np.array(state.getVelocities(asNumpy=True)._value)]
        self.seen.append((state.getStepCount(), state.getTime()._value, *arrays))


@pytest.fixture
def made_by_openmm(monkeypatch):
    """How many steps OpenMM makes of each kind: of VerletIntegrator, and of programs by what controls them."""
    count: Counter[object] = Counter()
    program, verlet = openmm.CustomIntegrator.step, openmm.VerletIntegrator.step

    def custom(self, steps):
        read = self.getGlobalVariableByName
        count[tuple(read(name) for name in ("between", "end") if name in self.program.numbers)] += steps
        program(self, steps)

    def leapfrog(self, steps):
        count["leapfrog"] += steps
        verlet(self, steps)

    monkeypatch.setattr(openmm.CustomIntegrator, "step", custom)
    monkeypatch.setattr(openmm.VerletIntegrator, "step", leapfrog)
    return count


def begun(kind):
    """Random numbers of the Reference platform belong to the process: they begin with the Context."""
    made = KINDS[kind]()
    if "Langevin" in kind:
        state = made.context.getState(positions=True, velocities=True)
        made.integrator.setRandomNumberSeed(4)
        made.context.reinitialize()
        made.context.setState(state)
    made.integrator.step(1)
    return made


@kinds
def test_tens_cost_what_one_call_costs(kind, made_by_openmm):
    """Step by step of each kind, whatever it computes; and no bit of the motion differs."""
    ends, work = [], []
    for whole in (True, False):
        made = begun(kind)
        made_by_openmm.clear()
        if whole:
            made.integrator.step(95)
        else:
            simulated(made).step(95)
        made_by_openmm.pop((3.0,), None)  # a look where a call ends, no step
        work.append(dict(made_by_openmm))
        ends.append(state_of(made.context))
        assert made.context.getStepCount() == 96
        assert made.context.getTime()._value == pytest.approx(0.192, rel=1e-12)
    np.testing.assert_array_equal(*ends)
    assert work[0] == work[1]
    assert sum(work[0].values()) in (95, 96)


@kinds
def test_reporters_see_complete_states(kind):
    made, other = begun(kind), begun(kind)
    if "Langevin" in kind:  # one after the other, for they share their random numbers
        made = begun(kind)
    look = Look(25, positions=True, velocities=True)
    simulation = simulated(made)
    simulation.reporters.append(look)
    simulation.step(60)
    if "Langevin" in kind:
        other = begun(kind)
    for (count, time, x, v), steps in zip(look.seen, (24, 25), strict=True):
        other.integrator.step(steps)
        assert count == other.context.getStepCount()
        assert time == pytest.approx(other.context.getTime()._value, rel=1e-12)
        np.testing.assert_array_equal([x, v], state_of(other.context))


@pytest.mark.parametrize("kind", ["RattleIntegrator", "carried", "Isokinetic"])
def test_what_a_context_says_between_calls(kind):
    """Whatever is asked or told, what was put off is made first."""
    acts = [
        lambda c: c.getStepCount(),
        lambda c: c.getTime(),
        lambda c: c.getState(velocities=True),
        lambda c: c.createCheckpoint(),
        lambda c: c.setVelocities(0.9 * state_of(c)[1]),
        lambda c: c.setPositions(state_of(c)[0]),
        lambda c: c.setTime(c.getTime()),
        lambda c: c.applyVelocityConstraints(1e-10),
        lambda c: c.reinitialize(True),
    ]
    for act in acts:
        ends = []
        for unseen in (False, True):
            made = begun(kind)
            member = getattr(made.integrator, "_ends", made.integrator)
            member.unseen = unseen
            made.integrator.step(10)
            made.integrator.step(10)
            assert bool(member._owed) == unseen == bool(calls._OWING)
            act(made.context)
            assert not calls._OWING
            assert made.context.getStepCount() == 21
            made.integrator.step(10)
            ends.append(state_of(made.context))
            assert not calls._OWING
        # How calls divide steps changes the rounding of these two.
        within = 1e-12 if kind in ("RattleIntegrator", "Isokinetic") else 0.0
        np.testing.assert_allclose(*ends, rtol=0, atol=within)


def test_checks_in_tens():
    """Every 20 steps: those at whose end there is a check are complete, and failures are found there."""
    made = carried_at()
    made.integrator.check_every = 20
    simulation = simulated(made)
    simulation.step(100)
    solve = made.part.motion.project_positions

    def astray(*arguments, **options):
        result = solve(*arguments, **options)
        options["velocities"][0] += 1e-5
        return result

    made.part.motion.project_positions = astray
    with pytest.raises(KconsError, match="back at step 100"):
        simulation.step(95)
    assert made.context.getStepCount() == 100
    assert not calls._OWING
    made.part.motion.project_positions = solve
    simulation.step(20)
    assert made.context.getStepCount() == 120


@pytest.mark.parametrize("kind", [RattleIntegrator, ProjectedIntegrator])
def test_explosions_in_tens(kind):
    system, x, v = dumbbell()
    system.addForce(openmm.CustomCompoundBondForce(2, "k*sqrt(0.2-x1); k=1"))
    system.getForce(1).addBond([0, 1], [])
    v = v + np.array([8.0, 0, 0])
    integrator = kind(1e-3, check_every=50)
    place = openmm.Platform.getPlatformByName("Reference")
    simulation = app.Simulation(topology_of(system), system, integrator, place)
    simulation.context.setPositions(x - [0.3, 0, 0])
    simulation.context.setVelocities(v)
    with pytest.raises(NonFiniteError):
        simulation.step(200)
    assert simulation.currentStep == 0
    assert not calls._OWING
    assert np.isfinite(state_of(simulation.context)).all()


def test_an_interruption_leaves_a_complete_state():
    system, x, v = alanine()
    context = started(system, integrator := RattleIntegrator(1e-3), x, v)
    simulation = app.Simulation.__new__(app.Simulation)
    simulation.context, simulation.integrator, simulation._usesPBC = context, integrator, False

    class Stop(Look):
        def report(self, simulation, state):
            raise KeyboardInterrupt

    simulation.reporters = [Stop(30)]
    leap, left = integrator._leap, []
    integrator._leap = lambda *given: left.append(1) or leap(*given)
    with pytest.raises(KeyboardInterrupt):
        simulation.step(100)
    assert len(left) == 3
    assert simulation.currentStep == 30
    assert residuals(system, context)[1] < 1e-9
    simulation.reporters = []
    simulation.step(10)
    other = started(system, whole := RattleIntegrator(1e-3), x, v)
    whole.step(40)
    np.testing.assert_allclose(state_of(context), state_of(other), rtol=0, atol=1e-9)


def test_run_for_clock_time(tmp_path):
    system, x, v = alanine()
    simulation = app.Simulation(
        topology_of(system), system, RattleIntegrator(1e-3), openmm.Platform.getPlatformByName("Reference")
    )
    simulation.context.setPositions(x)
    simulation.context.setVelocities(v)
    simulation.runForClockTime(0.05 * unit.second, stateFile=str(tmp_path / "end.xml"))
    steps = simulation.currentStep
    assert steps > 0
    assert residuals(system, simulation.context)[1] < 1e-9
    saved = openmm.XmlSerializer.deserialize((tmp_path / "end.xml").read_text())
    np.testing.assert_allclose(saved.getVelocities(asNumpy=True)._value, state_of(simulation.context)[1])
    context = started(system, whole := RattleIntegrator(1e-3), x, v)
    whole.step(min(steps, 200))
    if steps <= 200:
        np.testing.assert_allclose(state_of(context)[0], state_of(simulation.context)[0], rtol=0, atol=1e-8)


def test_evaluations_of_forces_in_tens():
    """OpenMM evaluates the forces once a step, and once more at the start."""
    system, x, v = dumbbell()
    evaluations = []

    def nothing(state):
        evaluations.append(1)
        return 0.0, np.zeros((2, 3))

    system.addForce(openmm.PythonForce(nothing))
    for make in (
        lambda: RattleIntegrator(1e-3),
        lambda: ProjectedIntegrator(1e-3),
        lambda: ProjectedIntegrator(1e-3, "leapfrog"),
        lambda: ProjectedIntegrator(1e-3, ensemble=Langevin(300, 1.0)),
    ):
        simulation = app.Simulation(topology_of(system), system, make(), openmm.Platform.getPlatformByName("Reference"))
        simulation.context.setPositions(x)
        simulation.context.setVelocities(v)
        simulation.step(1)
        evaluations.clear()
        simulation.step(200)
        assert len(evaluations) == 200


def test_others_are_left_alone():
    system, x, _ = dumbbell()
    context = context_of(system, openmm.VerletIntegrator(1e-3))
    context.setPositions(x)
    simulation = app.Simulation.__new__(app.Simulation)
    simulation.context, simulation.integrator = context, context.getIntegrator()
    simulation.reporters, simulation._usesPBC = [], False
    simulation.step(25)
    assert simulation.currentStep == 25
    assert app.Simulation.step.__doc__.startswith("Advance the simulation")


def test_a_context_at_the_address_of_one_that_is_gone_owes_nothing():
    """An integrator may outlive its Context, whose address the next one may get."""
    system, x, v = alanine("HBonds")
    integrator = ProjectedIntegrator(1e-3, ensemble=Langevin(300, 1))
    context = started(system, integrator, x, v)
    integrator.unseen = True
    integrator.step(10)
    assert calls._OWING[int(context.this)] is integrator
    other = started(system, ProjectedIntegrator(1e-3), x, v)
    calls._OWING[int(other.this)] = integrator
    del context
    gc.collect()
    assert integrator.bereft
    np.testing.assert_array_equal(state_of(other)[0], x)
    assert int(other.this) not in calls._OWING


def test_what_is_put_off_keeps_no_integrator():
    system, x, v = alanine("HBonds")
    integrator = ProjectedIntegrator(1e-3, ensemble=Langevin(300, 1))
    context = started(system, integrator, x, v)
    integrator.unseen = True
    integrator.step(10)
    address = int(context.this)
    assert address in calls._OWING
    del context, integrator
    gc.collect()
    assert address not in calls._OWING


@pytest.mark.parametrize("kind", ["constant energy", "RattleIntegrator", "sphere"])
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
    context = started(system, integrator, x, v)
    integrator.step(50)
    integrator.check_every = 10
    integrator.step(100)
    assert context.getStepCount() == 150
    at_once = ProjectedIntegrator(1e-3)
    other = started(system, at_once, x, v)
    at_once.step(150)
    np.testing.assert_array_equal(state_of(context)[0], state_of(other)[0])


# -- a look where a call ends ------------------------------------------------------------------------

LOOKING = {
    "rattle": lambda step: ProjectedIntegrator(step, check_every=0),
    "leapfrog": lambda step: ProjectedIntegrator(step, "leapfrog", check_every=0),
    "suzuki4": lambda step: ProjectedIntegrator(step, "suzuki4", check_every=0),
    "Langevin": lambda step: ProjectedIntegrator(step, check_every=0, ensemble=Langevin(300, 1.0)),
    "LangevinRespa": lambda step: ProjectedIntegrator(
        step, check_every=0, ensemble=LangevinRespa(300, 1.0, {0: 1, 1: 2})
    ),
    "Isokinetic": lambda step: ProjectedIntegrator(step, check_every=0, ensemble=Isokinetic(300)),
    "RattleIntegrator": lambda step: RattleIntegrator(step, check_every=0),
}


def springs(n=8):
    """A chain of stiff springs that no step of 20 fs can follow, and none of the solvers of constraints notice."""
    system, force = openmm.System(), openmm.HarmonicBondForce()
    for k in range(n):
        system.addParticle(12.0)
        if k:
            force.addBond(k - 1, k, 0.1, 3e5)
    force.setForceGroup(1)
    system.addForce(force)
    x = np.c_[0.1 * np.arange(n), 0.05 * (np.arange(n) % 2), np.zeros(n)]
    v = np.random.default_rng(2).normal(0, 0.4, x.shape)
    return system, x, v - v.mean(axis=0)


@pytest.mark.parametrize("platform", ["Reference", *on_gpus("mixed")])
@pytest.mark.parametrize("call", [1, 10, 25])
@pytest.mark.parametrize("name", [name for name in LOOKING if name != "Isokinetic"])
def test_an_explosion_is_told_where_its_call_ends(name, call, platform):
    """Without any check but the first: lengths do not become 1e62 nm without a word."""
    if call != 10 and platform != "Reference":
        pytest.skip("each Context compiles its program")
    system, x, v = springs()
    integrator = LOOKING[name](20 * unit.femtosecond)
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


@pytest.mark.parametrize("name", ["rattle", "Langevin", "RattleIntegrator"])
def test_a_simulation_tells_of_an_explosion(name):
    system, x, v = springs()
    integrator = LOOKING[name](20 * unit.femtosecond)
    place = openmm.Platform.getPlatformByName("Reference")
    simulation = app.Simulation(topology_of(system), system, integrator, place)
    simulation.context.setPositions(x)
    simulation.context.setVelocities(v)
    with pytest.raises(NonFiniteError, match="velocity of"):
        simulation.step(60)
    np.testing.assert_array_equal(state_of(simulation.context), [x, v])


@pytest.mark.parametrize("platform", [*PLATFORMS, *on_gpus("mixed")])
@pytest.mark.parametrize("name", LOOKING)
def test_a_look_changes_nothing(name, platform):
    system, x, v = springs()
    ends = []
    for looked in (True, False):
        integrator = LOOKING[name](0.5 * unit.femtosecond)
        if name.startswith("Langevin"):
            integrator.setFriction(0)  # no noise, which numbers drawn for the look would change
        context = started(system, integrator, x, v, platform)
        if not looked:
            inner = getattr(integrator, "_ends", integrator)
            inner.ending = contextlib.nullcontext
            inner._watch(context).look = lambda: None
        for _ in range(3):
            integrator.step(7)
        ends.append(state_of(context))
    np.testing.assert_array_equal(*ends)


def test_light_is_the_limit_and_no_smaller_speed():
    """Particles may be fast: 1 dalton at a tenth of the speed of light is no explosion of a System of many."""
    system, x, _ = springs()
    integrator = LOOKING["rattle"](1e-6 * unit.femtosecond)
    context = started(system, integrator, x, np.eye(8)[:, :3] * 3e4)
    integrator.step(1)
    context.setVelocities(np.full((8, 3), 3e5))
    with pytest.raises(NonFiniteError, match=r"particle \d has a velocity of 5.2e\+05 nm/ps at step 2"):
        integrator.step(1)
