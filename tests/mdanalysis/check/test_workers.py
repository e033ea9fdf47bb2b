"""The same check by one worker and by several."""

import pickle
import warnings

import numpy as np
import pytest
import water_files as files

from kcons.constraints import Angle, Distance
from kcons.errors import InputError
from kcons.mdanalysis import ConstraintCheck, load_trajectory
from kcons.mdanalysis.check import workers

N, SIDE = 40, 12.0


def loaded(path, n=N, masses=True):
    made = files.universe(n, masses)
    load_trajectory(made, path)
    return made


def checked(path, constraints, n=N, masses=True, run=None, **options):
    return ConstraintCheck(loaded(path, n, masses), constraints, **options).run(**(run or {})).check


@pytest.fixture(scope="module")
def positions():
    x = files.water(N, 23)
    # One bond too long in one frame, and one that drifts.
    x[7, 3 * 11 + 2] += 0.05
    x[:, 3 * 5 + 1] += np.linspace(0, 0.2, 23)[:, None] * np.array([1.0, 0, 0])
    return x % SIDE


@pytest.fixture(scope="module")
def water(tmp_path_factory, positions):
    folder = tmp_path_factory.mktemp("water")
    return {
        "dcd": files.write(folder / "w.dcd", positions),
        "xtc": files.write(folder / "w.xtc", positions),
        "trr": files.write(folder / "w.trr", positions),
    }


@pytest.mark.parametrize("backend", ["multiprocessing", "dask"])
def test_backends_agree(water, backend):
    if backend == "dask":
        pytest.importorskip("dask")
    rows = [Distance(files.pairs(N), files.targets(N)), Angle([[1, 0, 2]])]
    serial = checked(water["xtc"], rows)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the backends themselves
        parallel = checked(water["xtc"], rows, run={"backend": backend, "n_workers": 2, "n_parts": 3})
    assert serial.verdict == parallel.verdict and serial.frames == parallel.frames
    np.testing.assert_array_equal(serial.series["largest Å"], parallel.series["largest Å"])
    assert [row.largest for row in serial.worst] == [row.largest for row in parallel.worst]
    assert serial.times == parallel.times


@pytest.mark.parametrize("backend", [None, "threads", "multiprocessing"])
@pytest.mark.parametrize("targets", ["given", "mean"])
def test_backends_agree_on_blocks_of_a_file(water, backend, targets):
    rows = Distance(files.pairs(N), files.targets(N))
    serial = checked(water["dcd"], rows, targets=targets)
    parallel = checked(water["dcd"], rows, targets=targets, run={"backend": backend, "n_workers": 2, "n_parts": 3})
    assert serial.verdict == parallel.verdict and serial.frames == parallel.frames
    np.testing.assert_allclose(serial.series["largest Å"], parallel.series["largest Å"], rtol=0, atol=1e-14)
    assert [row.largest for row in serial.worst] == pytest.approx([row.largest for row in parallel.worst], abs=1e-14)
    assert serial.times == parallel.times


def test_threads_are_refused_where_the_reader_keeps_the_lock(water):
    with pytest.raises(InputError, match="threads need a DCD file") as error:
        checked(water["xtc"], Distance(files.pairs(N), files.targets(N)), run={"backend": "threads", "n_workers": 2})
    assert error.value.item == "backend"


def test_processes_that_are_not_forked_get_all_of_it(water, monkeypatch):
    """Where there is nothing to inherit, the analysis goes to the workers as a whole."""
    monkeypatch.setattr(workers, "_RUNNING", {})
    check = ConstraintCheck(loaded(water["dcd"]), Distance(files.pairs(N), files.targets(N)))
    check.run(stop=3)
    assert workers.short_pickle(check) is None
    other = pickle.loads(pickle.dumps(check))
    found = other.run().check
    assert found.series == checked(water["dcd"], Distance(files.pairs(N), files.targets(N))).series
