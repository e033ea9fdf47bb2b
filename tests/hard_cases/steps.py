"""Steps that are too long, zero, or backwards; forces that are too large."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping

import numpy as np

from hard_cases import truths
from hard_cases.bodies import TRIANGLE
from hard_cases.case import Check, Outcome, case, outcome
from hard_cases.chains import bonds, zigzag
from hard_cases.problem import Problem
from hard_cases.programs import CannotExpressError, Core, Frame, PlainAse, Program, Seen
from hard_cases.starts import WIDE, WIDE_MASSES, rotor


def each_refused(calls: Mapping[str, Callable[[], float]]) -> Outcome:
    """Raise the first error if all calls raise one; else a check that fails for each call that was accepted."""
    accepted: list[Check] = []
    first: Exception | None = None
    for name, call in calls.items():
        try:
            # A number that happens to be right does not make it a refusal.
            accepted.append(Check(f"{name}: accepted;", call() or 1e-300, 0.0))
        except CannotExpressError:
            raise
        except Exception as error:
            first = first or error
    if first is not None and not accepted:
        raise first
    return Outcome(tuple(sorted(accepted, key=lambda check: -check.value)))  # the worst first


@case("H09", "Free rotor, omega dt from 0.1 to 0.99", "turned by asin(omega dt) each step, to 1e-11 after 50")
def free_rotor(program: Program, quick: bool) -> Outcome:
    found: list[tuple[str, float, float]] = []
    for omega_dt in (0.1, 0.3, 0.5, 0.7, 0.9, 0.99):
        seen: list[Frame] = []
        program.run(rotor(), omega_dt, 50, seen.append)
        turned = 0.0
        for before, after in itertools.pairwise(seen):
            d, e = before.x[0] - before.x[1], after.x[0] - after.x[1]
            turned += math.atan2(d[0] * e[1] - d[1] * e[0], float(d @ e))
        found.append((f"{omega_dt:g}: angle off by", abs(turned - 50 * math.asin(omega_dt)), 1e-11))
    return outcome(*found)


@case("X40", "Free rotor, omega dt of 1.01, 1.2 and 1.5: no solution", "refused: time step too large", "raise")
def rotor_without_solution(program: Program, quick: bool) -> Outcome:
    def length_off(dt: float) -> float:
        return abs(float(np.linalg.norm(np.subtract(*program.run(rotor(), dt, 20).x))) / 1.2 - 1)

    return each_refused({f"{dt:g}": lambda dt=dt: length_off(dt) for dt in (1.01, 1.2, 1.5)})  # type: ignore[misc]


_OWN = "it projects along the bonds as they are, not along those of a reference"


@case("X41", "Bond turned by 90 degrees within a step", "refused", "raise", openmm=_OWN, in_openmm=_OWN)
def right_angle(program: Program, quick: bool) -> Outcome:
    """The correction is along the old bond, at right angles to the new one."""
    old = Problem([[0.0, 0, 0], [1, 0, 0]], [1.0, 1.0], [(0, 1)], [1.0])
    new = np.array([[0.5, -0.6, 0], [0.5, 0.6, 0]])
    if isinstance(program, Core):
        return outcome(("residual", old.residual(program.system(old).motion.project_positions(new, old.x)), 1e-10))
    assert isinstance(program, PlainAse)
    atoms = program.atoms(old)
    atoms.set_positions(new)
    return outcome(("residual", old.residual(atoms.get_positions()), 1e-10))


def water_in_field() -> tuple[Problem, float]:
    """Rigid water tumbling in a field that pulls its atoms apart; and its fastest motion."""
    v = truths.spinning(WIDE, WIDE_MASSES, np.array([0.6, -0.9, 0.5]))
    push = 0.5 * np.array([[0, 0, -2.0], [0, 0, 1], [0, 0, 1]])
    return Problem(WIDE, WIDE_MASSES, TRIANGLE, velocities=v, push=push), 1.2


def chain_in_springs() -> tuple[Problem, float]:
    x = truths.rotated(zigzag(8))
    problem = Problem(x, np.full(8, 12.0), bonds(8), tether=2.0, anchors=0.9 * x)
    return problem.moving(0.3 * np.random.default_rng(6).standard_normal((8, 3))), 0.5


#: Residual of a run that ends without an error.
SILENT = 1e-7


@case("X42", "Step raised until failure", "the failure is an error; before it, residual 1e-7 (OpenMM: 3e-8)")
def raised_step(program: Program, quick: bool) -> Outcome:
    steps = program.length(quick, 50, 500)
    told: list[str] = []
    found: list[tuple[str, float, float]] = []
    for test_system, (problem, omega) in (("water", water_in_field()), ("chain", chain_in_springs())):
        dt, largest, error, worst = 0.05 / omega, 0.0, "", 0.0
        while worst <= SILENT and dt < 1e3 / omega:
            seen = Seen(problem)
            try:
                program.run(problem, dt, steps, seen)
            except Exception as failure:
                error = f" then {type(failure).__name__}"
                break
            worst = float(np.maximum(worst, seen.residual))
            if worst <= SILENT:
                largest = dt
                dt *= 1.2
        found.append((f"{test_system}: residual without an error, at step {dt:.3g}", worst, SILENT))
        told.append(f"{test_system} {largest:.3g}{error}")
    return outcome(*found, remark=f"largest steps over {steps}: " + ", ".join(told))


@case("H25", "Force of 1e12 along a bond", "residual 1e-10; acceleration along the bond 1e-15 F/m")
def force_along_bond(program: Program, quick: bool) -> Outcome:
    size = 1e12
    x = truths.rotated([[0.75, 0, 0], [-0.45, 0, 0]])
    along = (x[0] - x[1]) / np.linalg.norm(x[0] - x[1])
    # A spring that pushes with 1e12 whatever way the bond points.
    problem = Problem(x, [1.5, 2.5], [(0, 1)], [1.2], springs=[(0, 1, 1e6, 1.2 + 1e6)])
    seen = program.seen(problem.moving([[0.1, 0.3, -0.2], [0, 0.2, 0.1]]), 1e-3, 3)
    found = [("residual", seen.residual, 1e-10)]
    if isinstance(program, Core):
        a = program.system(problem).motion.acceleration(x, 0 * x, size * np.stack([along, -along]))
        found.append(("acceleration along the bond", abs(float(along @ (a[0] - a[1]))), 1e-15 * size / 1.5 + 1e-14))
    else:
        found.append(("moved by", float(np.abs(seen.end.x - x).max()), 2e-3))
    return outcome(*found)


def _stiff() -> tuple[Problem, float]:
    k, masses = 1e6, np.array([3.0, 1.0, 2.0])
    x = np.array([[0.0, 0, 0], [1.0, 0, 0], [1.4, 0.9, 0]])
    problem = Problem(x, masses, [(0, 1)], springs=[(1, 2, k, float(np.linalg.norm(x[2] - x[1])))])
    # The spring at right angles to the rigid bond has both masses to itself: the fastest there can be.
    fastest = math.sqrt(k * (1 / masses[1] + 1 / masses[2]))
    return problem.moving([[0, 0.4, 0.1], [0, -0.3, 0.2], [0, 0.5, -0.4]]), fastest


@case("H41", "Spring of 1e6 beside a rigid bond", "energy bounded at half the limit, 1e4 steps; residual 1e-10")
def stiff_and_rigid(program: Program, quick: bool) -> Outcome:
    problem, omega = _stiff()
    steps = program.length(quick, 1000, 10_000)
    seen = program.seen(problem, 1.0 / omega, steps)
    return outcome(("energy", seen.energy_off, 0.5), ("residual", seen.residual, 1e-10), remark=f"{steps} steps")


@case("X43", "The same above the limit of stability", "refused", "raise")
def above_the_limit(program: Program, quick: bool) -> Outcome:
    problem, omega = _stiff()
    end = program.run(problem, 1.6 * 2 / omega, 20_000, lambda frame: None, every=50)
    return outcome(("kinetic energy grown by a factor", problem.kinetic(end.v) / problem.kinetic(problem.v), 2.0))


@case("H42", "Steps of zero and backwards", "0: nothing moves; back: 1e-12")
def zero_and_back(program: Program, quick: bool) -> Outcome:
    x = truths.rotated(zigzag(6))
    problem = Problem(x, np.linspace(1, 6, 6), bonds(6), tether=0.5, anchors=0 * x)
    problem = problem.moving(0.3 * np.random.default_rng(2).standard_normal((6, 3)))
    still, forth = (program.run(problem, dt, 1) for dt in (0.0, 0.02))
    back = problem.but(positions=forth.x, velocities=forth.v, lengths=problem.held_lengths)
    back = program.run(back, -0.02, 1)
    moved = np.abs(still.x - x).max() + np.abs(still.v - problem.v).max()
    missed = max(np.abs(back.x - x).max(), np.abs(back.v - problem.v).max())
    rounding = 1e-15 * (not isinstance(program, Core))
    return outcome(("moved by a step of zero", moved, rounding), ("step back misses by", missed, 1e-12))
