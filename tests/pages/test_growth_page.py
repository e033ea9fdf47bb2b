"""The measurements of docs/growth.md: a small run of each."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest


@pytest.fixture(scope="module")
def script():
    path = Path(__file__).parents[2] / "examples" / "notes" / "growth_results.py"
    spec = importlib.util.spec_from_file_location("growth_results", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def rows_of(capsys):
    return [line.split() for line in capsys.readouterr().out.splitlines()[1:]]


def test_work_and_precision(script, capsys):
    script.work_precision("to t = 5", script.START, 5.0, (1e-6,))
    rows = {" ".join(row[:2]): [float(number) for number in row[5:]] for row in rows_of(capsys)[1:]}
    own, plain = rows["kcons DOP853"], rows["SciPy DOP853"]
    assert own[0] < 2e-6 > plain[0]
    # What the projection is for.
    assert own[2] < 1e-13 < 1e-9 < plain[2]
    assert np.isfinite(list(rows.values())).all()
