"""Monte Carlo in OpenMM: every decision from plain energies, restarts, reporters, averages, bad input."""

from __future__ import annotations

import io
import math
from functools import cache
from types import SimpleNamespace

import numpy as np
import openmm
import pytest
from collective_cases import bond
from ensemble_runs import twice_kinetic
from openmm import app, unit
from openmm_systems import (
    GPUS,
    alanine,
    context_of,
    field,
    loose_alanine,
    masses_of,
    particles,
    potential_energy,
    started,
    state_of,
    water_box,
)

from kcons.errors import InputError, NonFiniteError, UnsupportedError
from kcons.openmm import CollectiveRows, HamiltonianMonteCarlo, Langevin, ProjectedIntegrator, hold
from kcons.openmm.ensembles.isokinetic_ensemble import GAS_CONSTANT
from kcons.thermostats.monte_carlo import POTENTIAL, PROPOSAL
from kcons.thermostats.noise import noise_generator

reversing = HamiltonianMonteCarlo.reversing_integrator


@cache
def relaxed(n):
    system, x = water_box(n)
    integrator = ProjectedIntegrator(0.001)
    context = started(system, integrator, x)
    integrator.minimizeEnergy(context, maxIterations=5)
    return state_of(context)[0]


def waters(dt=0.004, scheme="rattle", kind=reversing, platform="Reference", n=8, steps=(2, 5), **options):
    system, _ = water_box(n)
    integrator = kind(dt * unit.picosecond, scheme)
    context = started(system, integrator, relaxed(n), platform=platform)
    return system, HamiltonianMonteCarlo(context, 300, steps, 3, **{"keep": 0.4} | options)


@pytest.mark.parametrize(("scheme", "dt"), [("rattle", 0.005), ("geodesic", 0.005), ("blanes-moan4", 0.009)])
def test_every_decision_follows_from_the_energies(scheme, dt):
    """Each proposal made again by a plain integrator in a Context of its own."""
    system, sampler = waters(dt, scheme)
    plain = ProjectedIntegrator(dt, scheme)
    other = context_of(system, plain)
    masses = masses_of(system)[:, None]
    kt, outcomes = GAS_CONSTANT * 300, set()
    for number in range(1, 21):
        x, v = state_of(sampler.context)
        random = noise_generator((3, 0), number, PROPOSAL)
        count, threshold = int(random.integers(2, 6)), random.random()
        noise = random.standard_normal(x.shape) * np.sqrt(kt * (1 - 0.4**2) / masses)
        other.setPositions(x)
        other.setVelocities(0.4 * v + noise)
        plain.applyVelocityConstraints(other)
        begin = state_of(other)[1]
        before = potential_energy(other) + twice_kinetic(system, begin) / 2
        plain.step(count)
        there = state_of(other)
        change = (potential_energy(other) + twice_kinetic(system, there[1]) / 2 - before) / kt
        sampler.step(1)
        assert sampler.counts.change == pytest.approx(change, abs=1e-6)
        accepted = math.log1p(-threshold) < -change
        outcomes.add(accepted)
        expected = there if accepted else (x, -begin)
        for found, wanted in zip(state_of(sampler.context), expected, strict=True):
            np.testing.assert_allclose(found, wanted, atol=1e-7)
        assert potential_energy(sampler.context) == pytest.approx(sampler.state.thermostat[POTENTIAL], abs=1e-6)
        if not accepted:
            assert np.array_equal(state_of(sampler.context)[0], x)
    assert outcomes == {True, False} and sampler.counts.proposals == 20


@pytest.mark.parametrize(
    ("platform", "kind", "near"),
    [
        ("Reference", ProjectedIntegrator, 1e-6),
        ("CPU", reversing, 0.05),
        *(pytest.param(*p.values, reversing, 1e-3, id=p.id, marks=p.marks) for p in GPUS[-1:]),
    ],
)
def test_platforms_and_ways_back_make_one_chain(platform, kind, near):
    """Drift by drift or at once; the last of the others is in double precision."""
    a = waters(0.003, steps=2)[1]
    b = waters(0.003, kind=kind, platform=platform, steps=2)[1]
    for sampler in (a, b):
        sampler.step(3)
    assert b.counts.proposals == 3 and a.counts.accepted == b.counts.accepted > 0
    assert b.counts.change == pytest.approx(a.counts.change, abs=near)
    np.testing.assert_allclose(state_of(b.context)[0], state_of(a.context)[0], atol=0.01 * near)


@pytest.mark.parametrize("kind", [reversing, ProjectedIntegrator])
def test_what_cannot_be_taken_back_is_rejected(kind):
    _, sampler = waters(0.03, kind=kind, steps=1)
    start = state_of(sampler.context)[0]
    sampler.step(5)
    counts = sampler.counts
    assert counts.accepted + counts.energy == 0 and counts.proposals == 5
    assert np.array_equal(state_of(sampler.context)[0], start)
    sampler.integrator.setStepSize(0.002)
    sampler.step(3)
    assert sampler.counts.accepted > 0


@pytest.mark.parametrize("rows", [False, True])
def test_reporters_of_a_simulation_see_every_proposal(rows):
    system, x = water_box(8)
    parts = [CollectiveRows(system, [bond(0, 3)], positions=x)] if rows else []
    topology = app.Topology()
    residue = topology.addResidue("HOH", topology.addChain())
    for name in 8 * "OHH":
        topology.addAtom(name, app.Element.getBySymbol(name), residue)
    integrator = ProjectedIntegrator(0.005, parts=parts) if rows else reversing(0.005)
    simulation = app.Simulation(topology, system, integrator, openmm.Platform.getPlatformByName("Reference"))
    simulation.context.setPositions(x + 9.0)
    sampler = HamiltonianMonteCarlo(simulation, 300 * unit.kelvin, 3, 5)
    told, seen = io.StringIO(), []
    simulation.reporters.append(app.StateDataReporter(told, 2, step=True, potentialEnergy=True, time=True))
    watcher = SimpleNamespace(describeNextReport=lambda _: (1, *[True] * 4), report=lambda _, state: seen.append(state))
    simulation.reporters.append(watcher)
    energies = []
    for _ in range(6):
        sampler.step(1)
        energies.append(sampler.state.thermostat[POTENTIAL])
    lines = [line.split(",") for line in told.getvalue().splitlines()[1:]]
    assert [int(step) for step, _, _ in lines] == [2, 4, 6]
    assert [float(u) for _, _, u in lines] == pytest.approx(energies[1::2], abs=1e-6)
    assert float(lines[-1][1]) == pytest.approx(6 * 3 * 0.005)
    inside = simulation.context.getState(positions=True, enforcePeriodicBox=True)
    assert seen[-1].getPositions() == inside.getPositions() and not dict(seen[-1].getParameters())


def trimer(steps=(3, 8), dt=0.15, spring=0.0, **options):
    """Masses 10, 1, 10, two bonds held, each in a well if there is a spring; kT = 1."""
    well = [field(f"{spring}*(x^2+2*y^2+3*z^2)/2", 3)] if spring else []
    system = particles([10.0, 1.0, 10.0], *well, held=[(0, 1, 1.0), (1, 2, 1.0)])
    context = started(system, reversing(dt * unit.picosecond), np.array([[1.0, 0, 0], [0, 0, 0], [0, 1.0, 0]]))
    return HamiltonianMonteCarlo(context, 1 / GAS_CONSTANT, steps, 21, **options)


def test_a_way_back_that_misses_its_start_is_rejected():
    sampler = trimer()
    sampler.step(60)
    assert sampler.counts.irreversible > 0


def test_other_constraints_are_held_and_taken_back():
    system, x, _ = loose_alanine()
    integrator = ProjectedIntegrator(2e-3, parts=[hold(system, [], positions=x, take="all")])
    context = started(system, integrator, x)
    sampler = HamiltonianMonteCarlo(context, 300, 3, 5)
    sampler.step(3)
    assert sampler.counts.proposals == 3 and sampler.counts.accepted > 0
    integrator.check(context)


def test_a_start_near_the_constraints_is_brought_onto_them():
    """Once: a rejected proposal goes back to where it was put."""
    sampler = trimer(steps=1, dt=0.01, spring=1.0)
    sampler.context.setPositions(np.array([[1.01, 0, 0], [0, 0, 0], [0, 0.99, 0]]))
    sampler.integrator.setStepSize(10.0 * unit.picosecond)  # rejected
    sampler.step(1)
    x = state_of(sampler.context)[0]
    assert sampler.counts.accepted == 0 and abs(np.linalg.norm(x[0] - x[1]) - 1) < 1e-9
    sampler.integrator.setStepSize(0.01)
    sampler.step(5)
    assert sampler.counts.accepted == 5 and sampler.counts.mean_square < 1e-4


def test_bad_input_changes_nothing():
    system, x = water_box(8)

    def sampler(integrator, others=(), **options):
        with_others = openmm.XmlSerializer.clone(system)
        for force in others:
            with_others.addForce(force)
        context = started(with_others, integrator, x)
        return HamiltonianMonteCarlo(context, **{"temperature": 300.0, "steps": 3, "rng": 1} | options)

    for name, value in {"temperature": 0.0, "steps": 0, "keep": 1.0, "rng": -1, "tolerance": 0.0}.items():
        with pytest.raises(InputError, match=f"{name} is {value}"):
            sampler(reversing(1e-3), **{name: value})
    for integrator, others, words in (
        (openmm.VerletIntegrator(1e-3), (), "is no ProjectedIntegrator"),
        (ProjectedIntegrator(1e-3, ensemble=Langevin(300.0, 1.0)), (), "leave out ensemble"),
        (reversing(1e-3), (openmm.AndersenThermostat(300, 1),), "AndersenThermostat"),
    ):
        with pytest.raises(UnsupportedError, match=words):
            sampler(integrator, others)
    assert np.array_equal(state_of(sampler(reversing(1e-3)).context)[0], x)


def test_an_energy_that_is_not_finite_is_an_error():
    sampler = trimer()
    system = openmm.XmlSerializer.clone(sampler.context.getSystem())
    system.addForce(field("log(x-10)", 1))
    context = started(system, reversing(0.01), state_of(sampler.context)[0])
    with pytest.raises(NonFiniteError, match="potential energy is nan"):
        HamiltonianMonteCarlo(context, 300, 2, 1).step(1)


def test_energies_are_asked_for_again_once_forces_have_changed():
    """`updateParametersInContext` leaves positions, box and parameters as they are."""
    system, sampler = waters(steps=1)
    sampler.step(1)
    (force,) = (f for f in system.getForces() if isinstance(f, openmm.NonbondedForce))
    for k in range(force.getNumParticles()):
        charge, sigma, depth = force.getParticleParameters(k)
        force.setParticleParameters(k, 0.5 * charge, sigma, depth)
    force.updateParametersInContext(sampler.context)
    sampler.step(1)
    assert abs(sampler.counts.change) < 1


def test_the_system_is_read_anew_at_each_call():
    sampler = trimer(dt=0.01, spring=1.0)
    system, context = sampler.context.getSystem(), sampler.context
    system.setParticleMass(1, 40.0)
    context.reinitialize(preserveState=True)
    sampler.step(5)
    assert sampler.counts.mean_square < 1e-6
    system.addForce(openmm.CMMotionRemover())
    context.reinitialize(preserveState=True)
    with pytest.raises(UnsupportedError, match=r"CMMotionRemover.*\(removeCMMotion=False\)"):
        sampler.step(1)


# -- drifts that are taken back -----------------------------------------------------------------------


def missed(integrator):
    """How far the worst way back has missed its start: root of the sum over particles, in nm."""
    return integrator.getGlobalVariableByName("missed") ** 0.5


def test_what_is_taken_back_is_so_by_the_step_from_its_end():
    """Also where a kick pushes so far across a constraint that the solver, from there, finds the other end of it."""
    length, h = 0.1, 0.1
    push = field("f*x", [1], f=2.6 * length / h**2)  # 1.3 lengths in a step
    system = particles([1e9, 1.0], push, held=[(0, 1, length)])
    integrator = reversing(h * unit.picosecond)
    context = context_of(system, integrator)
    begun = np.array([[0.0, 0, 0], [0, length, 0]])
    context.setPositions(begun)
    context.setVelocities([[0.0, 0, 0], [2.166 * length / h, 0, 0]])
    integrator.step(1)
    x, v = state_of(context)
    assert missed(integrator) < 1e-9
    assert x[1, 0] > 0.8 * length
    integrator.setGlobalVariableByName("missed", 0.0)
    context.setPositions(x)
    context.setVelocities(-v)
    integrator.step(1)
    assert missed(integrator) < 1e-9
    np.testing.assert_allclose(state_of(context)[0], begun, atol=1e-6)


def test_parts_are_refused():
    system, x, _ = alanine()
    with pytest.raises(UnsupportedError, match="takes back whole trajectories"):
        reversing(1e-3, parts=[hold(system, [], positions=x, take="all")])
