"""Invalid input: contradictions, bad masses, coincident atoms, NaN, bad indices, other precision."""

from __future__ import annotations

from typing import Any

import numpy as np

from hard_cases import truths
from hard_cases.bodies import TRIANGLE, WATER, WATER_MASSES
from hard_cases.case import Outcome, case, outcome
from hard_cases.chains import bonds, zigzag
from hard_cases.motions import miscounted
from hard_cases.problem import Problem
from hard_cases.programs import Program
from hard_cases.steps import each_refused
from kcons.constraints import LinearCombination, Plane


def _off(program: Program, problem: Problem, steps: int = 20) -> float:
    """Run, and the residual at the end; NaN if anything is."""
    return problem.residual(program.run(problem, 0.01, steps).x)


def moving_chain(n: int = 5, **changes: Any) -> Problem:
    """A chain that turns."""
    x, masses = truths.rotated(zigzag(n)), np.linspace(1, 3, n)
    v = truths.spinning(x, masses, np.array([0.1, 0.2, -0.1]))
    return Problem(x, masses, bonds(n), velocities=v).but(**changes)


_SQUARE, _BRACED = [[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.2]], [(0, 1), (1, 2), (2, 3), (0, 3), (0, 2)]
_UNIT, _APART = np.array([[0.0, 0, 0], [1.0, 0, 0]]), [[0, 0.1, 0], [0, -0.1, 0]]
_CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 0.9, 0]])
TWICE = Problem(_UNIT, [1.0, 1.0], [(0, 1), (0, 1)], [1.0, 1.001], velocities=_APART)
DIAGONAL = Problem(_SQUARE, np.ones(4), _BRACED, [1.0, 1.0, 1.0, 1.0, 2.2])
POINT = Problem(0 * _UNIT, [1.0, 1.0], [(0, 1)], [1.0], velocities=_APART)
WIDE = Problem(_CORNERS, np.ones(3), TRIANGLE, [1.0, 1.0, 3.0], velocities=0.1 * _CORNERS)
FIXED = Problem([*_UNIT, [1.5, 0.9, 0]], np.ones(3), [(0, 1), (1, 2)], [1.01, 1.03], fixed=[0, 1])
for number, title, said, problem in (
    ("H02", "One bond with two targets, 1.0 and 1.001", "refused when it is set up, naming both", TWICE),
    ("X60", "Rows that contradict each other: a square with a diagonal too long", "refused", DIAGONAL),
    ("H18", "Bonded atoms at the same point", "refused: the gradient is undefined; no NaN", POINT),
    ("H21", "Triangle inequality violated: 1, 1, 3", "refused: the residual cannot go below 1/3, within 1 s", WIDE),
    ("X70", "Bond between two fixed atoms, and it is off", "refused", FIXED),
):

    @case(number, title, said, "raise", problem=problem)
    def refused(program: Program, quick: bool, problem: Problem) -> Outcome:
        return each_refused({"a run": lambda: _off(program, problem)})


@case("H17", "Mass zero, negative, NaN on a constrained atom", "refused, naming the atom and the mass", "raise")
def bad_mass(program: Program, quick: bool) -> Outcome:
    def run(mass: float) -> float:
        masses = np.array([1.0, 1.5, 2.0, mass, 3.0])
        return _off(program, moving_chain(masses=masses))

    return each_refused({f"mass {mass:g}": lambda mass=mass: run(mass) for mass in (0.0, -1.0, np.nan)})  # type: ignore[misc]


@case("H19", "NaN in positions, velocities, targets, forces, cell", "refused at once, arrays as they were", "raise")
def not_finite(program: Program, quick: bool) -> Outcome:
    def run(**changes: Any) -> float:
        return _off(program, moving_chain(4, **{"lengths": np.ones(3), **changes}))

    def spoiled(array: Any) -> Any:
        array[2, 1] = np.nan
        return array

    start = moving_chain(4)
    return each_refused(
        {
            "positions": lambda: run(positions=spoiled(start.x)),
            "velocities": lambda: run(velocities=spoiled(start.v)),
            "targets": lambda: run(lengths=[1.0, np.nan, 1.0]),
            "forces": lambda: run(push=spoiled(np.zeros((4, 3)))),
            "cell": lambda: run(cell=np.diag([20.0, np.nan, 20.0])),
        }
    )


@case("H20", "Four atoms, 12 independent rows, and they move", "refused; at rest allowed", "raise")
def no_freedom(program: Program, quick: bool) -> Outcome:
    x = np.array([[0.0, 0, 0], [1, 0, 0], [1.2, 1, 0], [0, 1.1, 0]])
    in_plane = [LinearCombination([a], [axis], None) for a in range(4) for axis in ([1.0, 0, 0], [0, 1.0, 0])]
    rows = [Plane([0, 1, 2, 3], normal=[0, 0, 1], offset=0.0), *in_plane]
    problem = Problem(x, np.ones(4), others=rows, velocities=0.1 * np.ones((4, 3)))
    assert np.abs(program.run(problem.but(velocities=None), 0.01, 10).x - x).max() < 1e-12
    # A program that takes what is not admissible off the velocities is left with none: at rest, and allowed.
    end = program.run(problem, 0.01, 10)
    return outcome(("speed", np.abs(end.v).max(), 1e-12), ("moved by", np.abs(end.x - x).max(), 1e-12))


@case("X61", "Over-determined: five distances on three atoms, three of them repeated", "accepted; 6 degrees of freedom")
def over_determined(program: Program, quick: bool) -> Outcome:
    x = truths.rotated(WATER)
    v = truths.spinning(x, WATER_MASSES, np.array([0.3, 0.2, -0.1]))
    problem = Problem(x, WATER_MASSES, [*TRIANGLE, (1, 0), (2, 1)], velocities=v)
    return outcome(("residual", _off(program, problem, 100), 1e-10), miscounted(program, problem, 6))


class _Raw(Problem):
    """Hands its arrays over in the precision they have."""

    x = property(lambda self: np.array(self.positions))
    v = property(lambda self: np.array(self.velocities))
    m = property(lambda self: np.array(self.masses))


@case("H27", "float32 input", "as the same numbers in float64, to 1e-12; results in float64")
def single_precision(program: Program, quick: bool) -> Outcome:
    x = truths.rotated(WATER).astype(np.float32)
    v = np.random.default_rng(5).standard_normal((3, 3)).astype(np.float32)
    masses = WATER_MASSES.astype(np.float32)
    ends = []
    for kind in (np.float32, np.float64):
        # Velocities that fit to rounding, so that nothing else differs.
        fitting = Problem(x.astype(kind), masses.astype(kind), TRIANGLE).tangent(v.astype(np.float64))
        start = fitting.astype(np.float32).astype(kind)
        problem = _Raw(x.astype(kind), masses.astype(kind), TRIANGLE, velocities=start)
        ends.append(program.run(problem, 0.01, 100, project=True))
    apart = max(np.abs(ends[0].x - ends[1].x).max(), np.abs(ends[0].v - ends[1].v).max())
    double = all(a.dtype == np.float64 for end in ends for a in (end.x, end.v))
    return outcome(("difference", apart, 1e-12), ("results in another precision", float(not double), 0))


@case("H29", "Bond (i, i), to no atom, to atom -1, of length 0 and -1", "refused, naming the row", "raise")
def bad_indices(program: Program, quick: bool) -> Outcome:
    def run(pairs: Any, *lengths: float) -> float:
        end = program.run(moving_chain(4, pairs=pairs, lengths=lengths), 0.01, 20)
        return float("nan") if not np.all(np.isfinite(end.x)) else 1.0

    return each_refused(
        {
            "bond (2, 2)": lambda: run([(0, 1), (2, 2)], 1.0, 1.0),
            "atom 7 of 4": lambda: run([(0, 1), (2, 7)], 1.0, 1.0),
            "atom -1": lambda: run([(0, -1)], 1.0),
            "length 0": lambda: run([(0, 1)], 0.0),
            "length -1": lambda: run([(0, 1)], -1.0),
        }
    )


@case("X62", "A non-finite force far into a run", "refused in that step; the last good state stays", "raise")
def late_force(program: Program, quick: bool) -> Outcome:
    class Late(Problem):
        calls = 0
        has_forces = True

        def forces(self, x: Any, time: float = 0.0) -> Any:
            Late.calls += 1
            return np.full_like(x, np.nan) if Late.calls > 50 else np.zeros_like(x)

    base = moving_chain(4)
    end = program.run(Late(base.x, base.m, base.pairs, velocities=base.v), 0.01, 100)
    return outcome(("residual", base.residual(end.x), 1e-10))
