"""Largest steps, drift of the energy, and reversal."""

from __future__ import annotations

import harness
import numpy as np
import pandas as pd
import pytest
import stability
from stability import SYSTEMS, Copies, attempt, drift, largest_step, reversal


def test_largest_step_of_the_free_rotor_is_one():
    """omega = 1: asin(omega dt) has no value beyond, and the failure is an error."""
    found = largest_step("Rattle", "rotor", quick=True)
    assert 0.9 <= found["largest step"] <= 1.0 < found["fails at"]
    assert found["how"] == "ConvergenceError"
    assert found["silent residual"] <= 1e-13
    assert attempt("Rattle", "rotor", 0.99, 50)[0] == "stable"


@pytest.mark.parametrize("name", SYSTEMS)
def test_copies_have_the_forces_of_the_system(name):
    problem = SYSTEMS[name](2)
    copies = Copies([SYSTEMS[name](1), problem])
    y = problem.x + 0.01 * np.random.default_rng(0).standard_normal(problem.x.shape)
    both = np.vstack([y, y])
    np.testing.assert_allclose(copies.forces(both, 0.0)[problem.n_atoms :], problem.forces(y), atol=1e-14)
    total, kinetic = copies.energies(both, copies.v)
    assert total[1] == pytest.approx(problem.potential(y) + problem.kinetic(problem.v), rel=1e-13)
    assert kinetic[1] == pytest.approx(problem.kinetic(problem.v), rel=1e-13)
    assert copies.residual(copies.x) <= 1e-15


def test_drift_and_reversal():
    found = drift("pendulum", 4, 2000)
    assert found["seeds"] == 4 and found["residual"] <= 1e-14
    assert abs(found["slope"]) <= 1e-6
    assert reversal("Rattle", "butane", 100)["missed by"] <= 1e-12
    assert "half steps" in reversal("OpenMM", "butane", 10)["words"]


def test_the_study_goes_on_and_finds_faults(tmp_path, monkeypatch, capsys):
    """Quick, of the rotor."""
    given = ["--quick", "--systems", "rotor", "--only", "reversal", "--out", str(tmp_path)]
    assert stability.main(given) == 0
    assert "Rattle" in capsys.readouterr().out
    head, table = harness.read(tmp_path / "stability.csv")
    assert head["settings"] == "quick=True" and set(table.part) == {"reversal"}
    monkeypatch.setattr(stability, "reversal", lambda *_: pytest.fail("done before"))
    assert stability.main(given) == 0
    row = {"piece": "steps, water, Rattle", "part": "steps", "method": "Rattle", "silent residual": 1e-3}
    steps = pd.DataFrame([row])
    assert stability.faults(steps) == ["steps, water, Rattle: residual 1.0e-03 without an error"]
    assert stability.faults(steps.assign(method="OpenMM")) == []
