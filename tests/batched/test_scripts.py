"""The example and the study that need torch."""

from pathlib import Path

import pytest
from committed_pages import said

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.mark.slow
def test_a_water_model_is_found_by_gradients(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "charge 0.417000 e, O-H 0.095720 nm" in said(EXAMPLES / "water_model_by_gradients.py")


@pytest.mark.slow
def test_the_study_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = said(EXAMPLES / "studies" / "batched.py", "--quick", "--out", "found")
    assert "tree of 21 bonds" in found and "drops of 27 waters" in found
