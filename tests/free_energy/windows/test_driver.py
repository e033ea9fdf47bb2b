"""Windows by executors: kept as they finish, begun again where their process was killed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from window_samplers import KT, Fake, slope

from kcons.errors import InputError, OccupiedError
from kcons.free_energy import Settings, Windows

SETTINGS = Settings(production=640, every=10)
PLACES = np.linspace(-np.pi, np.pi, 9)[:-1]
PATH = os.pathsep.join([str(Path(__file__).parents[2] / "systems"), str(Path(__file__).parents[3])])
#: The same windows, by two processes of their own.
SCRIPT = """
import sys
import numpy as np
from window_samplers import Fake
from kcons.free_energy import Settings, Windows
if __name__ == "__main__":
    windows = Windows(Fake(sys.argv[1] + "/diary", wait=1.5), sys.argv[1] + "/out",
                      Settings(production=640, every=10), rng=2, workers=2)
    windows.run(np.linspace(-np.pi, np.pi, 9)[:-1])
"""


def diary(folder):
    return (folder / "diary").read_text().split()


def made(folder, settings=SETTINGS, out="out", how=None, **fake):
    """Windows by two threads, unless `how` says something else."""
    diary = str(folder / "diary")
    how = {"rng": 2, "executor": ThreadPoolExecutor(2)} | (how or {})
    return Windows(Fake(diary, **fake), folder / out, settings, **how)


def run(folder, places=PLACES, **fake):
    windows = made(folder, **fake)
    return windows, windows.run(places)


def test_windows_and_their_profile(tmp_path):
    told = []
    windows = made(tmp_path)
    windows.progress = lambda *numbers: told.append(numbers)
    result = windows.run(PLACES)
    assert result.failed == {} and len(result.windows) == 8
    assert [done for done, _ in told] == list(range(1, 17)) and told[-1] == (16, 16)
    for window in result.windows:
        assert set(window.sides) == {"up", "down"}
        assert abs(window.force[0] - slope(window.value[0])) < 4 * window.error[0] < 2
        assert window.error[0] == pytest.approx(2 / np.sqrt(128), rel=0.5)
    assert min(w.p_value for w in result.windows) > 1e-3
    at = np.linspace(-np.pi, np.pi, 5)
    exact = 3 * np.cos(2 * at) + 2 * np.cos(at)
    found = np.interp(at, result.profile.x, result.profile.F)
    assert np.abs((found - found[0]) - (exact - exact[0])).max() < 1.5
    known = json.loads(json.dumps(result.numbers()))
    assert known["names"] == ["torsion"] and len(known["windows"]) == 8
    assert known["windows"][0]["mean force"] == pytest.approx(result.windows[0].force.tolist())


def test_one_failed_window_does_not_stop_the_others_and_is_tried_again(tmp_path):
    fails = ("window--1.57079633-up", "window-0.785398163-down", "window-0.785398163-up")
    _, result = run(tmp_path, fails=fails)
    assert result.failed == dict.fromkeys(fails, "RuntimeError: the calculator did not converge")
    assert len(result.windows) == 7 and result.kept == 0
    assert list(result.windows[2].sides) == ["down"] and np.isnan(result.windows[2].p_value)
    _, again = run(tmp_path)
    assert again.failed == {} and len(again.windows) == 8 and len(diary(tmp_path)) == 19
    assert again.kept == 13 and again.summary().startswith("8 windows, 13 of their runs kept from before")


def test_windows_are_known_by_their_places(tmp_path):
    """Those that failed are tried again, and a folder takes any others, whatever ran there before."""
    windows, first = run(tmp_path, [-1.0, 0.0, 1.0], fails=("window-0-up",))
    windows.sampler.fails = ()
    again = windows.run([1.0, 0.0, -1.0])
    assert again.failed == {} and len(first.windows) == len(again.windows) == 3
    assert len(diary(tmp_path)) == 7
    assert [w.value[0] for w in windows.run([0.0, 2.0]).windows] == [-1.0, 0.0, 1.0, 2.0]
    _, other = run(tmp_path, [2.0, 0.5, 1.0])
    assert [w.value[0] for w in other.windows] == [0.5, 1.0, 2.0] and other.kept == 4 and len(diary(tmp_path)) == 11
    assert other.windows[1].force == again.windows[2].force
    # A place that another sum gives is the same: its samples count once.
    _, same = run(tmp_path, [0.3, 0.1 + 0.2, 0.5])
    assert len(same.windows) == 2 and len(diary(tmp_path)) == 13


def test_runs_of_an_angle_begin_at_angles(tmp_path):
    """Beyond 180 degrees there are none: one of the two runs failed, and nobody saw whether both agree."""
    windows = made(tmp_path, periods=np.zeros(1))
    for angle in (0.01, 3.12):
        up, down = (job.start[0] for job in windows._jobs((angle,)))
        assert 0 < up < angle < down < np.pi
        assert [angle - up, down - angle] == pytest.approx([min(angle, np.pi - angle) / 2] * 2)
    assert [job.start[0] for job in windows._jobs((1.0,))] == pytest.approx([0.9, 1.1])


@pytest.mark.filterwarnings("ignore:a barrier that comes three times")
def test_windows_are_added_where_they_help(tmp_path):
    windows, first = run(tmp_path, np.linspace(-np.pi, np.pi, 6)[:-1])
    better = windows.improve(0.5, 20, at_once=2)
    assert first.profile.error.max() > 0.5 and len(first.windows) == 5
    assert 5 < len(better.windows) < 20 and better.profile.error.max() <= 0.5
    # Also where those that are there tell little: beside them, since a place has one window.
    noisy, _ = run(tmp_path, np.linspace(0.0, 0.3, 11))
    assert len({round(w.value[0], 6) for w in noisy.improve(1e-9, 14, at_once=2).windows}) == 14
    # Of the lowest place alone nothing is to be known.
    near, _ = run(tmp_path, np.linspace(-np.pi, np.pi, 6)[:-1])
    found = near.improve(0.5, 20, below=1e-6)
    errors = found.profile.error[found.profile.lower_than(1e-6)]
    assert errors.max() <= 0.5 < found.profile.error.max() and len(found.windows) == 5


@pytest.mark.filterwarnings("ignore:a barrier that comes three times")
def test_windows_that_failed_before_others_are_added_are_still_told_of(tmp_path):
    windows, first = run(tmp_path, np.linspace(-np.pi, np.pi, 6)[:-1], fails=("window--1.88495559-up",))
    better = windows.improve(0.5, 20)
    assert len(first.failed) == 1 and better.failed == first.failed and better.profile.error.max() <= 0.5
    windows.sampler.fails = ()
    assert windows.run([PLACES[0]]).failed == first.failed  # not what was tried again
    assert windows.run(np.linspace(-np.pi, np.pi, 6)[:-1]).failed == {}


def test_a_second_run_in_the_same_folder_is_told(tmp_path):
    """While the first one samples, and of other settings where both have looked into an empty folder."""
    first, second = made(tmp_path), made(tmp_path)
    refused = []

    def meanwhile(*_):
        for attempt in (lambda: second.run(PLACES), lambda: second.pull(0.0, 1.0), lambda: second.improve(0.1, 20)):
            with pytest.raises(OccupiedError, match="another run writes into"):
                attempt()
            refused.append(attempt)

    first.progress, other = meanwhile, made(tmp_path, Settings(production=320, every=10))
    assert len(first.run(PLACES[:1]).windows) == 1 and len(refused) == 6
    assert len(second.run(PLACES[:1]).windows) == 1 and len(diary(tmp_path)) == 2
    with pytest.raises(OccupiedError, match="windows of other settings"):
        other.run(PLACES[:1])


@pytest.mark.parametrize("name", ["window-0-up.npz", "free_energy.json", "profile.png"])
def test_files_of_others_are_not_taken_for_windows(tmp_path, name):
    (tmp_path / name).write_text("precious")
    with pytest.raises(OccupiedError, match=f"other files called {name}; give another folder"):
        made(tmp_path, out=".")


def test_workers_end_with_what_waits_for_them(tmp_path):
    """Nothing is written any more, and nobody waits for the windows in hand; of Ctrl-C and SIGTERM see tests/cli."""
    (tmp_path / "script.py").write_text(SCRIPT)
    command, path = [sys.executable, str(tmp_path / "script.py"), str(tmp_path)], {**os.environ, "PYTHONPATH": PATH}
    process = subprocess.Popen(command, env=path, stderr=subprocess.DEVNULL, start_new_session=True)
    while not (tmp_path / "diary").exists() or len(diary(tmp_path)) < 2:
        assert process.poll() is None
        time.sleep(0.05)
    process.kill()
    assert process.wait(timeout=60) != 0
    time.sleep(2.5)  # by then windows in hand would have been finished
    assert not list((tmp_path / "out").glob("window-*")) and len(diary(tmp_path)) == 2
    _, result = run(tmp_path, PLACES[:1])
    assert result.failed == {} and not list((tmp_path / "out").glob("*.unfinished"))


def begun_in_spite_of_a_kill(folder, how, **fake):
    """How often a window was begun whose process was killed once; the results are those of a run without."""
    whole, broken = folder / "whole", folder / "broken"
    whole.mkdir(), broken.mkdir()
    _, expected = run(whole)
    _, result = run(broken, kills=("window--0.785398163-up",), how=how, **fake)
    assert result.failed == {} and json.dumps(result.numbers()) == json.dumps(expected.numbers())
    return diary(broken).count("window--0.785398163-up")


def test_a_killed_worker_changes_nothing(tmp_path):
    assert begun_in_spite_of_a_kill(tmp_path, {"executor": None, "workers": 2}) >= 2


def test_a_cluster_of_dask_that_loses_a_worker(tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed")
    monkeypatch.setenv("PYTHONPATH", PATH)
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0") as cluster,
        distributed.Client(cluster.scheduler_address) as client,
    ):
        assert begun_in_spite_of_a_kill(tmp_path, {"executor": client.get_executor(pure=False)}, wait=0.05) == 2


def test_pulls_give_the_free_energy_of_the_coordinate(tmp_path):
    """That of the held system, and kT ln 2 for Z that is four times as large at the end."""
    windows = made(tmp_path)
    found, again = (windows.pull(-0.5, 0.5, 60) for _ in range(2))
    exact = 4.0 + KT * np.log(2)
    assert abs(found.bar.value - exact) < 3 * found.bar.error < 2
    assert again == found and len(diary(tmp_path)) == 120
    for same in ((0.5, 0.5), ([0.5, 1.0], [0.5, 2.0]), (np.nan, 1.0)):
        with pytest.raises(InputError, match=r"are the same|targets must be finite"):
            windows.pull(*same)
    with pytest.raises(InputError, match=r"settings\.pull is 0"):
        made(tmp_path, Settings(pull=0), "no").pull(0, 1)


def test_pulls_by_long_steps(tmp_path):
    """Velocities of fast modes are too hot or too cold there: work has the part of canonical ones."""
    ways = ((0.0, 1.0), (1.5, 2.0))
    found = [made(tmp_path, out=str(hot), hot=hot, kJ=kJ).pull(-0.5, 0.5, 20) for hot, kJ in ways]
    assert found[1].bar.value == pytest.approx(found[0].bar.value, rel=1e-10)


def test_pulls_that_fail_are_told_of(tmp_path):
    names = tuple(f"pull--0.5-to-0.5-{k:04d}" for k in range(3))
    with pytest.raises(InputError, match=r"3 of 14 pulls failed; pull--0.5-to-0.5-000.: RuntimeError.* are kept"):
        made(tmp_path, fails=names).pull(-0.5, 0.5, 7)
    assert made(tmp_path).pull(-0.5, 0.5, 7).bar.error > 0 and len(diary(tmp_path)) == 14 + 3


def test_bad_input(tmp_path):
    with pytest.raises(OccupiedError, match=r"windows of other settings; give another folder"):
        run(tmp_path)
        made(tmp_path, Settings(production=320, every=10))
    with pytest.raises(OccupiedError, match=r"windows of another system;"):
        made(tmp_path, digest="another system")
    windows = made(tmp_path, out="other")
    for wrong in ([], [np.nan], [[1.0, 2.0]], np.zeros((2, 1, 1)), 1.1):
        with pytest.raises(InputError, match="targets must be finite"):
            windows.run(wrong)
    with pytest.raises(InputError, match="count is 4; give a whole number, 5 or more"):
        windows.pull(0, 1, 4)
    for more in ({"workers": 0}, {"approach": [1.0, 2.0]}, {"approach": np.nan}, {"approach": "x"}, {"rng": "x"}):
        with pytest.raises(InputError, match=next(iter(more))):
            made(tmp_path, out="never", how=more)
    assert not (tmp_path / "never").exists()
