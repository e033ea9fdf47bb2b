"""The study keeps what it has, and its pages show it."""

from __future__ import annotations

import re

import pytest

from kcons.cli import main
from kcons.comparison.hard_cases import chosen, load, report, run
from kcons.comparison.hard_cases.worker import Worker
from kcons.comparison.study import json_files
from kcons.errors import InputError


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    kept = tmp_path_factory.mktemp("study") / "hard_cases.json"
    return run(only=["h02", "X06", "H22"], quick=True, kept=kept), kept


def test_cells_are_kept(result):
    found, kept = result
    stored = load(kept)
    assert stored["cells"] == json_files.plain(found["cells"])
    assert list(stored["cells"]) == ["H02", "H22", "X06"]
    assert stored["cells"]["H02"]["kcons"]["verdict"] == "refused"
    assert stored["cells"]["H22"]["ASE"]["verdict"] == "cannot express"
    assert stored["made_by"]["quick"] is True


def test_a_run_goes_on_where_it_was(result, monkeypatch, tmp_path):
    _, kept = result
    copy = tmp_path / "hard_cases.json"
    copy.write_text(kept.read_text())
    asked = []
    original = Worker.run

    def counted(self, number, program, quick, limit):
        asked.append((number, program))
        return original(self, number, program, quick, limit)

    monkeypatch.setattr(Worker, "run", counted)
    run(only=["H02", "X06", "X60"], quick=True, systems=["kcons"], kept=copy)
    assert asked == [("X60", "kcons")]
    assert list(load(copy)["cells"]) == ["H02", "H22", "X06", "X60"]
    # Other settings: nothing is taken over.
    run(only=["H02"], quick=False, systems=["kcons"], kept=copy)
    assert asked[1:] == [("H02", "kcons")]


def test_a_program_that_hangs_is_given_up():
    with Worker() as worker:
        cell = worker.run("H06", "kcons in ASE", False, 0.01)
        assert (cell.verdict, cell.met) == ("crash/NaN", False)
        assert "no answer within 0.01 s" in cell.text
        assert worker.run("H02", "kcons", True, 60.0).verdict == "refused"


def test_unknown_cases_are_refused(tmp_path):
    with pytest.raises(InputError, match="there is no case 'H99'; there are H01, H02"):
        chosen(["H99"])
    bad = tmp_path / "x.json"
    bad.write_text("{}")
    with pytest.raises(InputError, match="no result of kcons hardcases"):
        load(bad)


def test_pages(result, tmp_path):
    found, _ = result
    written = report.write(found, tmp_path)
    assert [path.name for path in written] == ["hard_cases.png", "hard_cases.html"]
    html = written[1].read_text(encoding="utf-8")
    assert "One bond with two targets" in html and "ContradictionError" in html
    assert not re.search(r"(?:src|href)=\"(?!data:|#)", html)
    text = report.markdown(found)
    assert "| H02 | One bond with two targets, 1.0 and 1.001 | refused (ContradictionError) |" in text
    assert report.failures(found) == []
    assert "kcons: 3 of 3 as asked for" in report.summary(found)


def test_command(tmp_path, capsys):
    assert main.main(["hardcases", "--list", "--only", "H14,X06"]) == 0
    assert capsys.readouterr().out.startswith("H14  Pendulum at 2 rad, 1e7 steps")
    assert main.main(["hardcases", "--quick", "--only", "X06", "--out", str(tmp_path / "out")]) == 0
    shown = capsys.readouterr().out
    assert "as asked for" in shown and "hard_cases.html" in shown
    assert main.main(["hardcases", "--only", "nothing", "--out", str(tmp_path / "other")]) == 2
    assert not (tmp_path / "other").exists()
