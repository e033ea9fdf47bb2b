"""Reads reference cases of flows and growth, of 45 digits (tests/reference/README.md); exact mixtures."""

from __future__ import annotations

import json
from decimal import Decimal, localcontext
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from kcons.models.growth import ConstrainedHypercycle, Hypercycle

TESTS = Path(__file__).parents[1]


@cache
def case(name: str) -> dict[str, Any]:
    (path,) = TESTS.rglob(f"data/{name}.json")
    return json.loads(path.read_text(encoding="utf-8"))


def hypercycle(name: str) -> Hypercycle:
    p = case(name)["parameters"]
    return Hypercycle(p["n"], p["k_h"], p["mu0"], p["kT"])


def system(name: str) -> ConstrainedHypercycle:
    """The hypercycle of a case under its constraints; the last letter says which."""
    model = hypercycle(name)
    if name.endswith("_a"):
        return model.with_fixed_total()
    if name.endswith("_b"):
        return model.with_entropy_production(case(name)["parameters"]["tau_s"])
    return model.without_entropy_production()


def exact_energies(mu0: np.ndarray, kT: float, log_x: np.ndarray) -> tuple[Decimal, Decimal, Decimal]:
    """To forty digits: the sum of x, its Gibbs energy, and the least Gibbs energy of a mixture whose sum is 1."""
    with localcontext() as context:
        context.prec = 40
        T, levels = Decimal(float(kT)), [Decimal(float(level)) for level in mu0]
        y = [Decimal(float(value)) for value in log_x]
        x = [value.exp() for value in y]
        total = sum(x, Decimal(0))
        energy = sum((a * (level + T * (b - total.ln())) for a, b, level in zip(x, y, levels, strict=True)), Decimal(0))
        return total, energy, -T * sum(((-level / T).exp() for level in levels), Decimal(0)).ln()
