"""The isokinetic thermostat, and the fluid that tests it. ASE and OpenMM have none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kcons.constraints import Plane, Sphere
from kcons.hard_cases.case import CannotExpressError, Outcome, case, outcome
from kcons.hard_cases.problem import Array, Problem
from kcons.hard_cases.programs import Core, Program
from kcons.hard_cases.steps import each_refused
from kcons.steppers import State, System
from kcons.thermostats import Isokinetic, thermal_velocities

NONE = "no isokinetic thermostat"
ONE = "see the core: the same closed form; OpenMM's part has its own tests"


def _system(problem: Problem, force: object = None) -> System:
    system = Core().system(problem)
    return System(system.motion, force) if force is not None else system  # type: ignore[arg-type]


@case(
    "H22",
    "Isokinetic with no kinetic energy, and with 2K that underflows",
    "refused",
    "raise",
    peers=NONE,
    in_ase=ONE,
    in_openmm=ONE,
)
def no_kinetic_energy(program: Program, quick: bool) -> Outcome:
    problem = Problem([[0.0, 0, 0], [1, 0, 0]], [1.0, 2.0], [(0, 1)], tether=1.0, anchors=np.ones((2, 3)))
    system = _system(problem)
    unit = problem.tangent([[0, 1.0, 0.3], [0.2, -0.4, 0.1]])

    def run(speed: float) -> float:
        state = Isokinetic(0.5).step(system, State(problem.x, speed * unit), 0.01)
        return system.kinetic_energy(state.velocities)

    return each_refused({"v = 0": lambda: run(0.0), "v = 1e-160": lambda: run(1e-160)})


@case(
    "H23", "Isokinetic with one degree of freedom", "refused: g - 1 = 0", "raise", peers=NONE, in_ase=ONE, in_openmm=ONE
)
def one_freedom(program: Program, quick: bool) -> Outcome:
    x = np.array([[1.0, 0, 0]])
    rows = [Plane([0], [0, 0, 1.0]), Sphere([0], [0, 0, 0], 1.0)]
    system = _system(Problem(x, [1.0], others=rows, tether=0.5, anchors=[[0.3, 0.9, 0.1]]))
    state = State(x, np.array([[0.0, 0.7, 0.0]]))
    after = Isokinetic(1.0).step(system, state, 0.01)
    return outcome(("kinetic energy", system.kinetic_energy(after.velocities), 0))


@case(
    "H24",
    "Isokinetic under forces of 1e6 and 1e12",
    "2K to 1e-15; v turns into the force",
    peers=NONE,
    in_ase=ONE,
    in_openmm=ONE,
)
def huge_forces(program: Program, quick: bool) -> Outcome:
    x = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    v = np.array([[0.3, -0.2, 0.1], [0.1, -0.4, 0.3]])
    found: list[tuple[str, float, float]] = []
    for size in (1e6, 1e12):
        across = size * np.array([[0, 1.0, 0], [0, 0.5, 0.1]])
        problem = Problem(x, [1.0, 2.0], push=across)
        system = _system(problem)
        after = Isokinetic(momentum="free").step(system, State(x, v), 0.01)
        twice = 2 * system.kinetic_energy(v)
        pace = across / problem.m[:, None]
        end = pace * np.sqrt(twice / (across * pace).sum())
        found += [
            (f"{size:g}: 2K off by", abs(2 * system.kinetic_energy(after.velocities) / twice - 1), 1e-15),
            (f"{size:g}: direction off by", np.abs(after.velocities - end).max(), 1e-12),
        ]
    return outcome(*found)


@case(
    "H39",
    "Isokinetic with total momentum that is conserved and not zero",
    "warned, or refused",
    "warn-or-raise",
    peers=NONE,
    in_ase=ONE,
    in_openmm=ONE,
)
def conserved_momentum(program: Program, quick: bool) -> Outcome:
    rng = np.random.default_rng(3)
    x, masses = rng.standard_normal((6, 3)), rng.uniform(1, 2, 6)

    def swirling(x: Array, t: float) -> Array:
        # No net force, but a torque.
        d = x - x.mean(axis=0)
        f = np.stack([-d[:, 1], d[:, 0], 0 * d[:, 2]], axis=1) - 0.3 * d
        return np.asarray(f - f.mean(axis=0))

    system = _system(Problem(x, masses), swirling)
    still = State(x, thermal_velocities(system, x, 1.0, 0, zero_momentum=True))
    moving = replace(still, velocities=still.velocities + np.array([0.0, 0.3, 0.0]))
    Isokinetic(1.0).step(system, moving, 0.01)
    return outcome()


@case(
    "H40",
    "Minimum image with a cutoff above half the box",
    "refused",
    "raise",
    ase="its neighbour lists count all images",
    in_ase="no potentials of its own",
    in_openmm="OpenMM's own forces",
)
def long_cutoff(program: Program, quick: bool) -> Outcome:
    if isinstance(program, Core):
        from kcons.scenes.lennard_jones import LennardJones

        LennardJones(range(4), 1.58, cutoff=1.0)
        return outcome()
    if program.name != "OpenMM":
        raise CannotExpressError("no potentials of its own")
    import openmm

    system = openmm.System()
    force = openmm.NonbondedForce()
    for _ in range(4):
        system.addParticle(1.0)
        force.addParticle(0.0, 1.0, 1.0)
    force.setNonbondedMethod(openmm.NonbondedForce.CutoffPeriodic)
    force.setCutoffDistance(1.0)
    system.setDefaultPeriodicBoxVectors(*np.diag([1.58] * 3))
    system.addForce(force)
    openmm.Context(system, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatformByName("Reference"))
    return outcome()
