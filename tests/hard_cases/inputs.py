"""Invalid input: contradictions, bad masses, coincident atoms, NaN, bad indices, other precision."""

from __future__ import annotations

from typing import Any

import numpy as np

from hard_cases import truths
from hard_cases.bodies import TRIANGLE, WATER, WATER_MASSES
from hard_cases.case import Outcome, case, outcome
from hard_cases.chains import bonds, zigzag
from hard_cases.problem import Problem
from hard_cases.programs import Program
from hard_cases.steps import each_refused
from kcons.constraints import LinearCombination, Plane


def _off(program: Program, problem: Problem, steps: int = 20) -> float:
    """Run, and the residual at the end; NaN if anything is."""
    return problem.residual(program.run(problem, 0.01, steps).x)


def moving_chain(n: int = 5, **changes: Any) -> Problem:
    """A chain that turns."""
    x = truths.rotated(zigzag(n))
    masses = np.linspace(1, 3, n)
    return Problem(x, masses, bonds(n), velocities=truths.spinning(x, masses, np.array([0.1, 0.2, -0.1]))).but(
        **changes
    )


@case("H02", "One bond with two targets, 1.0 and 1.001", "refused when it is set up, naming both", "raise")
def two_targets(program: Program, quick: bool) -> Outcome:
    x = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    problem = Problem(x, [1.0, 1.0], [(0, 1), (0, 1)], [1.0, 1.001], velocities=[[0, 0.1, 0], [0, -0.1, 0]])
    return each_refused({"a run": lambda: _off(program, problem)})


@case("X60", "Rows that contradict each other: a square with a diagonal too long", "refused", "raise")
def contradictory(program: Program, quick: bool) -> Outcome:
    x = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.2]])
    pairs = [(0, 1), (1, 2), (2, 3), (0, 3), (0, 2)]
    problem = Problem(x, np.ones(4), pairs, [1.0, 1.0, 1.0, 1.0, 2.2])
    return each_refused({"a run": lambda: _off(program, problem)})


@case("H17", "Mass zero, negative, NaN on a constrained atom", "refused, naming the atom and the mass", "raise")
def bad_mass(program: Program, quick: bool) -> Outcome:
    def run(mass: float) -> float:
        problem = moving_chain()
        masses = problem.m
        masses[3] = mass
        return _off(program, problem.but(masses=masses))

    return each_refused({f"mass {mass:g}": lambda mass=mass: run(mass) for mass in (0.0, -1.0, np.nan)})  # type: ignore[misc]


@case("H18", "Bonded atoms at the same point", "refused: the gradient is undefined; no NaN", "raise")
def coincident(program: Program, quick: bool) -> Outcome:
    problem = Problem(np.zeros((2, 3)), [1.0, 1.0], [(0, 1)], [1.0], velocities=[[0, 0.1, 0], [0, -0.1, 0]])
    return each_refused({"a run": lambda: _off(program, problem)})


@case("H19", "NaN in positions, velocities, targets, forces, cell", "refused at once, arrays as they were", "raise")
def not_finite(program: Program, quick: bool) -> Outcome:
    base = moving_chain(4)

    def spoiled(name: str) -> Problem:
        if name == "targets":
            return base.but(lengths=[1.0, np.nan, 1.0])
        if name == "cell":
            return base.but(cell=np.diag([20.0, np.nan, 20.0]), lengths=np.ones(3))
        values = np.zeros((4, 3)) if name == "push" else np.array(getattr(base, name), dtype=float)
        values[2, 1] = np.nan
        lengths = np.ones(3)
        return base.but(**{name: values}, lengths=lengths)

    words = {
        "positions": "positions",
        "velocities": "velocities",
        "targets": "targets",
        "push": "forces",
        "cell": "cell",
    }
    return each_refused({word: lambda name=name: _off(program, spoiled(name)) for name, word in words.items()})  # type: ignore[misc]


@case(
    "H20",
    "More rows than coordinates: four atoms, 12 independent rows, and they move",
    "refused; at rest allowed",
    "raise",
)
def no_freedom(program: Program, quick: bool) -> Outcome:
    x = np.array([[0.0, 0, 0], [1, 0, 0], [1.2, 1, 0], [0, 1.1, 0]])
    in_plane = [LinearCombination([a], [axis], None) for a in range(4) for axis in ([1.0, 0, 0], [0, 1.0, 0])]
    rows = [Plane([0, 1, 2, 3], normal=[0, 0, 1], offset=0.0), *in_plane]
    problem = Problem(x, np.ones(4), others=rows, velocities=0.1 * np.ones((4, 3)))
    moved = program.run(problem.but(velocities=None), 0.01, 10)
    assert np.abs(moved.x - x).max() < 1e-12
    # A program that takes what is not admissible off the velocities is left with none: at rest, and allowed.
    end = program.run(problem, 0.01, 10)
    return outcome(("speed", np.abs(end.v).max(), 1e-12), ("moved by", np.abs(end.x - x).max(), 1e-12))


@case("X61", "Over-determined: five distances on three atoms, three of them repeated", "accepted; 6 degrees of freedom")
def over_determined(program: Program, quick: bool) -> Outcome:
    pairs = [*TRIANGLE, (1, 0), (2, 1)]
    x = truths.rotated(WATER)
    problem = Problem(x, WATER_MASSES, pairs, velocities=truths.spinning(x, WATER_MASSES, np.array([0.3, 0.2, -0.1])))
    off = _off(program, problem, 100)
    return outcome(
        ("residual", off, 1e-10), ("degrees of freedom, miscounted by", abs(program.degrees_of_freedom(problem) - 6), 0)
    )


@case("H21", "Triangle inequality violated: 1, 1, 3", "refused: the residual cannot go below 1/3, within 1 s", "raise")
def infeasible(program: Program, quick: bool) -> Outcome:
    x = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 0.9, 0]])
    problem = Problem(x, np.ones(3), TRIANGLE, [1.0, 1.0, 3.0], velocities=0.1 * x)
    return each_refused({"a run": lambda: _off(program, problem)})


@case("H27", "float32 input", "as the same numbers in float64, to 1e-12; results in float64")
def single_precision(program: Program, quick: bool) -> Outcome:
    x = truths.rotated(WATER).astype(np.float32)
    v = np.random.default_rng(5).standard_normal((3, 3)).astype(np.float32)
    masses = WATER_MASSES.astype(np.float32)
    ends = []
    for kind in (np.float32, np.float64):
        problem = Problem(x.astype(kind), masses.astype(kind), TRIANGLE, velocities=v.astype(kind))
        # Velocities that fit to rounding, so that nothing else differs.
        fitting = problem.but(velocities=problem.tangent(v.astype(np.float64)).astype(np.float32).astype(kind))
        ends.append(program.run(fitting.of_kind(_Raw), 0.01, 100, project=True))
    apart = max(np.abs(ends[0].x - ends[1].x).max(), np.abs(ends[0].v - ends[1].v).max())
    double = all(a.dtype == np.float64 for end in ends for a in (end.x, end.v))
    return outcome(("difference", apart, 1e-12), ("results in another precision", float(not double), 0))


class _Raw(Problem):
    """Hands its arrays over in the precision they have."""

    @property
    def x(self) -> Any:
        return np.array(self.positions)

    @property
    def v(self) -> Any:
        return np.array(self.velocities)

    @property
    def m(self) -> Any:
        return np.array(self.masses)


@case(
    "H29", "Bond of an atom with itself, to no atom, to atom -1, of length 0 and -1", "refused, naming the row", "raise"
)
def bad_indices(program: Program, quick: bool) -> Outcome:
    base = moving_chain(4)

    def run(pairs: Any, lengths: Any) -> float:
        problem = base.but(pairs=pairs, lengths=lengths)
        end = program.run(problem, 0.01, 20)
        return float("nan") if not np.all(np.isfinite(end.x)) else 1.0

    return each_refused(
        {
            "bond (2, 2)": lambda: run([(0, 1), (2, 2)], [1.0, 1.0]),
            "atom 7 of 4": lambda: run([(0, 1), (2, 7)], [1.0, 1.0]),
            "atom -1": lambda: run([(0, -1)], [1.0]),
            "length 0": lambda: run([(0, 1)], [0.0]),
            "length -1": lambda: run([(0, 1)], [-1.0]),
        }
    )


@case(
    "X62",
    "A non-finite force far into a run",
    "refused in the step where it appears; the last good state stays",
    "raise",
)
def late_force(program: Program, quick: bool) -> Outcome:
    class Late(Problem):
        calls = 0

        def forces(self, x: Any, time: float = 0.0) -> Any:
            type(self).calls += 1
            return np.full_like(x, np.nan) if type(self).calls > 50 else np.zeros_like(x)

        @property
        def has_forces(self) -> bool:
            return True

    base = moving_chain(4)
    end = program.run(base.of_kind(Late), 0.01, 100)
    return outcome(("residual", base.residual(end.x), 1e-10))
