"""Motions that cases of many molecules share: tumbling, flying, being pushed out of the plane."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from hard_cases import truths
from hard_cases.case import Outcome, outcome
from hard_cases.problem import Array, Pairs, Problem
from hard_cases.programs import Frame, Program

OMEGA = np.array([0.9, -0.5, 0.7])


def every(n: int) -> list[tuple[int, int]]:
    """All pairs of n atoms."""
    return list(combinations(range(n), 2))


def miscounted(program: Program, problem: Problem, right: int) -> tuple[str, float, float]:
    """The check of degrees of freedom."""
    return "degrees of freedom, miscounted by", abs(program.degrees_of_freedom(problem) - right), 0


def tumble(program: Program, quick: bool, shape: Array, masses: Array, pairs: Pairs) -> Outcome:
    """Free flight of a rigid body against Euler's equations, its residual, and how many degrees of freedom are counted.

    The error may be ten times that of RATTLE for a body held without surplus rows.
    """
    x = truths.rotated(shape)
    dt, steps = 0.005, program.length(quick, 100, 1000)
    problem = Problem(x, masses, pairs, velocities=truths.spinning(x, masses, OMEGA))
    seen = program.seen(problem, dt, steps)
    expected = truths.rigid_flight(x, masses, OMEGA, dt * steps)
    plain = float(np.abs(truths.rigid_rattle(x, masses, OMEGA, dt, steps) - expected).max())
    return outcome(
        ("residual", seen.residual, 1e-10),
        ("position error", np.abs(seen.end.x - expected).max(), 10 * plain),
        miscounted(program, problem, 6),
        remark=f"{steps} steps",
    )


def move(program: Program, quick: bool, problem: Problem, full: int = 1000) -> Outcome:
    """A run of a body that can bend: against the dense theory, with ten times the error of RATTLE itself."""
    problem, dt, steps = problem.moving(problem.v), 0.005, program.length(quick, 100, full)
    seen = program.seen(problem, dt, steps)
    expected = truths.true_motion(problem, dt * steps)
    plain = float(np.abs(truths.dense_rattle(problem, dt, steps) - expected).max())
    return outcome(
        ("residual", seen.residual, 1e-10),
        ("position error", np.abs(seen.end.x - expected).max(), 10 * plain),
        remark=f"{steps} steps",
    )


def flat_body(program: Program, quick: bool, shape: Array, masses: Array, pairs: Pairs) -> Outcome:
    """Tumbling against Euler's equations; then forces that would buckle it."""
    tumbled = tumble(program, quick, shape, masses, pairs)
    x = truths.rotated(shape)
    normal = np.linalg.svd(x - x.mean(axis=0))[2][2]
    push = np.where(np.arange(len(x)) % 2 == 0, 1.0, -1.0)[:, None] * normal
    push[0] += 0.3 * normal
    buckled = [0.0]

    def watch(frame: Frame) -> None:
        finite = np.all(np.isfinite(frame.x))
        buckled.append(np.linalg.svd(frame.x - frame.x.mean(axis=0))[1][2] if finite else np.nan)

    steps = program.length(quick, 100, 2000)
    seen = program.seen(Problem(x, masses, pairs, push=push), 0.01, steps, watch)
    return outcome(
        *tumbled.checks,
        ("buckled by", np.max(buckled), 1e-8),
        ("residual under a push", seen.residual, 1e-10),
        remark=f"{tumbled.remark}; {steps} steps under forces out of the plane",
    )
