"""Steps on the device beside those of the CustomIntegrator, and what OpenMM asks of an integrator."""

import copy
import threading

import numpy as np
import openmm
import pytest
from device_systems import waters
from openmm import app
from openmm_systems import GPUS, LONG, context_of, dumbbell, field, particles, residuals, started, state_of

from kcons.constraints import Distance, Plane
from kcons.errors import ConvergenceError, UnsupportedError
from kcons.openmm import (
    DeviceIntegrator,
    HamiltonianMonteCarlo,
    Isokinetic,
    Langevin,
    LangevinRespa,
    NoseHoover,
    NoseHooverMiddle,
    ProjectedIntegrator,
    hold,
)
from kcons.openmm.device import build
from kcons.openmm.device.kernels import Op, divided, joined

pytestmark = pytest.mark.skipif(bool(build.refusal()), reason=build.refusal())
PLAIN = ["Reference", "CPU"]
PLATFORMS = [*PLAIN, *GPUS]
#: Schemes and ensembles without noise.
STEPS = {
    "rattle": ("rattle", None),
    "geodesic": ("geodesic", None),
    "suzuki4": ("suzuki4", None),
    "blanes-moan4": ("blanes-moan4", None),
    "kahan-li6": ("kahan-li6", None),
    "blanes-moan6": ("blanes-moan6", None),
    "Isokinetic": ("rattle", Isokinetic()),
    "isokinetic4": ("isokinetic4", Isokinetic(300.0)),
    "NoseHoover": ("rattle", NoseHoover(300.0, 10.0, length=4)),
    "NoseHooverMiddle": ("rattle", NoseHooverMiddle(300.0, 10.0)),
    "friction": ("rattle", Langevin(0.0, 5.0)),
    "several steps": ("rattle", LangevinRespa(0.0, 2.0, {0: 1, 1: 4})),
}


def run(integrator, system, x, v, platform="Reference", calls=(50, 50)):
    context = started(system, integrator, x, v, platform)
    for steps in calls:
        integrator.step(steps)
    return context


def difference(one, other):
    return max(np.abs(a - b).max() for a, b in zip(state_of(one), state_of(other), strict=True))


# -- trajectories -------------------------------------------------------------------------------------


def cases():
    """All on platforms that all have; on others what goes through each kind of kernel, the rest in long runs."""
    for name in STEPS:
        yield from (pytest.param(name, platform, id=f"{name}-{platform}") for platform in PLAIN)
        for given in GPUS:
            usual = name in ("rattle", "Isokinetic", "NoseHoover") and given.id.endswith(("mixed", "none"))
            if usual or given.id.endswith("double") or name in ("rattle", "Isokinetic"):
                marks = [*given.marks, *([] if usual else [LONG])]
                yield pytest.param(name, *given.values, id=f"{name}-{given.id}", marks=marks)


@pytest.mark.parametrize(("name", "platform"), list(cases()))
def test_trajectories_are_those_of_the_custom_integrator(name, platform):
    scheme, ensemble = STEPS[name]
    precision = platform.partition(" ")[2] or "double"
    system, x, v = waters(groups=name == "several steps")
    # With a cutoff below the size of atoms, what differs grows fast.
    calls = (60, 40) if precision == "double" and not (name == "several steps" and platform not in PLAIN) else (6, 4)
    tolerance = {"double": 1e-13, "mixed": 1e-9, "single": 3e-6}[precision]
    made = {"scheme": scheme, "ensemble": ensemble, "tolerance": tolerance}
    contexts = [run(ProjectedIntegrator(0.001, device=d, **made), system, x, v, platform, calls) for d in (True, False)]
    assert type(contexts[0].getIntegrator()) is DeviceIntegrator
    (x1, v1), (x2, v2) = (state_of(context) for context in contexts)
    # OpenMM's solvers leave 1e-8 of the lengths on GPUs, whatever is asked for; chaos multiplies what differs.
    allowed = 1e-9 if platform in PLAIN[:1] else {"double": 1e-7, "mixed": 1e-6, "single": 1e-4}[precision]
    assert np.abs(x1 - x2).max() < allowed and np.abs(v1 - v2).max() < 1e3 * allowed
    assert np.abs(x1 - x).max() > 1e-3 * sum(calls) / 10
    energies = [context.getState(energy=True).getKineticEnergy()._value for context in contexts]
    assert energies[0] == pytest.approx(energies[1], rel=1e3 * allowed)
    assert residuals(system, contexts[0])[0] < 10 * tolerance + (1e-6 if precision == "single" else 1e-11)
    assert contexts[0].getStepCount() == sum(calls)
    assert contexts[0].getTime()._value == pytest.approx(sum(calls) * 0.001)


def test_noise_belongs_to_particle_and_step():
    """Other seeds give other runs; the same seed the same, however steps are divided into calls."""
    system, x, v = dumbbell()
    runs = []
    for seed, calls, platform in ((1, (9,), "Reference"), (1, (4, 5), "Reference"), (1, (9,), "CPU"), (2, (9,), "CPU")):
        integrator = ProjectedIntegrator(0.002, ensemble=Langevin(300.0, 20.0), device=True)
        integrator.setRandomNumberSeed(seed)
        runs.append(state_of(context := run(integrator, system, x, v, platform, calls))[0])
    assert np.abs(runs[0] - runs[1]).max() < 1e-12
    assert np.abs(runs[0] - runs[2]).max() < 1e-6
    assert np.abs(runs[2] - runs[3]).max() > 1e-4
    # No noise comes twice, whether a state is a whole one or not.
    states = [context.getState(positions=True, velocities=True, integratorParameters=p) for p in (False, True)]
    ends = [(context.setState(states[k]), integrator.step(9), state_of(context)[0])[2] for k in (0, 0, 1, 1)]
    assert len({f"{end[0, 0]:.6f}" for end in ends}) == 4


def test_replicas_of_openmm_have_noise_of_their_own():
    """Those of its ReplicaExchangeSampler begin with one State, and go on with theirs."""
    integrator = ProjectedIntegrator(0.002, ensemble=Langevin(300.0, 20.0), device=True)
    system, reference = particles([12.0], field("x^2", 1)), openmm.Platform.getPlatform("Reference")
    simulation = app.Simulation(app.Topology(), system, integrator, reference)
    simulation.context.setPositions([[0.1, 0.0, 0.0]])
    replicas = app.ReplicaExchangeSampler([{"temperature": 300.0}] * 3, simulation, 5)
    replicas.simulate(2)
    assert len({f"{state.getPositions()[0].x:.6f}" for state in replicas.replicaConformation}) == 3


# -- operations -----------------------------------------------------------------------------------------


def test_operations_are_joined_where_nobody_looks():
    kick, fly = Op("kick", 0.5), Op("fly", 1.0, "", (1.0,), (1.0,))
    verlet = [kick, fly, Op("evaluate"), kick, Op("project", ends=(1.0,))]
    head, middle, tail = divided(verlet, noisy=False)
    assert [(op.verb, op.share) for op in middle] == [("kick", 1.0), ("fly", 1.0), ("evaluate", 0.0)]
    assert [op.verb for op in head] == ["kick", "fly", "evaluate"] and [op.verb for op in tail] == ["kick", "project"]
    assert tail[0].begun == -1 and divided(verlet, noisy=True)[2][0].verb == "note"
    apart = joined([Op("kick", 0.5, "0"), Op("kick", 0.5, "1")])
    assert [op.group for op in apart] == ["0", "1"]
    turns = [Op("turn", 0.5), Op("project"), Op("turn", 0.5)]
    assert [(op.verb, op.share) for op in joined(turns)] == [("turn", 1.0)]
    with pytest.raises(UnsupportedError, match="leapfrog"):
        divided([kick, fly], noisy=False)


# -- OpenMM's bookkeeping ---------------------------------------------------------------------------------


def test_states_of_other_rows_are_refused():
    def made(pairs, ensemble=None):
        system = particles([12.0] * 6, field("10*x^2+20*y^2+30*z^2", 6))
        x = np.arange(18).reshape(6, 3) ** 1.1 * 0.03
        integrator = ProjectedIntegrator(0.001, parts=[Distance(pairs)], ensemble=ensemble, device=True)
        context = started(system, integrator, x, 0.01 * np.sin(x))
        integrator.step(3)
        return system, context

    _, many = made([[0, 1], [2, 3], [4, 5]])
    state = many.getState(positions=True, velocities=True, parameters=True, integratorParameters=True)
    _, few = made([[0, 1]])
    with pytest.raises(openmm.OpenMMException, match="other steps or rows; OpenMM has taken over its positions"):
        few.setState(state)
    np.testing.assert_array_equal(state_of(few), state_of(many))
    few.getIntegrator().step(1)
    with pytest.raises(openmm.OpenMMException, match="other steps or rows"):
        made([[0, 1]], NoseHoover(300.0, 10.0))[1].loadCheckpoint(many.createCheckpoint())


def test_constraints_that_are_taken_away_before_reinitialize_hold_no_more():
    system, x, v = dumbbell()
    integrator = ProjectedIntegrator(0.001, parts=[Plane(1, [0.0, 0.0, 1.0])], device=True)
    context = started(system, integrator, x, v)
    integrator.applyVelocityConstraints()
    integrator.step(3)
    system.removeConstraint(0)
    context.reinitialize()
    context.setPositions(x)
    context.setVelocities(v)
    integrator.applyVelocityConstraints()
    np.testing.assert_allclose(state_of(context)[1], v * [[1, 1, 1], [1, 1, 0]], atol=1e-12)


def test_settings_change_what_is_done():
    system, x, v = waters()
    made = [ProjectedIntegrator(0.001, ensemble=NoseHoover(300.0, 10.0), device=d) for d in (True, False, True)]
    early = context_of(system, made.pop())  # openmmtools copies variables before there are positions
    early.getIntegrator().setGlobalVariable(2, early.getIntegrator().getGlobalVariableByName("link1"))
    contexts = [run(integrator, system, x, v, calls=(5,)) for integrator in made]
    for integrator in made:
        integrator.setTemperature(900.0)
        integrator.setRandomNumberSeed(3)  # which the device is told together with what was changed before
        integrator.setStepSize(0.0005)
        integrator.step(20)
        assert integrator.getTemperature()._value == 900.0 and integrator.getGlobalVariableByName("link1") != 0
    assert difference(*contexts) < 1e-8
    assert contexts[0].getTime()._value == pytest.approx(0.015)
    made[0].setTemperature(450.0)
    assert f'"kT&quot;: {made[0].program.settings["kT"]}'[1:] in openmm.XmlSerializer.serialize(made[0])
    made[0].setGlobalVariableByName("link1", 0.25)
    assert made[0].getGlobalVariableByName("link1") == 0.25
    assert made[0].getNumPerDofVariables() == made[0].getNumTabulatedFunctions() == 0
    with pytest.raises(UnsupportedError, match="force groups"):
        made[0].setIntegrationForceGroups({0})


def test_others_move_positions_and_velocities():
    system, x, v = waters()
    made = [ProjectedIntegrator(0.001, device=d) for d in (True, False)]
    contexts = [run(integrator, system, x, v, calls=(5,)) for integrator in made]
    for context, integrator in zip(contexts, made, strict=True):
        context.setPositions(state_of(context)[0] + 0.05)
        context.setVelocities(-v)
        context.getState(energy=True, forces=True, groups={0})
        integrator.step(5)
        context.getState(forces=True, groups={1})  # forces stay there, and energies say other groups
        context.getState(energy=True)
        integrator.step(5)
    assert difference(*contexts) < 1e-8


@pytest.mark.parametrize("rows", [False, True])
def test_virtual_sites_follow(rows):
    system, x, v = dumbbell()
    system.addParticle(0.0)
    system.setVirtualSite(2, openmm.TwoParticleAverageSite(0, 1, 0.3, 0.7))
    system.getForce(0).addParticle(2, [])
    x, v = np.vstack([x, 0.3 * x[:1] + 0.7 * x[1:]]), np.vstack([v, np.zeros((1, 3))])
    parts = [hold(system, [Distance([[0, 1]])], x)] if rows else []
    made = [ProjectedIntegrator(0.001, parts=parts, device=d) for d in (True, False)]
    contexts = [run(integrator, system, x, v, calls=(30,)) for integrator in made]
    assert difference(*contexts) < 1e-10


def test_reinitialize_keeps_what_belongs_to_the_state():
    system, x, v = waters()
    bath = NoseHoover(300.0, 10.0)
    integrator = ProjectedIntegrator(0.001, ensemble=bath, device=True)
    context = run(integrator, system, x, v, calls=(5,))
    link = integrator.getGlobalVariableByName("link1")
    context.reinitialize(preserveState=True)
    assert integrator.getGlobalVariableByName("link1") == link != 0
    integrator.step(5)
    expected = run(ProjectedIntegrator(0.001, ensemble=bath, device=True), system, x, v, calls=(10,))
    assert difference(context, expected) < 1e-11


def test_a_compound_integrator_begins_with_rows_through_faces():
    bonds, compound = openmm.HarmonicBondForce(), openmm.CompoundIntegrator()
    bonds.setUsesPeriodicBoundaryConditions(True)
    compound.addIntegrator(made := ProjectedIntegrator(0.001, parts=[Distance([[0, 1]], 0.2)], device=True))
    context = started(particles([1.0] * 2, bonds), compound, x := [[0.1, 0.0, 0.0], [1.9, 0.0, 0.0]])
    compound.step(3)
    np.testing.assert_allclose(state_of(context)[0], x, atol=1e-12, err_msg=repr(made))


def test_several_contexts_and_threads():
    system, x, v = waters()
    made = [ProjectedIntegrator(0.001, ensemble=Isokinetic(), device=True) for _ in range(2)]
    contexts = [started(system, integrator, x, v) for integrator in made]
    threads = [threading.Thread(target=integrator.step, args=(30,)) for integrator in made]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert difference(*contexts) == 0 and contexts[0].getStepCount() == 30
    with pytest.raises(openmm.OpenMMException, match="already bound"):
        openmm.Context(system, made[0], openmm.Platform.getPlatformByName("Reference"))
    del contexts
    with pytest.raises(UnsupportedError, match="no Context"):
        made[0].step(1)


# -- what goes wrong --------------------------------------------------------------------------------------


@pytest.mark.parametrize("platform", ["Reference", *GPUS])
def test_a_failure_puts_back_what_was_checked_last(platform):
    x, v = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.4, 0, 0]]), np.zeros((3, 3))
    system, _, _ = dumbbell()
    system.addParticle(1.0)
    kick = openmm.CustomCompoundBondForce(3, "-select(step(x3-0.5), 3e6, 1)*(y1-y2)")
    kick.addBond([0, 1, 2], [])
    system.addForce(kick)
    v[2, 0] = 1.0
    tolerance = 1e-5 if "single" in platform else None
    integrator = ProjectedIntegrator(0.001, device=True, check_every=1000, tolerance=tolerance)
    context = started(system, integrator, x, v, platform)
    integrator.step(60)
    integrator.check()
    checked = state_of(context)
    with pytest.raises(ConvergenceError, match=r"step \d+: row #0 .* leave out tolerance=.* back at step 60") as told:
        integrator.step(100)
    assert 90 < told.value.step < 120 and told.value.residual > 1 and context.getStepCount() == 60
    assert context.getTime()._value == pytest.approx(0.06)
    np.testing.assert_allclose(state_of(context), checked, rtol=0, atol=1e-6)
    integrator.step(30)
    integrator.check()


@pytest.mark.parametrize("platform", PLATFORMS)
@pytest.mark.parametrize("ensemble", [None, Langevin(300.0, 1.0), Isokinetic(300.0)], ids=str)
def test_records_are_the_states_after_steps(platform, ensemble):
    system, x, v = waters()
    made = [ProjectedIntegrator(0.001, ensemble=ensemble, device=True) for _ in range(2)]
    for integrator in made:
        integrator.setRandomNumberSeed(7)
    atoms = [0, 4, 11]
    made[0].record(np.array(atoms[::-1]))
    contexts = [started(system, integrator, x, v, platform) for integrator in made]
    near = {"single": 1e-3, "mixed": 1e-5}.get(platform.partition(" ")[2], 1e-9)
    for integrator in made:
        integrator.step(3)
    for *found, time in made[0].records(12, 4):
        made[1].step(4)
        state = contexts[1].getState(positions=True, velocities=True, forces=True)
        assert time == pytest.approx(state.getTime()._value)
        forces = np.array(state.getForces(asNumpy=True)._value)
        scales, box = (1, 10, 1e5), np.diag(state.getPeriodicBoxVectors(asNumpy=True)._value)
        # GPUs move molecules to other cells.
        found[0] -= box * np.round((found[0] - state_of(contexts[1])[0][atoms]) / box)
        for mine, its, scale in zip(found, (*state_of(contexts[1]), forces), scales, strict=True):
            np.testing.assert_allclose(mine, its[atoms], rtol=0, atol=near * scale)
    assert [context.getStepCount() for context in contexts] == [15, 15]


def test_which_steps_are_made_on_the_device(monkeypatch):
    """Where nobody says: on machines with a GPU, and where the plugin was compiled."""
    build.library()
    monkeypatch.setattr(build, "accelerated", list)
    assert type(ProjectedIntegrator(0.001)) is DeviceIntegrator
    monkeypatch.setattr(build, "is_built", lambda: False)
    integrator = ProjectedIntegrator(0.001)
    assert type(integrator) is type(copy.copy(integrator)) is ProjectedIntegrator
    assert "not on the device: the plugin is not compiled" in integrator.listing()
    assert type(ProjectedIntegrator(0.001, parts=Distance([[0, 1]], 0.1))) is DeviceIntegrator  # only there
    monkeypatch.setattr(build, "accelerated", lambda: ["CUDA"])
    assert type(ProjectedIntegrator(0.001)) is DeviceIntegrator


def test_what_the_device_has_not_is_refused_or_left_to_the_custom_integrator(monkeypatch):
    with pytest.raises(UnsupportedError, match="ReversedDrifts has no kernels"):
        HamiltonianMonteCarlo.reversing_integrator(0.001, device=True)
    with pytest.raises(UnsupportedError, match="OtherLangevin has no kernels"):
        DeviceIntegrator(0.001, ensemble=type("OtherLangevin", (Langevin,), {})(300, 1))
    assert type(HamiltonianMonteCarlo.reversing_integrator(0.001, device=None)) is ProjectedIntegrator
    monkeypatch.setattr(build, "refusal", lambda: "there is no C++ compiler")
    with pytest.raises(UnsupportedError, match="no C\\+\\+ compiler"):
        ProjectedIntegrator(0.001, device=True)
    assert type(ProjectedIntegrator(0.001, device=None)) is ProjectedIntegrator
