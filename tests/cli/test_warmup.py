"""`kcons warmup`: what it compiles is there afterwards."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import kcons
from kcons.cli import machine, main
from kcons.constraints import compilation
from kcons.constraints.compilation import announcer
from kcons.openmm.device import build

#: A small molecule with angles, as a user's first script has it; says what it compiled.
MOLECULE = """
import numpy as np
from kcons import ConstraintSet, Motion, State, System, run
from kcons.constraints import Angle, Distance
from kcons.constraints.compilation import announcer
from kcons.openmm.device import build
x = np.array([[0, 0, 0], [1.5, 0, 0], [2, 1.4, 0], [3.5, 1.4, 0.5], [-0.4, -1, 0.1]])
rows = [Distance([[0, 1], [1, 2], [2, 3], [0, 4]]), Angle([[0, 1, 2], [1, 2, 3]])]
motion = Motion(ConstraintSet(rows, x, [12, 12, 16, 1, 1]), x)
v = motion.project_velocities(x, np.sin(np.arange(15)).reshape(5, 3))
end = run(System(motion, lambda x, t: -x), State(x, v), 0.01, 5)
assert motion.report(end.positions, end.velocities)
print(announcer.seconds)
"""
#: Says which kernels are there, and for what arguments.
KERNELS = """
import gc, json
from numba.core.registry import CPUDispatcher
found = [kernel for kernel in gc.get_objects() if isinstance(kernel, CPUDispatcher)]
names = {f"{k.py_func.__module__}.{k.py_func.__qualname__} {s}" for k in found for s in k.signatures}
print(json.dumps(sorted(name for name in names if name.startswith("kcons."))))
"""


def process(*arguments, **environment):
    given = os.environ | {"PYTHONPATH": str(Path(kcons.__file__).parents[1])} | environment
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, env=given, check=True)


def test_what_was_compiled_beforehand_is_there():
    """Nothing that the molecule calls is anything but what the command has called, whatever others have compiled."""
    warmed = process("-c", f"from kcons.cli import main; main.main(['warmup', 'butane']){KERNELS}")
    told, called = warmed.stdout.splitlines()
    assert re.match("butane: (compiled in|is there)", told)
    assert "This happens once" not in warmed.stderr  # the command says it itself
    used = process("-c", MOLECULE + KERNELS)
    seconds, needed = used.stdout.splitlines()
    assert (float(seconds), used.stderr) == (0.0, "")
    assert json.loads(needed) and set(json.loads(needed)) <= set(json.loads(called))


@pytest.fixture(autouse=True)
def small_as_before():
    before = compilation.SMALL
    yield
    compilation.SMALL = before


def test_it_says_what_was_compiled(monkeypatch, capsys):
    """Only what is not there: a kind that takes a second, which it does once."""
    left = [1.0, 0.0]

    def slow(name):
        announcer.seconds += left.pop(0)
        return ""

    monkeypatch.setattr(machine, "_system", slow)
    monkeypatch.setattr(announcer, "seconds", 0.0)
    monkeypatch.setattr(announcer, "announced", True)
    assert [main.main(["warmup", "chain"]) for _ in range(2)] == [0, 0]
    first, second = capsys.readouterr().out.splitlines()
    assert first == "chain: compiled in 1.0 s" and second.startswith("chain: is there")


def test_a_file_of_ones_own(tmp_path, monkeypatch, capsys):
    """Needs no forces; a name that is none is refused before anything is compiled."""
    monkeypatch.setattr(announcer, "announced", True)
    (tmp_path / "water.xyz").write_text("3\n\nO 0 0 0\nH 0.9572 0 0\nH -0.2400 0.9266 0\n")
    assert main.main(["warmup", str(tmp_path / "water.xyz")]) == 0
    assert "water.xyz: " in capsys.readouterr().out
    assert main.main(["warmup", "chain", "nowhere"]) == 2
    assert capsys.readouterr().out == ""


def test_what_cannot_be_compiled(monkeypatch, capsys):
    monkeypatch.setattr(machine, "find_spec", lambda name: None)
    assert main.main(["warmup", "alanine"]) == 0
    assert capsys.readouterr().out == "alanine: OpenMM is not installed\n"
    monkeypatch.undo()
    monkeypatch.setattr(build, "refusal", lambda: "there is no C++ compiler")
    assert main.main(["warmup", "device"]) == 0
    assert capsys.readouterr().out == "device: there is no C++ compiler\n"
