"""Reads the reference cases of growth models; they were computed with 45 digits, see tests/reference/README.md."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

from kcons.models.growth import ConstrainedHypercycle, Hypercycle

DATA = Path(__file__).parents[1] / "models" / "growth" / "data"


@cache
def case(name: str) -> dict[str, Any]:
    return json.loads((DATA / f"{name}.json").read_text(encoding="utf-8"))


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
