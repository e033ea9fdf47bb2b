"""What `kcons doctor` finds, and what it calls wrong."""

from __future__ import annotations

import json

import numba
import openmm
import pytest

from kcons.cli import doctor, main
from kcons.openmm.device import build


@pytest.fixture(scope="module")
def found():
    return doctor.examine()


def test_a_healthy_machine(found):
    assert found["wrong"] == []
    assert found["packages"]["numba"] == numba.__version__
    assert found["extras"]["openmm"] == openmm.Platform.getOpenMMVersion()
    assert found["machine"]["SIMD"] in {f"{bits} bits" for bits in (64, 128, 256, 512)}
    assert f"{numba.get_num_threads()}" == found["machine"]["threads of Numba"]
    assert doctor.version("no_such_package") is None


def test_platforms_are_tried_not_listed(found):
    names = {openmm.Platform.getPlatform(k).getName() for k in range(openmm.Platform.getNumPlatforms())}
    assert set(found["OpenMM platforms"]) >= names
    assert found["OpenMM platforms"]["Reference"] == found["OpenMM platforms"]["CPU"] == "runs"


def test_whether_there_can_be_steps_on_the_device(found, monkeypatch):
    assert found["steps on the device"]["for"].startswith("Reference, CPU")
    monkeypatch.setattr(build, "refusal", lambda: "there is no C++ compiler")
    assert doctor.examine()["steps on the device"]["plugin"] == "none: there is no C++ compiler"
    monkeypatch.setattr(build, "refusal", str)
    monkeypatch.setattr(build, "places", list)
    assert "kcons warmup device" in doctor.examine()["steps on the device"]["plugin"]


def test_the_command_says_it(found, monkeypatch, capsys):
    monkeypatch.setattr(doctor, "examine", lambda: found)
    assert main.main(["doctor"]) == 0
    text = capsys.readouterr().out
    assert "nothing is wrong" in text and "OpenMM platforms" in text
    assert main.main(["doctor", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == found
    monkeypatch.setattr(doctor, "examine", lambda: {**found, "wrong": ["this; do that"]})
    assert main.main(["doctor"]) == 1
    assert "wrong: this; do that" in capsys.readouterr().out


def test_caches_that_cannot_be_written(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "not" / "there" / "yet"))
    wrong: list[str] = []
    assert "can be written" in doctor.caches(wrong)["$NUMBA_CACHE_DIR"] and not wrong
    (tmp_path / "file").touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file"))
    assert "cannot be written" in doctor.caches(wrong)["$NUMBA_CACHE_DIR"]
    assert len(wrong) == 1 and "set NUMBA_CACHE_DIR" in wrong[0]
