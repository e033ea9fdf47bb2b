"""The examples on hard cases and stability run, and say what they should."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent.parent


def said(name, *words):
    result = subprocess.run(
        [sys.executable, str(ROOT / "examples" / name), *words],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT), "OPENMM_CPU_THREADS": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    return result.stdout


def test_hard_cases():
    shown = said("13_hard_cases.py", "X06", "Y01")
    assert "kcons            refused         SingularGeometryError" in shown
    assert "Y01  Cube by all 28 distances" in shown
    assert "kcons in OpenMM  right" in shown


def test_stability():
    shown = said("14_stability.py", "--trials", "10")
    assert "Rattle       largest step 1, then ConvergenceError" in shown
    assert "'NaN': 0, 'silent': 0, 'changed': 0, 'untyped error': 0" in shown
