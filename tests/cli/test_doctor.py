"""What `kcons doctor` finds, and what it calls wrong."""

from __future__ import annotations

import numba
import openmm
import pytest

from kcons.cli import machine, main
from kcons.openmm.device import build


def test_a_healthy_machine(capsys):
    found, wrong = machine.examine()
    assert wrong == []
    assert found["packages"]["numba"] == numba.__version__
    assert found["extras"]["openmm"] == openmm.Platform.getOpenMMVersion()
    assert found["machine"]["SIMD"] in {f"{bits} bits" for bits in (64, 128, 256, 512)}
    assert f"{numba.get_num_threads()}" == found["machine"]["threads of Numba"]
    assert machine.version("no_such_package") is None
    names = {openmm.Platform.getPlatform(k).getName() for k in range(openmm.Platform.getNumPlatforms())}
    assert set(found["OpenMM platforms"]) >= names
    assert found["OpenMM platforms"]["Reference"] == found["OpenMM platforms"]["CPU"] == "runs"
    assert found["steps on the device"]["for"].startswith("Reference, CPU")


@pytest.mark.parametrize("right", [True, False])
def test_the_command_says_it(monkeypatch, capsys, right):
    """Platforms are tried, not listed."""
    tried = []
    monkeypatch.setattr(machine, "_platforms", lambda: tried.append(1) or {"CPU": "runs" if right else "does not run"})
    monkeypatch.setattr(build, "refusal", lambda: "" if right else "there is no C++ compiler")
    monkeypatch.setattr(build, "places", list)
    assert main.main(["doctor"]) == (0 if right else 1)
    text = capsys.readouterr().out
    assert tried and "OpenMM platforms" in text and ("nothing is wrong" in text) == right
    assert ("kcons warmup device" if right else "none: there is no C++ compiler") in text
    assert ("wrong: no platform of OpenMM" in text) != right
