"""Motions that cases of many molecules share: tumbling, flying, being pushed out of the plane."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from hard_cases import truths
from hard_cases.case import Outcome, outcome
from hard_cases.problem import Array, Pairs, Problem
from hard_cases.programs import Frame, Program, together

OMEGA = np.array([0.9, -0.5, 0.7])


def every(n: int) -> list[tuple[int, int]]:
    """All pairs of n atoms."""
    return list(combinations(range(n), 2))


def tumble(program: Program, shape: Array, masses: Array, pairs: Pairs, quick: bool = True) -> Outcome:
    """Free flight of a rigid body against Euler's equations, its residual, and how many degrees of freedom are counted.

    The error may be ten times that of RATTLE for a body held without surplus rows.
    """
    x = truths.rotated(shape)
    dt, steps = 0.005, program.length(quick, 100, 1000)
    problem = Problem(x, masses, pairs, velocities=truths.spinning(x, masses, OMEGA))
    seen = Seen(problem)
    end = program.run(problem, dt, steps, seen)
    expected = truths.rigid_flight(x, masses, OMEGA, dt * steps)
    plain = float(np.abs(truths.rigid_rattle(x, masses, OMEGA, dt, steps) - expected).max())
    return outcome(
        ("residual", seen.residual, 1e-10),
        ("position error", np.abs(end.x - expected).max(), 10 * plain),
        ("degrees of freedom, miscounted by", abs(program.degrees_of_freedom(problem) - 6), 0),
        remark=f"{steps} steps",
    )


class Seen:
    """A watcher that keeps the largest residual, NaN once anything is, and all energies."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.residual = 0.0
        self.energies: list[float] = []

    def __call__(self, frame: Frame) -> None:
        found = self.problem.residual(frame.x)
        if not found <= self.residual and not np.isnan(self.residual):
            self.residual = found
        self.energies.append(frame.energy)


def energy_off(energies: Sequence[float]) -> float:
    """Largest relative change from the second on: the first of a leapfrog is of velocities half a step earlier."""
    return float(np.max(np.abs(np.array(energies[1:]) / energies[1] - 1)))


def move(program: Program, problem: Problem, dt: float, steps: int) -> Outcome:
    """A run of a body that can bend: against the dense theory, with ten times the error of RATTLE itself."""
    problem = problem.but(velocities=problem.tangent(problem.v))
    seen = Seen(problem)
    end = program.run(problem, dt, steps, seen)
    expected = truths.true_motion(problem, dt * steps)
    plain = float(np.abs(truths.dense_rattle(problem, dt, steps) - expected).max())
    return outcome(
        ("residual", seen.residual, 1e-10),
        ("position error", np.abs(end.x - expected).max(), 10 * plain),
        remark=f"{steps} steps",
    )


def flat_body(program: Program, quick: bool, shape: Array, masses: Array, pairs: Pairs) -> Outcome:
    """Tumbling against Euler's equations; then forces that would buckle it."""
    tumbled = tumble(program, shape, masses, pairs, quick=quick)
    x = truths.rotated(shape)
    normal = np.linalg.svd(x - x.mean(axis=0))[2][2]
    push = np.where(np.arange(len(x)) % 2 == 0, 1.0, -1.0)[:, None] * normal
    push[0] += 0.3 * normal
    problem = Problem(x, masses, pairs, push=push)
    seen, buckled = Seen(problem), [0.0]

    def watch(frame: Frame) -> None:
        finite = np.all(np.isfinite(frame.x))
        buckled.append(np.linalg.svd(frame.x - frame.x.mean(axis=0))[1][2] if finite else np.nan)

    steps = program.length(quick, 100, 2000)
    program.run(problem, 0.01, steps, together(seen, watch))
    return outcome(
        *tumbled.checks,
        ("buckled by", np.max(buckled), 1e-8),
        ("residual under a push", seen.residual, 1e-10),
        remark=f"{tumbled.remark}; {steps} steps under forces out of the plane",
    )
