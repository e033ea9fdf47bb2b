"""The isokinetic thermostat in the core and in both MD engines, which have none, and the fluid that tests it."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from ase import units
from openmm import unit
from systems.fluids import LennardJones

import kcons.openmm
from hard_cases.case import Outcome, case, outcome
from hard_cases.problem import Array, Problem
from hard_cases.programs import Core, KconsInAse, KconsInOpenMM, Program
from hard_cases.steps import each_refused
from kcons.ase import IsokineticDynamics
from kcons.constraints import Plane, Sphere
from kcons.steppers import State
from kcons.thermostats import Isokinetic
from kcons.thermostats.freedom import Momentum

NONE = "no isokinetic thermostat"
DT = 0.01


def _step(program: Program, problem: Problem, kt: float | None = None, momentum: Momentum = "auto") -> Array:
    """Velocities after one isokinetic step of a program; kt in the unit of energy, None to keep K."""
    if isinstance(program, Core):
        system = program.system(problem)
        return Isokinetic(kt, momentum=momentum).step(system, State(problem.x, problem.v), DT).velocities
    if isinstance(program, KconsInAse):
        kelvin = None if kt is None else kt / units.kB
        md_engine: Program = KconsInAse(lambda atoms, dt: IsokineticDynamics(atoms, dt, kelvin, momentum=momentum))
    else:
        given = None if kt is None else kt / unit.MOLAR_GAS_CONSTANT_R._value * 1e3
        md_engine = KconsInOpenMM(kcons.openmm.Isokinetic(given, momentum=momentum))
    return md_engine.run(problem, DT, 1).v


@case("H22", "Isokinetic with no kinetic energy, and with 2K that underflows", "refused", "raise", peers=NONE)
def no_kinetic_energy(program: Program, quick: bool) -> Outcome:
    problem = Problem([[0.0, 0, 0], [1, 0, 0]], [1.0, 2.0], [(0, 1)], tether=1.0, anchors=np.ones((2, 3)))
    unit = problem.tangent([[0, 1.0, 0.3], [0.2, -0.4, 0.1]])

    def run(speed: float) -> float:
        return problem.kinetic(_step(program, problem.but(velocities=speed * unit), 0.5))

    return each_refused({"v = 0": lambda: run(0.0), "v = 1e-160": lambda: run(1e-160)})


@case("H23", "Isokinetic with one degree of freedom", "refused: g - 1 = 0", "raise", peers=NONE)
def one_freedom(program: Program, quick: bool) -> Outcome:
    rows, v = [Plane([0], [0, 0, 1.0]), Sphere([0], [0, 0, 0], 1.0)], [[0.0, 0.7, 0.0]]
    problem = Problem([[1.0, 0, 0]], [1.0], others=rows, tether=0.5, anchors=[[0.3, 0.9, 0.1]], velocities=v)
    return outcome(("kinetic energy", problem.kinetic(_step(program, problem, 1.0)), 0))


@case("H24", "Isokinetic under forces of 1e6 and 1e12", "2K to 1e-15; v turns into the force", peers=NONE)
def huge_forces(program: Program, quick: bool) -> Outcome:
    v = np.array([[0.3, -0.2, 0.1], [0.1, -0.4, 0.3]])
    found: list[tuple[str, float, float]] = []
    for size in (1e6, 1e12):
        across = size * np.array([[0, 1.0, 0], [0, 0.5, 0.1]])
        problem = Problem([[0.0, 0, 0], [1.0, 0, 0]], [1.0, 2.0], push=across, velocities=v)
        after = _step(program, problem, momentum="free")
        twice = 2 * problem.kinetic(v)
        pace = across / problem.m[:, None]
        end = pace * np.sqrt(twice / (across * pace).sum())
        found += [
            (f"{size:g}: 2K off by", abs(2 * problem.kinetic(after) / twice - 1), 1e-15),
            (f"{size:g}: direction off by", np.abs(after - end).max(), 1e-12),
        ]
    return outcome(*found)


@case("H39", "Isokinetic, total momentum kept and not zero", "warned, or refused", "warn-or-raise", peers=NONE)
def conserved_momentum(program: Program, quick: bool) -> Outcome:
    rng = np.random.default_rng(3)
    x, masses = rng.standard_normal((6, 3)), rng.uniform(1, 2, 6)
    springs = [(i, j, 0.5, 1.0) for i, j in combinations(range(6), 2)]
    still = rng.standard_normal((6, 3))
    still -= masses @ still / masses.sum()
    _step(program, Problem(x, masses, springs=springs, velocities=still + np.array([0.0, 0.3, 0.0])), 1.0)
    return outcome()


@case(
    "H40",
    "Minimum image with a cutoff above half the box",
    "refused",
    "raise",
    ase="its neighbor lists count all images",
    openmm="a Context of its own forces refuses such a cutoff",
    in_ase="no potentials of its own",
    in_openmm="OpenMM's own forces",
)
def long_cutoff(program: Program, quick: bool) -> Outcome:
    LennardJones(range(4), 1.58, cutoff=1.0)
    return outcome()
