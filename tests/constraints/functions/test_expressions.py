"""Formulas read and written as code: names, functions, exactness, files."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from kcons.constraints.functions import expressions
from kcons.constraints.functions.expressions import FUNCTIONS, code_of, parsed, undefined_part, width_of
from kcons.errors import InputError, UnsupportedError

NAMES = {**FUNCTIONS, "pi": np.pi, "": np.float64}


@pytest.mark.parametrize(
    ("formula", "item", "message"),
    [
        ("x1 - y", "y", r"'y' in .* is not known; known are x1, .* Give it as a parameter"),
        ("sine(x1)", "sine", r"sine\(x1\) .* no function of formulas; these are abs, acos"),
        ("atan2(x1)", "atan2", "atan2 of two"),
        ("x1^2", "formula", r"is not allowed.* a power is written \*\*"),
        ("x1 -", "formula", "cannot be read"),
        ("z1 = x1**2", "formula", "cannot be read.*write what is held at zero, the left side less the right one"),
        ("x1 if x2 else 0", "formula", "is not allowed"),
        ("x1.real", "formula", "is not allowed"),
        ("__import__('os').getcwd()", "formula", "is not allowed|no function"),
        ("x1*'a'", "formula", "is not allowed"),
        (3.0, "formula", "must be text"),
        ("3*t + a", "formula", "names no coordinate"),
        ("x3 - x1", "formula", "names atom 3 of a row and not atom 2"),
    ],
)
def test_what_is_no_formula_is_named(formula, item, message):
    with pytest.raises(InputError, match=message) as caught:
        width_of(formula, ["a"])
    assert caught.value.item == item


def test_a_gradient_of_zero_is_refused_before_anything_is_written(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    with pytest.raises(InputError, match="does not change with the positions"):
        code_of("x1 - x1 + 3.25", 1, ())
    assert not list(tmp_path.rglob("*.py"))


def test_every_function_is_differentiated_exactly():
    """Against complex steps, for all functions at once and each alone."""
    rng = np.random.default_rng(0)
    for name in sorted(FUNCTIONS):
        inner = "1 + x1**2*y1/9" if name in ("log", "sqrt", "abs") else "x1*y1/3 - z1**3/7"
        two = f"{name}({inner}, 2 + z1)" if name == "atan2" else f"{name}({inner})"
        code = code_of(f"{two}*y1 + x1/(2 + t)", 1, ())
        r = rng.uniform(0.2, 0.9, (3, 5))
        t = 0.3
        first = code.first(*r, t)
        for axis in range(3):
            h = np.zeros((3, 1))
            h[axis] = 1e-4
            up, down, far, deep = (code.first(*(r + k * h), t)[0] for k in (1, -1, 2, -2))
            slope = (8 * (up - down) - (far - deep)) / 12e-4
            np.testing.assert_allclose(first[1 + axis], slope, atol=1e-10, err_msg=name)


def test_smallest_undefined_part():
    tree = parsed("x1 + log(sqrt(1 - x1**2) - 2)/y1", ())[0]
    assert undefined_part(tree, {**NAMES, "x1": 0.5, "y1": 1.0}).startswith("log(sqrt(1 - x1 ** 2) - 2) is nan where ")
    assert undefined_part(tree, {**NAMES, "x1": 2.0, "y1": 1.0}) == "sqrt(1 - x1 ** 2) is nan where 1 - x1 ** 2 = -3"
    tree = parsed("1/x1", ())[0]
    assert undefined_part(tree, {**NAMES, "x1": 0.0}) == "1 / x1 is inf"
    assert undefined_part(tree, {**NAMES, "x1": 2.0}) is None


def test_shifts_and_time_are_found_out():
    assert code_of("(x1 - x2)**2 + sin(z1 - z2)*y1 - y2*sin(z1 - z2)", 2, ()).invariant
    assert not code_of("x1 - x2 + z1*1e-9", 2, ()).invariant
    assert not code_of("x1", 1, ()).invariant
    assert code_of("x1 - t", 1, ()).moving and not code_of("x1 - a", 1, ("a",)).moving


def test_without_sympy_the_remedy_is_named(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setitem(sys.modules, "sympy", None)
    with pytest.raises(UnsupportedError, match=r"SymPy, .*pip install 'kcons\[formulas\]'.*Custom"):
        code_of("x1 - 0.123456", 1, ())


PROGRAM = """
import sys
sys.modules["{absent}"] = None
import numpy as np
from kcons import ConstraintSet, Motion
from kcons.constraints import Formula
x = np.array([[0.3, 0.2, 0.1]])
motion = Motion(ConstraintSet(Formula("x1**2 + a*y1 - z1", 0, {{"a": 2.0}}, None), x, [1.0]), x)
print(motion.project_positions(x + 0.01, x)[0].tolist())
"""


def test_another_process_needs_neither_sympy_nor_the_compiler(tmp_path):
    """What the first one wrote serves the second one."""
    outputs = []
    for absent in ("nothing", "sympy"):
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM.format(absent=absent)],
            capture_output=True,
            text=True,
            check=True,
            cwd=Path(expressions.__file__).parents[3],
            env={**os.environ, "XDG_CACHE_HOME": str(tmp_path), "NUMBA_CACHE_DIR": "", "NUMBA_DEBUG_CACHE": "1"},
        )
        outputs.append(done.stdout)
    kept = [[line for line in out.splitlines() if "kcons-formulas" in line] for out in outputs]
    assert any("data saved" in line for line in kept[0]) and any("data loaded" in line for line in kept[1])
    assert not any("data saved" in line for line in kept[1])
    assert outputs[0].splitlines()[-1] == outputs[1].splitlines()[-1]
