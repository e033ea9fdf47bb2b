"""The table of hard cases: verdicts of programs side by side, silent failures told, programs that hang given up."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import harness
import pytest
from hard_cases.case import all_cases

PATH = Path(harness.__file__).with_name("hard_cases.py")


@pytest.fixture(scope="module")
def study():
    """Not `import hard_cases`: that is what the cases are called."""
    spec = importlib.util.spec_from_file_location("hard_cases_study", PATH)
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_programs_side_by_side(study, tmp_path, capsys):
    assert study.main(["--quick", "--only", "H02,X06,X40", "--out", str(tmp_path)]) == 0
    assert "kcons: 3 of 3 as asked for" in capsys.readouterr().out
    _, table = harness.read(tmp_path / "hard_cases.csv")
    assert list(table.program[:5]) == ["kcons", "kcons in ASE", "kcons in OpenMM", "ASE", "OpenMM"]
    wide = study.tables(table)["verdicts"]
    assert list(wide.case) == ["H02", "X06", "X40"]
    assert wide.kcons[0] == "refused (ContradictionError)"
    # A silent failure of kcons ends with 1 and a line; one of others does not.
    table.loc[table.program == "ASE", "verdict"] = "silently wrong"
    assert study.silent(table) == []
    table.loc[table.program == "kcons", "verdict"] = "silently wrong"
    assert study.silent(table)[0].startswith("H02, kcons: silently wrong: ContradictionError")


def test_a_program_that_hangs_is_given_up(study, monkeypatch):
    monkeypatch.setattr(study, "LIMITS", (0.01, 0.01))
    child = study.Child()
    cell = child.cell(all_cases()["H06"], "kcons in ASE", False)
    assert (cell.verdict, cell.met) == ("crash/NaN", False)
    assert "no answer within 0.01 s" in cell.text
    monkeypatch.setattr(study, "LIMITS", (100.0, 100.0))
    assert child.cell(all_cases()["H02"], "kcons", True).verdict == "refused"
    child.pool.shutdown()


def test_a_verdict_in_words_and_unknown_cases(study, tmp_path, capsys):
    assert study.words_of({"verdict": "right", "words": "", "check": "a", "value": 0.9}) == "right: a 0.9"
    with pytest.raises(SystemExit):
        study.main(["--only", "H99", "--out", str(tmp_path)])
    assert "there are cases H01" in capsys.readouterr().err
