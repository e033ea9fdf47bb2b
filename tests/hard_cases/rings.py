"""Planar rings and sheets held by many distances: rows that are singular at second order."""

from __future__ import annotations

import numpy as np

from hard_cases import truths
from hard_cases.case import Outcome, case, outcome
from hard_cases.motions import OMEGA, every, flat_body, move
from hard_cases.problem import Array, Pairs, Problem
from hard_cases.programs import Program

SINGULAR = "right to 10 x the error of RATTLE and flat to 1e-8, or refused with the count of degrees of freedom"


def ring(n: int, radius: float = 1.0) -> Array:
    """A regular polygon in the xy plane."""
    angle = 2 * np.pi * np.arange(n) / n
    return radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)


@case("H04", "Square by 6 and hexagon by 15 distances", SINGULAR, "warn-or-raise")
def planar_rings(program: Program, quick: bool) -> Outcome:
    found = {n: flat_body(program, quick, ring(n), np.ones(n), every(n)) for n in (4, 6)}
    return outcome(*(check for n, result in found.items() for check in result.named(f"{n}-ring")))


SIDES = [(i, (i + 1) % 6) for i in range(6)]
META = [(min(i, (i + 2) % 6), max(i, (i + 2) % 6)) for i in range(6)]
PARA = [(i, i + 3) for i in range(3)]
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
    case(number, title, SINGULAR, "warn-or-raise", shape=shape, masses=masses, pairs=pairs)(flat_body)


@case("X16", "Benzene by its 12 bonds", "10 x the error of RATTLE; residual 1e-10")
def benzene_bonds(program: Program, quick: bool) -> Outcome:
    pairs = [*SIDES, *[(k, k + 6) for k in range(6)]]
    v = 0.2 * np.random.default_rng(2).standard_normal((12, 3))
    return move(program, quick, Problem(truths.rotated(BENZENE), BENZENE_MASSES, pairs, velocities=v), 400)


def sheet(columns: int, lines: int, bond: float = 1.42) -> tuple[Array, list[tuple[int, int]]]:
    """A flat honeycomb and its bonds."""
    a = bond * np.sqrt(3)
    points = [
        (i * a + (j % 2) * a / 2, 1.5 * bond * j + shift, 0.0)
        for j in range(lines)
        for i in range(columns)
        for shift in (0.0, bond)
    ]
    x = np.array(points)
    return x, [(i, j) for i, j in every(len(x)) if abs(np.linalg.norm(x[i] - x[j]) - bond) < 1e-6]


def porphyrin() -> tuple[Array, list[tuple[int, int]]]:
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
    near = [[j for j in range(len(atoms)) if {i, j} in bonded] for i in range(len(atoms))]
    held = {*bonded, *(frozenset((a, b)) for mine in near for a in mine for b in mine if a != b)}
    return np.array(atoms), sorted((min(pair), max(pair)) for pair in held)


FLIGHT = "residual 1e-10; angular momentum 1e-10; energy 1e-5; or refused"
DEAD = "right, or refused: a mechanism at a dead center"
FLAT = "a mechanism, flat at the start"
PORPHYRIN = "Flat porphyrin-like ring system, bonds and 1-3 distances"
_SHEET, _PORPHYRIN = sheet(6, 6), porphyrin()


@case("X10", "Planar hexagon by 9 distances (sides and para)", DEAD, "warn-or-raise", body=(ring(6), SIDES + PARA))
@case("X17", "Flat honeycomb by its bonds", FLIGHT, "warn-or-raise", body=_SHEET, said=f"{len(_SHEET[1])} bonds")
@case("X18", PORPHYRIN, "right, or refused", "warn-or-raise", body=_PORPHYRIN, said="flat")
def flexible(program: Program, quick: bool, body: tuple[Array, Pairs], said: str = FLAT) -> Outcome:
    """Invariants of free flight from tangent velocities of all directions."""
    x, masses = truths.rotated(body[0]), np.full(len(body[0]), 12.0)
    v = 0.02 * np.random.default_rng(7).standard_normal(x.shape) + truths.spinning(x, masses, 0.05 * OMEGA)
    turns: list[Array] = []
    steps = program.length(quick, 100, 1000)
    seen = program.seen(
        Problem(x, masses, body[1]).moving(v),
        0.005,
        steps,
        lambda frame: turns.append(np.cross(frame.x, masses[:, None] * frame.v).sum(axis=0)),
        project=True,
    )
    turned = np.abs(np.array(turns) - turns[1]).max() / np.abs(turns[1]).max()
    return outcome(
        ("residual", seen.residual, 1e-10),
        ("angular momentum", turned, 1e-10),
        ("energy", seen.energy_off, 1e-5),
        remark=f"{said}, {len(body[1])} rows, {steps} steps",
    )
