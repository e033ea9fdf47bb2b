"""The study keeps what it has, and its pages show it."""

from __future__ import annotations

import pytest

from kcons.comparison.hard_cases import chosen, load, run
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


def test_cases_are_found_without_their_noughts():
    assert list(chosen(["x6", "h2", "H22"])) == ["H02", "H22", "X06"]


def test_unknown_cases_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"there is no case 'H99' .*; there are H01, H02"):
        chosen(["H99"])
    bad = tmp_path / "x.json"
    bad.write_text("{}")
    with pytest.raises(InputError, match="no result of kcons hardcases"):
        load(bad)
