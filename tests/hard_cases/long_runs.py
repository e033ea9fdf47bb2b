"""Long runs: drift of the energy and of the residual."""

from __future__ import annotations

import numpy as np

from hard_cases.case import Outcome, case, outcome
from hard_cases.problem import Array, Problem
from hard_cases.programs import Core, Program

#: Steps of the pendulum for each program: quick and full.
STEPS = {
    "kcons": (20_000, 10_000_000),
    "kcons in ASE": (3_000, 300_000),
    "kcons in OpenMM": (2_000, 200_000),
    "ASE": (500, 20_000),
    "OpenMM": (2_000, 500_000),
}


def pendulum(angle: float) -> Problem:
    """Mass 1 on a rod of length 1 about a fixed atom, gravity 1, released at `angle` from below."""
    x = np.array([[0.0, 0.0, 0.0], [np.sin(angle), 0.0, -np.cos(angle)]])
    return Problem(x, [1.0, 1.0], [(0, 1)], [1.0], fixed=[0], push=np.array([[0, 0, 0], [0, 0, -1.0]]))


def secular_drift(energies: Array) -> float:
    """Difference of the means over both halves under a smooth window: the oscillation cancels."""
    n = len(energies) // 2
    window = np.sin(np.pi * (np.arange(n) + 0.5) / n) ** 4
    return float((energies[n : 2 * n] @ window - energies[:n] @ window) / window.sum())


@case("H14", "Pendulum at 2 rad, 1e7 steps", "secular energy 1e-6 over 1e7 steps of 0.01 (rms 2.1e-5); residual 1e-14")
def long_pendulum(program: Program, quick: bool) -> Outcome:
    steps = STEPS[program.name][0 if quick else 1]
    seen = program.seen(pendulum(2.0), 0.01, steps, every=5)
    drift = 2 * abs(secular_drift(np.array(seen.energies)))
    # The windowed mean of few periods knows the drift no better than the oscillation allows.
    limit = 1e-6 if steps >= 1_000_000 else 1e-6 + 2.1e-5 * 10_000 / steps
    return outcome(
        ("secular drift of the energy", drift, limit),
        ("residual", seen.residual, 1e-14 if isinstance(program, Core) else 1e-12),
        remark=f"{steps:g} steps, rms {np.std(seen.energies):.2g}",
    )


@case(
    "H15",
    "Accelerations alone, no projection",
    "not what is done by default: residual 1e-12 at t = 200 for dt 0.005 to 0.04",
)
def no_projection(program: Program, quick: bool) -> Outcome:
    problem, horizon = pendulum(2.0), program.pace * (20.0 if quick else 200.0)
    found = [
        (f"dt {dt:g}: residual", program.seen(problem, dt, round(horizon / dt), every=20).residual, 1e-12)
        for dt in (0.005, 0.04)
    ]
    return outcome(*found, remark=f"t = {horizon:g}")
