"""Planar rings and sheets held by many distances: rows that are singular at second order."""

from __future__ import annotations

from functools import partial

import numpy as np

from hard_cases import truths
from hard_cases.case import Outcome, case, outcome
from hard_cases.motions import OMEGA, Seen, energy_off, every, flat_body, move
from hard_cases.problem import Array, Pairs, Problem
from hard_cases.programs import Program, together

SINGULAR = "right to 10 x the error of RATTLE and flat to 1e-8, or refused with the count of degrees of freedom"


def ring(n: int, radius: float = 1.0) -> Array:
    """A regular polygon in the xy plane."""
    angle = 2 * np.pi * np.arange(n) / n
    return radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)


@case("H04", "Square by 6 and hexagon by 15 distances", SINGULAR, "warn-or-raise")
def planar_rings(program: Program, quick: bool) -> Outcome:
    found: list[tuple[str, float, float]] = []
    for n in (4, 6):
        result = flat_body(program, quick, ring(n), np.ones(n), every(n))
        found += [check._replace(name=f"{n}-ring: {check.name}") for check in result.checks]
    return outcome(*found)


SIDES = [(i, (i + 1) % 6) for i in range(6)]
META = [(min(i, (i + 2) % 6), max(i, (i + 2) % 6)) for i in range(6)]
PARA = [(i, i + 3) for i in range(3)]


@case(
    "X10",
    "Planar hexagon by 9 distances (sides and para)",
    "right, or refused: a mechanism at a dead center",
    "warn-or-raise",
)
def hexagon_9(program: Program, quick: bool) -> Outcome:
    return _flexible(program, ring(6), SIDES + PARA, quick, "a mechanism, flat at the start")


_WIDE, _HIGH = 1.25 * np.sin(np.radians(65.0)), 1.25 * np.cos(np.radians(65.0))
BENZENE, BENZENE_MASSES = np.vstack([ring(6, 1.39), ring(6, 2.48)]), np.array([12.0] * 6 + [1.0] * 6)
FORMATE = np.array([[0, 0, 0], [_WIDE, -_HIGH, 0], [-_WIDE, -_HIGH, 0], [0, 1.1, 0]])
for number, title, shape, masses, pairs in (
    ("X11", "Planar hexagon by 12 distances (sides and meta)", ring(6), np.full(6, 12.0), SIDES + META),
    ("X12", "Planar hexagon by all 15 distances", ring(6), np.full(6, 12.0), every(6)),
    ("X13", "Square by all 6 distances", ring(4), np.full(4, 12.0), every(4)),
    ("X14", "Planar formate by all 6 distances", FORMATE, np.array([12.0, 16.0, 16.0, 1.0]), every(4)),
    ("X15", "Benzene by all 66 distances", BENZENE, BENZENE_MASSES, every(12)),
):
    case(number, title, SINGULAR, "warn-or-raise")(partial(flat_body, shape=shape, masses=masses, pairs=pairs))


@case("X16", "Benzene by its 12 bonds", "10 x the error of RATTLE; residual 1e-10")
def benzene_bonds(program: Program, quick: bool) -> Outcome:
    x = truths.rotated(BENZENE)
    pairs = [*SIDES, *[(k, k + 6) for k in range(6)]]
    v = 0.2 * np.random.default_rng(2).standard_normal((12, 3))
    return move(program, Problem(x, BENZENE_MASSES, pairs, velocities=v), 0.005, program.length(quick, 100, 400))


def sheet(columns: int, lines: int, bond: float = 1.42) -> tuple[Array, list[tuple[int, int]]]:
    """A flat honeycomb and its bonds."""
    a = bond * np.sqrt(3)
    points = [
        (i * a + (j % 2) * a / 2, 1.5 * bond * j + shift)
        for j in range(lines)
        for i in range(columns)
        for shift in (0.0, bond)
    ]
    x = np.array([[p, q, 0.0] for p, q in points])
    near = [(i, j) for i, j in every(len(x)) if abs(np.linalg.norm(x[i] - x[j]) - bond) < 1e-6]
    return x, near


@case(
    "X17",
    "Flat honeycomb by its bonds",
    "residual 1e-10; angular momentum 1e-10; energy 1e-5; or refused",
    "warn-or-raise",
)
def honeycomb(program: Program, quick: bool) -> Outcome:
    shape, pairs = sheet(6, 6)
    return _flexible(program, shape, pairs, quick, f"{len(pairs)} bonds")


@case("X18", "Flat porphyrin-like ring system, bonds and 1-3 distances", "right, or refused", "warn-or-raise")
def porphyrin(program: Program, quick: bool) -> Outcome:
    """Four five-rings joined by four bridging atoms: bonds and distances of second neighbors."""
    atoms: list[Array] = []
    pairs: list[tuple[int, int]] = []
    for k in range(4):
        center = 3.1 * np.array([np.cos(k * np.pi / 2), np.sin(k * np.pi / 2), 0])
        turn = np.pi + k * np.pi / 2 + 2 * np.pi * np.arange(5) / 5
        first = len(atoms)
        atoms += [center + 1.18 * np.array([np.cos(t), np.sin(t), 0]) for t in turn]
        pairs += [(first + i, first + (i + 1) % 5) for i in range(5)]
    for k in range(4):
        here, there = 5 * k + 4, 5 * ((k + 1) % 4) + 1
        middle = 0.5 * (atoms[here] + atoms[there])
        atoms.append(middle * (1 + 0.25 / np.linalg.norm(middle)))
        pairs += [(here, len(atoms) - 1), (there, len(atoms) - 1)]
    bonded = {frozenset(p) for p in pairs}
    neighbors = {i: [j for j in range(len(atoms)) if frozenset((i, j)) in bonded] for i in range(len(atoms))}
    seconds = {tuple(sorted(p)) for near in neighbors.values() for p in ((a, b) for a in near for b in near if a != b)}
    return _flexible(program, np.array(atoms), sorted({*(tuple(sorted(p)) for p in pairs), *seconds}), quick, "flat")  # type: ignore[arg-type]


def _flexible(program: Program, shape: Array, pairs: Pairs, quick: bool, remark: str) -> Outcome:
    """Invariants of free flight from tangent velocities of all directions."""
    x = truths.rotated(shape)
    masses = np.full(len(x), 12.0)
    problem = Problem(x, masses, pairs)
    v = problem.tangent(
        0.02 * np.random.default_rng(7).standard_normal(x.shape) + truths.spinning(x, masses, 0.05 * OMEGA)
    )
    problem = problem.but(velocities=v)
    seen = Seen(problem)
    turns: list[Array] = []
    watch = together(seen, lambda frame: turns.append(np.cross(frame.x, masses[:, None] * frame.v).sum(axis=0)))
    steps = program.length(quick, 100, 1000)
    program.run(problem, 0.005, steps, watch, project=True)
    turned = np.abs(np.array(turns) - turns[1]).max() / np.abs(turns[1]).max()
    return outcome(
        ("residual", seen.residual, 1e-10),
        ("angular momentum", turned, 1e-10),
        ("energy", energy_off(seen.energies), 1e-5),
        remark=f"{remark}, {len(pairs)} rows, {steps} steps",
    )
