"""Constrained growth (hypercycles) and linear flows. ASE and OpenMM have none; kcons has them in its core.

Judges: the law that the entropy production prescribes, closed forms, and numbers found with 45 digits.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from systems.model_references import case as reference

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


@case("H34", "Entropy budget 1.1, 1.5 and 0.9 of the right one", "refused before the start", "raise", md_engines=NONE)
def wrong_budget(program: Program, quick: bool) -> Outcome:
    calls = {f"{f:g} of the budget": lambda f=f: float(grown(10.0, START, f * EXCESS).t[-1]) for f in (1.1, 1.5, 0.9)}
    return each_refused(calls)


@case("H35", "Near-extinction: ln x down to -2.6e4, and back", "ln x as with 20 digits, to 1e-6", md_engines=NONE)
def near_extinction(program: Program, quick: bool) -> Outcome:
    known = reference("A11_hypercycle_extinction_b")
    times = known["times"][4:7]
    found = grown(5.0, known["initial"]["x"], t_eval=times, **SHARP)
    off = np.abs(found.log_y.T / np.array(known["reference"]["ln_x"][4:7]) - 1).max(axis=1)
    return outcome(*((f"t = {t:g}: ln x off by (relative)", value, 1e-6) for t, value in zip(times, off, strict=True)))


@case("H36", "Entropy production asked for at equilibrium", "refused: already there", "raise", md_engines=NONE)
def at_equilibrium(program: Program, quick: bool) -> Outcome:
    found = grown(10.0, EQUILIBRIUM)
    return outcome(("moved by", np.abs(found.y[:, -1] - EQUILIBRIUM).max(), 1e-12))


@case("H37", "Populations that sum to 2", "x at t = 10 as found with 45 digits, to 1e-7", md_engines=NONE)
def sum_of_two(program: Program, quick: bool) -> Outcome:
    known = reference("A11_hypercycle_IC3sum2_b")
    found = grown(10.0, known["initial"]["x"], **SHARP)
    return outcome(("x off by", np.abs(found.y[:, -1] - known["reference"]["x"][5]).max(), 1e-7))


@case("H38", "Critical damping, 1 +- 1e-9 of it; Jordan block of 3", "45 digits, to 1e-12", md_engines=NONE)
def defective(program: Program, quick: bool) -> Outcome:
    def worst(matrix: Array, start: Numbers, times: Numbers, known: Array) -> float:
        off = np.abs(LinearFlow(matrix).exact(times, start) - known).max(axis=1)
        return float(np.max(off / np.abs(known).max(axis=1)))

    damped, block = reference("A12_damped_oscillator"), reference("A12_linear_jordan3")
    w, *start = (damped["parameters"][name] for name in ("w", "x0", "v0"))
    checks: list[tuple[str, float, float]] = []
    for regime in damped["regimes"]:
        if abs(regime["zeta"] - 1) < 1e-6:
            A, known = np.array([[0.0, 1.0], [-w * w, -2 * regime["zeta"] * w]]), np.array([regime["x"], regime["v"]]).T
            checks.append((f"zeta - 1 = {regime['zeta'] - 1:.0e}", worst(A, start, damped["times"], known), 1e-12))
    known = np.array(block["reference"]["x"])
    off = worst(np.array(block["A"]), block["initial"]["x"], block["times"], known)
    return outcome(*checks, ("Jordan block", off, 1e-12))
