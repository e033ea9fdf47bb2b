"""docs/equations.md names every equation of the notes, and nothing that does not exist."""

from __future__ import annotations

import ast
import pkgutil
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from committed_pages import ROOT, text_of

from kcons.constraints import projection

TEXT = text_of("equations.md")
LAST = 168
ROWS = [
    [cell.strip() for cell in line.strip("|").split("|")]
    for line in TEXT.split("## All equations")[1].splitlines()
    if line.startswith("| (")
]


def numbers(cell: str) -> list[int]:
    parts = ([int(n) for n in part.split("–")] for part in cell.strip("()").split(","))
    return [n for ends in parts for n in range(ends[0], ends[-1] + 1)]


@cache
def names_in(path: Path) -> set[str]:
    return {node.name for node in ast.parse(text_of(path)).body if isinstance(node, ast.FunctionDef)}


def test_every_equation_is_there_once_and_every_script_is_linked():
    assert [n for row in ROWS for n in numbers(row[0])] == list(range(1, LAST + 1))
    linked = set(re.findall(r"\(\.\./examples/notes/([\w.]+)\)", TEXT))
    scripts = {path.name for path in (ROOT / "examples" / "notes").glob("*_*.py")} - {"growth_results.py"}
    assert linked == scripts and len(linked) == 16


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_functions_and_tests_exist(row):
    _, what, functions, tests = row
    names, checks = (re.findall(r"`([^`]+)`", cell) for cell in (functions, tests))
    assert what and names and checks
    for name in names:
        assert name.startswith("kcons.") and pkgutil.resolve_name(name) is not None
    for check in checks:
        file, name = check.split("::")
        assert name.startswith("test_") and name in names_in(ROOT / "tests" / file), check


def test_principles_over_a_short_time():
    # (114)-(122): x(t + dt) of the constrained motion lies dt^2/2 M^-1 z from that of the free one, z does no work on
    # what the rows leave free, and no admissible motion comes closer in the metric of the masses.
    rng = np.random.default_rng(12)
    A, b, f = rng.normal(size=(2, 6)), rng.normal(size=2), rng.normal(size=6)
    masses, dt = np.repeat([1.0, 2.5], 3), 1e-3
    x, v = rng.normal(size=6), rng.normal(size=6)

    def ahead(a):
        return x + dt * v + 0.5 * dt**2 * a

    free = ahead(f / masses)
    true = projection.acceleration(A, [1.0, 2.5], f, b)
    z = projection.constraint_force(A, [1.0, 2.5], f, b)
    assert masses * (ahead(true) - free) == pytest.approx(0.5 * dt**2 * z, rel=1e-6, abs=1e-14)
    distance = projection.gauss_function(true, [1.0, 2.5], f)
    for _ in range(20):
        variation = projection.parallel_projector(A) @ rng.normal(size=6)
        assert abs(z @ variation) < 1e-12
        other = true + variation
        assert A @ other == pytest.approx(b)
        shift = np.sqrt(masses) * (ahead(other) - free)
        assert 0.5 * shift @ shift > (0.5 * dt**2) ** 2 * distance
        assert projection.gauss_function(other, [1.0, 2.5], f) > distance
