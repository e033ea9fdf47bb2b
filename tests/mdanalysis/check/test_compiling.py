"""Kernels that are in no cache are compiled by another process, on a sample that takes the same ones."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import numba
import numpy as np
import pytest
import water_files as files

from kcons.constraints import Angle, Distance
from kcons.constraints.compilation import SMALL
from kcons.constraints.constraint_set import ConstraintSet
from kcons.mdanalysis.check import compiling
from kcons.mdanalysis.check.compiling import Frame, compiled_elsewhere, sample_of
from kcons.mdanalysis.check.files.file_precision import FilePrecision

N = 40
#: A check in a process of its own: kernels of kcons that it compiled itself, and other processes that it started.
CHECK = """
import json, subprocess, sys
from numba.core import event
from kcons.mdanalysis import check_trajectory

class Compiled(event.Listener):
    def on_start(self, event):
        pass
    def on_end(self, event):
        kernel = event.data["dispatcher"]
        if kernel.py_func.__module__.startswith("kcons.") and event.data["args"] in kernel.overloads:
            compiled.append(kernel.py_func.__qualname__)

compiled, started, run = [], [], subprocess.run
subprocess.run = lambda *words, **options: started.append(words) or run(*words, **options)
event.register("numba:compile", Compiled())
for words in json.loads(sys.argv[1]):
    compiled.clear(), started.clear()
    result = check_trajectory(*words)
    print(json.dumps([compiled, len(started), result.rank, result.series["largest Å"]]))
"""


def checked(cache, *checks):
    """What is said of checks, one after another in one process, by the words of each."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(cache)}
    words = json.dumps([[str(word) for word in check] for check in checks])
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", CHECK, words], capture_output=True, text=True, env=environment
    )
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_the_process_that_checks_compiles_nothing(tmp_path):
    x = files.water(N, 3)
    topology = files.topology(tmp_path / "w.gro", N, x[0])
    blocks = files.write(tmp_path / "w.dcd", x)
    moving = files.write(tmp_path / "w.trr", x, velocities=np.ones_like(x))
    # Frames one by one, with velocities: other kernels, of which some are there.
    first, second = checked(tmp_path, (blocks, topology), (moving, topology))
    for compiled, started, rank, _ in (first, second):
        assert (compiled, started, rank) == ([], 1, 3 * N)
    largest = first[-1]
    np.testing.assert_allclose(largest, second[-1], atol=1e-5)
    # Nothing is cold any more.
    assert checked(tmp_path, (blocks, topology)) == [[[], 0, 3 * N, largest]]


def test_nor_where_there_are_so_many_rows_that_nothing_is_left_to_python(tmp_path):
    n = SMALL // 3 + 1
    x = files.water(n, 1)
    words = files.write(tmp_path / "w.dcd", x), files.topology(tmp_path / "w.gro", n, x[0])
    ((compiled, started, rank, _),) = checked(tmp_path, words)
    assert (compiled, started, rank) == ([], 1, 3 * n)


@pytest.mark.slow
@pytest.mark.parametrize("constrain", ["allbonds", "hangles"])
def test_nor_where_clusters_are_large(tmp_path, constrain):
    data = pytest.importorskip("MDAnalysisTests.datafiles")
    ((compiled, started, rank, _),) = checked(tmp_path, (data.DCD, data.PSF, constrain))
    assert (compiled, started) == ([], 1)
    assert rank > 3000


def frame(x):
    return Frame(np.asarray(x, dtype=np.float32).ravel(), None, None, 0.0, False)


def test_a_sample_has_a_few_clusters_of_each_kind():
    n = 500
    x = np.random.default_rng(3).normal(size=(3 * n + 2 * n + 3 * n, 3)) * 20
    pairs, end = files.pairs(n), 3 * n
    bonds = end + np.arange(2 * n).reshape(-1, 2)
    bends = 5 * n + np.arange(3 * n).reshape(-1, 3)
    held = ConstraintSet([Distance(pairs), Distance(bonds), Angle(bends)], x, np.ones(len(x)))
    sample = sample_of(held, frame(x), FilePrecision("XTC", 0.01, exact=True), True)
    few = compiling.OF_A_KIND
    part = sample.constraint_set
    assert [(item.family, item.n_rows) for item in part.constraints] == [
        ("Distance", 3 * few),
        ("Distance", few),
        ("Angle", few),
    ]
    assert part.n_atoms == 8 * few == len(sample.frame.x) / 3
    np.testing.assert_allclose(part.value(sample.frame.x.reshape(-1, 3).astype(float)), 0.0, atol=1e-4)
    assert (sample.precision.grid, sample.rank) == (0.01, True)
    sample.use()


def kernel(module):
    def double(x):
        return 2 * x

    double.__module__ = module
    return numba.njit(double)


def test_only_what_is_ours_and_cold_is_compiled_elsewhere(monkeypatch):
    used = []
    monkeypatch.setattr(compiling, "_use_elsewhere", used.append)
    ours, other = kernel("kcons.some"), kernel("some")
    assert compiled_elsewhere(lambda: "sample", lambda: ours(2)) == 4
    assert used == ["sample"]
    assert compiled_elsewhere(lambda: "sample", lambda: ours(3)) == 6
    assert compiled_elsewhere(lambda: "sample", lambda: other(3)) == 6
    assert used == ["sample"]


@pytest.mark.parametrize("how", ["fails", "cannot be sent", "cannot be started"])
def test_without_another_process_this_one_compiles(monkeypatch, how):
    monkeypatch.setattr(compiling, "COMMAND", "raise SystemExit(3)")
    if how == "cannot be started":
        monkeypatch.setattr(sys, "executable", "/no/such/python")
    sample = (lambda: None) if how == "cannot be sent" else "sample"
    assert compiling._use_elsewhere(sample) is False
    ours = kernel("kcons.some")
    assert compiled_elsewhere(lambda: sample, lambda: ours(2)) == 4
