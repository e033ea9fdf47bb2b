"""Starts that are off, far away, wrapped into a cell, or with nothing held."""

from __future__ import annotations

import numpy as np

from hard_cases import truths
from hard_cases.bodies import TRIANGLE, WATER, WATER_MASSES
from hard_cases.case import Outcome, case, outcome
from hard_cases.chains import bonds, zigzag
from hard_cases.problem import Array, Problem
from hard_cases.programs import Core, Frame, Program, Seen, wrapped

#: Water with sides of 1, 1 and 1.6.
WIDE, WIDE_MASSES = truths.rotated([[0, 0, 0], [0.8, 0.6, 0], [-0.8, 0.6, 0]]), np.array([16.0, 1.0, 1.0])


def _first(program: Program, problem: Problem, steps: int = 0) -> tuple[Frame, Seen]:
    """The start after the program has brought it onto the constraints, and what was seen of a short run."""
    frames: list[Frame] = []
    seen = program.seen(problem, 1e-3, steps, frames.append, project=True)
    return frames[0], seen


def _tangent_checks(problem: Problem, first: Frame) -> list[tuple[str, float, float]]:
    """Velocities against the dense projection at the positions found; kinetic energy against its formula."""
    held, m = problem.oracle, problem.m
    rows = held.jacobian(first.x).toarray()
    jv = rows @ problem.v.ravel()
    loss = 0.5 * jv @ np.linalg.pinv(rows / np.repeat(m, 3) @ rows.T, rcond=1e-12) @ jv
    before = problem.kinetic(problem.v)
    momentum = np.abs(m @ (first.v - problem.v)).max() / np.abs(m[:, None] * problem.v).max()
    return [
        ("|J v|", np.abs(rows @ first.v.ravel()).max(), 1e-12),
        ("kinetic energy lost, off by (relative)", abs((before - problem.kinetic(first.v)) / loss - 1), 1e-12),
        ("momentum changed by", momentum, 1e-14),
    ]


@case("H10", "Rigid water stretched by 20 %", "residual 1e-12; center 1e-14; way 0.2771281292; unique velocities")
def stretched_water(program: Program, quick: bool) -> Outcome:
    masses, v = WIDE_MASSES, np.random.default_rng(4).standard_normal((3, 3))
    center = masses @ WIDE / masses.sum()
    x = center + 1.2 * (WIDE - center)
    problem = Problem(x, masses, TRIANGLE, [1.0, 1.0, 1.6], velocities=v)
    first, seen = _first(program, problem, 20)
    moved = first.x - x
    residual = np.maximum(problem.residual(first.x), problem.residual(seen.end.x))
    return outcome(
        ("residual", residual, 1e-12),
        ("center moved by", np.abs(masses @ moved / masses.sum()).max(), 1e-14),
        ("mass-weighted way off by", abs(np.sqrt(np.sum(masses[:, None] * moved**2)) - 0.2771281292), 2e-10),
        *_tangent_checks(problem, first),
    )


QUIET = "residual 1e-10 and a quiet run"


@case("X30", "Start 20 % off, chain by bonds and 1-3 distances", QUIET, factor=1.2)
@case("X31", "Start a factor 2 off, chain by bonds and 1-3 distances", QUIET, factor=2.0)
@case("X32", "Start a factor 0.5 off, chain by bonds and 1-3 distances", QUIET, factor=0.5)
def scaled(program: Program, quick: bool, factor: float) -> Outcome:
    """A molecule of bonds and 1-3 distances, every coordinate scaled, brought back and run."""
    shape = truths.rotated(zigzag(8) + np.random.default_rng(3).uniform(-0.1, 0.1, (8, 3)))
    masses = np.array([12.0, 12, 14, 16, 12, 12, 1, 1])
    pairs = [*bonds(8), *[(k, k + 2) for k in range(6)]]
    lengths = np.array([np.linalg.norm(shape[i] - shape[j]) for i, j in pairs])
    v = 0.1 * np.random.default_rng(4).standard_normal((8, 3))
    energies: list[float] = []
    problem = Problem(factor * shape, masses, pairs, lengths, velocities=v)
    seen = program.seen(problem, 1e-3, 50, lambda frame: energies.append(frame.kinetic), project=True)
    return outcome(
        ("residual", seen.residual, 1e-10),
        ("kinetic energy after 50 steps, off by (relative)", abs(energies[-1] / energies[1] - 1), 1e-3),
    )


@case("X33", "Start 20 % off, and nobody asks to mend it", "refused, or mended without heating", "warn-or-raise")
def unasked(program: Program, quick: bool) -> Outcome:
    v = truths.spinning(WIDE, WIDE_MASSES, np.array([0.3, 0.2, -0.1]))
    problem = Problem(1.2 * WIDE, WIDE_MASSES, TRIANGLE, [1.0, 1.0, 1.6], velocities=v)
    end = program.run(problem, 1e-3, 5)
    return outcome(
        ("kinetic energy grown by a factor", problem.kinetic(end.v) / problem.kinetic(v), 2.0),
        ("residual", problem.residual(end.x), 1e-10),
    )


@case("H11", "Velocities that violate the constraints, projected", "|J v| 1e-12; energy lost as by the formula")
def bad_velocities(program: Program, quick: bool) -> Outcome:
    problem = _violating()
    problem = problem.but(pairs=[*problem.pairs, (0, 2), (3, 5)])
    first, _ = _first(program, problem)
    return outcome(*_tangent_checks(problem, first), ("positions moved by", np.abs(first.x - problem.x).max(), 1e-12))


def _violating() -> Problem:
    rng = np.random.default_rng(1)
    masses, v = rng.uniform(1, 16, 6), rng.standard_normal((6, 3))
    return Problem(truths.rotated(zigzag(6)), masses, bonds(6), velocities=v)


@case("X34", "Velocities that violate the constraints, and nobody asks", "refused, or projected", "warn-or-raise")
def bad_velocities_unasked(program: Program, quick: bool) -> Outcome:
    problem = _violating()
    end = program.run(problem, 1e-4, 1)
    rate = np.abs(problem.oracle.jacobian(end.x).toarray() @ end.v.ravel()).max()
    return outcome(("|J v| after a step", rate, 1e-10))


def rotor(offset: float = 0.0) -> Problem:
    """A dumbbell that turns with omega = 1 in the xy plane."""
    x = np.array([[0.75, 0, 0], [-0.45, 0, 0]]) + offset
    v = np.array([[0, 0.75, 0], [0, -0.45, 0]])
    return Problem(x, [1.5, 2.5], [(0, 1)], [1.2], velocities=v)


@case("H12", "1e6 and 1e9 from the origin", "length to 4 ulp; energy 1e-10 over 1000 steps")
def far_away(program: Program, quick: bool) -> Outcome:
    found: list[tuple[str, float, float]] = []
    for offset in (1e6, 1e9):
        seen = program.seen(rotor(offset), 0.01, 1000)
        length = abs(float(np.linalg.norm(np.subtract(*seen.end.x))) - 1.2)
        found += [
            (f"{offset:g}: energy", seen.energy_off, 1e-10),
            (f"{offset:g}: length", length, 4 * float(np.spacing(offset)) * 1.2),
        ]
    return outcome(*found)


TRICLINIC = np.array([[6.0, 0.0, 0.0], [1.5, 5.5, 0.0], [-1.0, 1.2, 6.5]])


@case("H13", "Atoms wrapped at every step, orthorhombic and triclinic", "as unwrapped to 1e-11 over 1e4 steps")
def wrapping(program: Program, quick: bool) -> Outcome:
    rng = np.random.default_rng(2)
    x = np.vstack([truths.rotated(WATER) + np.array([0.1, 0.2, 5.3]), truths.rotated(zigzag(5), 1) + 3.0])
    masses = np.concatenate([WATER_MASSES, np.full(5, 12.0)])
    pairs = [*TRIANGLE, (3, 4), (4, 5), (5, 6), (6, 7), (3, 5)]
    free = Problem(x, masses, pairs).moving(0.02 * rng.standard_normal((8, 3)) + np.array([0.1, -0.08, 0.12]))
    steps = program.length(quick, 500, 10_000)
    plain = program.run(free, 0.01, steps).x
    limit, remark = 1e-11, f"{steps} steps"
    if not isinstance(program, Core):
        # MD engines keep positions as doubles and nothing else: their own rounding, seen by a shift of the whole.
        shift = TRICLINIC.sum(axis=0)
        own = np.abs(program.run(free.but(positions=x + shift), 0.01, steps).x - shift - plain).max()
        limit = max(limit, 10 * own)
        remark += f"; a shift of all atoms alone changes positions by {own:.1e}"
    found: list[tuple[str, float, float]] = []
    for name, cell in (("orthorhombic", np.diag([6.0, 5.0, 5.5])), ("triclinic", TRICLINIC)):
        boxed = free.but(positions=wrapped(x, cell), cell=cell, lengths=free.held_lengths)
        apart = (program.run(boxed, 0.01, steps, wrap=True).x - plain) @ np.linalg.inv(cell)
        found.append((f"{name}: difference", np.abs((apart - np.round(apart)) @ cell).max(), limit))
    return outcome(*found, remark=remark)


@case("X35", "Bond longer than half the periodic cell", "refused: the image is ambiguous", "raise")
def long_in_cell(program: Program, quick: bool) -> Outcome:
    x, v = np.array([[0.2, 0.1, 0.1], [3.2, 0.1, 0.1]]), [[0, 0.1, 0], [0, -0.05, 0]]
    end = program.run(Problem(x, [1.0, 2.0], [(0, 1)], [3.0], cell=5.0 * np.eye(3), velocities=v), 0.01, 10)
    apart = abs(float(np.linalg.norm(end.x[0] - end.x[1])) - 3.0)
    return outcome(("length off by", apart, 1e-10), remark="without a word about which image is meant")


@case("H28", "Nothing held; one atom", "velocity Verlet to 1e-14 (relative) over 1000 steps")
def nothing_held(program: Program, quick: bool) -> Outcome:
    found: list[tuple[str, float, float]] = []
    limit, remark = (1e-14, "") if isinstance(program, Core) else (1e-12, "MD engines round in another order: 1e-12")
    for n in (1, 5):
        rng = np.random.default_rng(3)
        x, v, masses = rng.standard_normal((n, 3)), rng.standard_normal((n, 3)), rng.uniform(1, 2, n)
        end = program.run(Problem(x, masses, velocities=v, tether=1.0, anchors=0 * x), 0.02, 1000)
        y = _verlet(x, v, masses[:, None], leapfrog=program.name == "OpenMM")
        found.append((f"{n} atoms: difference", np.abs(end.x - y).max() / np.abs(y).max(), limit))
    return outcome(*found, remark=remark)


def _verlet(x: Array, v: Array, m: Array, leapfrog: bool) -> Array:
    """1000 steps of 0.02 under a force -x; velocities of the leapfrog are half a step behind."""
    half = 0.01
    v = v + half * x / m if leapfrog else v
    for _ in range(1000):
        v = v - half * x / m * (1 + leapfrog)
        x = x + 2 * half * v
        v = v if leapfrog else v - half * x / m
    return x
