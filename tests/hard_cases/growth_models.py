"""Constrained growth (hypercycles) and linear flows. ASE and OpenMM have none; kcons has them in its core.

Judges: the law that the entropy production prescribes, closed forms, and numbers found with 45 digits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from hard_cases.case import Outcome, case, outcome
from hard_cases.problem import Array, Numbers
from hard_cases.programs import Program
from hard_cases.steps import each_refused
from kcons.models.flows import LinearFlow
from kcons.models.growth import Hypercycle, solve

NONE = "no growth models and no linear flows"
#: g_0 - g_eq of the start (0.6, 0.1, 0.1, 0.1, 0.1) of figure 11.
EXCESS = 0.334407148154132
START = np.array([0.6, 0.1, 0.1, 0.1, 0.1])
TAU = 30.0
MU0 = 0.1 + 0.05 * np.arange(1, 6)


EQUILIBRIUM = np.exp(-MU0) / np.exp(-MU0).sum()
SHARP = {"rtol": 1e-11, "atol": 1e-13}


def grown(end: float, start: Numbers, budget: float | None = None, **how: Any) -> Any:
    """Populations to some time."""
    return solve(Hypercycle().with_entropy_production(TAU, budget), (0.0, end), start, **how)


def _excess(log_x: Array) -> float:
    """g - g_eq = sum x ln(x/x_eq), as sum of x_eq (r ln r - r + 1) with r = x/x_eq: nothing cancels but rounding."""
    u = log_x - np.log(EQUILIBRIUM)
    return float(np.sum(EQUILIBRIUM * (u * np.exp(u) - np.expm1(u))))


@case("H33", "Hypercycle near equilibrium, to t = 900", "g - g_eq by its law, to 1 % of 3e-14", md_engines=NONE)
def near_equilibrium(program: Program, quick: bool) -> Outcome:
    times = [300.0, 600.0, 900.0]
    found = grown(900.0, START, t_eval=times)
    off = {t: abs(_excess(y) / (EXCESS * math.exp(-t / TAU)) - 1) for t, y in zip(times, found.log_y.T, strict=True)}
    return outcome(*((f"t = {t:g}: excess off by (relative)", value, 1e-2) for t, value in off.items()))


@case(
    "H34",
    "Entropy budget 10 % and 50 % too large, 10 % too small",
    "refused before the start",
    "raise",
    md_engines=NONE,
)
def wrong_budget(program: Program, quick: bool) -> Outcome:
    calls = {f"{f:g} of the budget": lambda f=f: float(grown(10.0, START, f * EXCESS).t[-1]) for f in (1.1, 1.5, 0.9)}
    return each_refused(calls)


@case("H35", "Near-extinction: ln x down to -2.6e4, and back", "ln x as with 20 digits, to 1e-6", md_engines=NONE)
def near_extinction(program: Program, quick: bool) -> Outcome:
    known = {
        4.0: [-0.42732377304907165, -2543.817392006705, -2761.201209194897, -2688.0424044343267, -1.0562781665592944],
        4.5: [-0.5026804706385988, -24091.61134399064, -26150.293535903424, -25454.723078009978, -0.9286342229800977],
        5.0: [-0.7806072485495416, -6.552024556026827, -7.090786460261402, -6.611340488132927, -0.6194000442938101],
    }
    start = [0.9, 0.04, 0.03, 0.02, 0.01]
    found = grown(5.0, start, t_eval=list(known), **SHARP)
    off = {t: np.abs(y / np.array(known[t]) - 1).max() for t, y in zip(known, found.log_y.T, strict=True)}
    return outcome(*((f"t = {t:g}: ln x off by (relative)", value, 1e-6) for t, value in off.items()))


@case(
    "H36",
    "Start at equilibrium, entropy production asked for",
    "refused: already at equilibrium",
    "raise",
    md_engines=NONE,
)
def at_equilibrium(program: Program, quick: bool) -> Outcome:
    found = grown(10.0, EQUILIBRIUM)
    return outcome(("moved by", np.abs(found.y[:, -1] - EQUILIBRIUM).max(), 1e-12))


@case("H37", "Populations that sum to 2", "x at t = 10 as found with 45 digits, to 1e-7", md_engines=NONE)
def sum_of_two(program: Program, quick: bool) -> Outcome:
    known = np.array(
        [0.23903300228620136, 0.3961302107295643, 0.6148242353159383, 0.4702890991184972, 0.2797234525497988]
    )
    found = grown(10.0, [0.7, 0.5, 0.4, 0.25, 0.15], **SHARP)
    return outcome(("x off by", np.abs(found.y[:, -1] - known).max(), 1e-7))


@case("H38", "Critical damping, 1 +- 1e-9 of it; Jordan block of 3", "closed forms to 1e-12", md_engines=NONE)
def defective(program: Program, quick: bool) -> Outcome:
    def worst(matrix: Array, start: Array, true: Callable[[float], Array], times: Sequence[float]) -> float:
        flow = LinearFlow(matrix)
        return max(float(np.abs(flow.exact(t, start) - true(t)).max() / np.abs(true(t)).max()) for t in times)

    w, start = 2.0, np.array([1.0, 0.5])
    checks: list[tuple[str, float, float]] = []
    for zeta in (1.0, 1 + 1e-9, 1 - 1e-9):
        A = np.array([[0.0, 1.0], [-w * w, -2 * zeta * w]])

        def critical(t: float, zeta: float = zeta, A: Array = A) -> Array:
            # e^(-zeta w t) (C + S (A + zeta w)), C and S even in the small root: three terms are exact to 1e-16.
            z = w * w * (zeta - 1) * (zeta + 1) * t * t
            C, S = 1 + z / 2 + z * z / 24, t * (1 + z / 6 + z * z / 120)
            return math.exp(-zeta * w * t) * (C * start + S * (A + zeta * w * np.eye(2)) @ start)

        checks.append((f"zeta - 1 = {zeta - 1:.0e}", worst(A, start, critical, (0.5, 1.0, 2.0, 5.0)), 1e-12))
    A, x0 = np.array([[-1.7, 1.0, 0.0], [0.0, -1.7, 1.0], [1.0, -3.0, 1.3]]), np.array([1.0, 2.0, -1.0])
    N = A + 0.7 * np.eye(3)

    def jordan(t: float) -> Array:
        return math.exp(-0.7 * t) * (x0 + t * N @ x0 + 0.5 * t * t * N @ N @ x0)

    return outcome(*checks, ("Jordan block", worst(A, x0, jordan, (0.5, 1.0, 5.0, 10.0)), 1e-12))
