"""Chains: mass ratios, length, and how straight they are."""

from __future__ import annotations

import time
import tracemalloc

import numpy as np

from hard_cases import truths
from hard_cases.case import Outcome, case, outcome
from hard_cases.motions import move
from hard_cases.problem import Array, Problem
from hard_cases.programs import Core, Program


def zigzag(n: int, degrees: float = 110.0, length: float = 1.0) -> Array:
    """A planar chain of n atoms with equal bonds and angles."""
    half = np.radians(degrees / 2)
    k = np.arange(n)
    return length * np.stack([k * np.sin(half), (k % 2) * np.cos(half), 0.0 * k], axis=1)


def bonds(n: int) -> list[tuple[int, int]]:
    """Bonds of a chain of n atoms."""
    return [(k, k + 1) for k in range(n - 1)]


RATIO = "residual 1e-10; center of mass 1e-12; energy 1e-3 over 1e4 steps"


@case("X20", "Chain of 20, masses 1 and 1e3 in turn", RATIO, ratio=1e3)
@case("X21", "Chain of 20, masses 1 and 1e6 in turn", RATIO, ratio=1e6)
@case("X22", "Chain of 20, masses 1 and 1e8 in turn", RATIO, ratio=1e8)
def mass_ratio(program: Program, quick: bool, ratio: float) -> Outcome:
    n = 20
    x = truths.rotated(zigzag(n, 156.0, 0.15))
    masses = np.where(np.arange(n) % 2 == 0, 1.0, ratio)
    # In the frame of the center of mass: rounding of large coordinates would be seen otherwise.
    x -= masses @ x / masses.sum()
    v = 0.0075 * np.random.default_rng(0).standard_normal((n, 3)) / np.sqrt(masses)[:, None]
    v -= masses @ v / masses.sum()
    centers: list[Array] = []
    steps = program.length(quick, 500, 10_000)
    seen = program.seen(
        Problem(x, masses, bonds(n)).moving(v),
        0.01,
        steps,
        lambda frame: centers.append(masses @ frame.x / masses.sum()),
        every=5,
    )
    return outcome(
        ("residual", seen.residual, 1e-10),
        ("center of mass", np.abs(np.array(centers) - centers[0]).max(), 1e-12),
        ("energy", seen.energy_off, 1e-3),
        remark=f"{steps} steps",
    )


@case("H08", "Chain of 20, masses 1 and 1e12 in turn", "residual 1e-10; center 1e-12 over 1e4 steps; |J a| 1e-14")
def mass_ratio_12(program: Program, quick: bool) -> Outcome:
    found = mass_ratio(program, quick, 1e12)
    if not isinstance(program, Core):
        return found
    # The acceleration itself, against the rows of the dense theory.
    x = truths.rotated(zigzag(20, 156.0))
    masses = np.where(np.arange(20) % 2 == 0, 1.0, 1e12)
    problem = Problem(x, masses, bonds(20))
    rng = np.random.default_rng(0)
    v = problem.tangent(rng.standard_normal((20, 3)) / np.sqrt(masses)[:, None])
    a = program.system(problem).motion.acceleration(x, v, rng.standard_normal((20, 3)))
    held = problem.oracle
    rows = held.jacobian(x).toarray()
    miss = np.abs(rows @ a.ravel() - held.acceleration_target(x, v)) / np.linalg.norm(rows, axis=1)
    return outcome(*found.checks, ("|J a - b|", miss.max() / np.linalg.norm(a), 1e-14), remark=found.remark)


@case("H16", "Chains of 1e5 bonds, random and straight", "residual 1e-12, or as stored; 0.5 s a solve; < 1 GB")
def long_chain(program: Program, quick: bool) -> Outcome:
    n = (10_000 if quick else 100_000) + 1
    if program.name == "ASE":
        # ASE needs seconds for a hundred bonds.
        n = 101
    rng = np.random.default_rng(0)
    found: list[tuple[str, float, float]] = []
    for shape in ("random", "straight"):
        x = np.arange(n)[:, None] * np.array([1.0, 0, 0])
        if shape == "random":
            d = rng.standard_normal((n, 3))
            x = np.cumsum(d / np.linalg.norm(d, axis=1, keepdims=True), axis=0)
        x -= x[n // 2]
        v = rng.standard_normal((n, 3))
        problem = Problem(x, np.ones(n), bonds(n), np.ones(n - 1), velocities=v)
        limit = max(1e-12, 4 * float(np.spacing(np.abs(x).max())))
        if not isinstance(program, Core):
            found.append((f"{shape}: residual", program.seen(problem, 0.02, 1, project=True).residual, limit))
            continue
        for watched in (False, True):  # kernels are compiled before
            if watched:
                tracemalloc.start()
            motion = program.system(problem).motion
            times = [time.perf_counter()]
            tangent = motion.project_velocities(x, v)
            times.append(time.perf_counter())
            y = motion.project_positions(x + 0.02 * v, x)
            times.append(time.perf_counter())
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        rows = problem.oracle.jacobian(x)
        found += [
            (f"{shape}: |A v|", float(np.abs(rows @ tangent.ravel()).max()), 1e-12),
            (f"{shape}: seconds a solve", np.diff(times).max(), 0.5),
            (f"{shape}: memory (GB)", peak / 1e9, 0.3),
            (f"{shape}: residual", problem.residual(y), limit),
        ]
    return outcome(*found, remark=f"{n - 1} bonds")


@case("X23", "Near-straight chains (179 and 180 degrees) of 100 bonds", "residual 1e-10; energy of free flight")
def near_straight(program: Program, quick: bool) -> Outcome:
    found: list[tuple[str, float, float]] = []
    steps = program.length(quick, 20, 500)
    for degrees in (179.0, 180.0):
        x = truths.rotated(zigzag(101, degrees))
        v = 0.1 * np.random.default_rng(4).standard_normal(x.shape)
        seen = program.seen(Problem(x, np.full(101, 12.0), bonds(101)).moving(v), 0.005, steps)
        found += [(f"{degrees:g}: residual", seen.residual, 1e-10), (f"{degrees:g}: energy", seen.energy_off, 1e-3)]
    return outcome(*found, remark=f"{steps} steps each")


@case("X24", "Puckered ring of six bonds", "10 x the error of RATTLE; residual 1e-10")
def puckered_ring(program: Program, quick: bool) -> Outcome:
    angle = 2 * np.pi * np.arange(6) / 6
    x = truths.rotated(np.stack([np.cos(angle), np.sin(angle), 0.35 * (-1.0) ** np.arange(6)], axis=1))
    v = 0.4 * np.random.default_rng(5).standard_normal((6, 3))
    return move(program, quick, Problem(x, np.full(6, 14.0), [*bonds(6), (0, 5)], velocities=v))
