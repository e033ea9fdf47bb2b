"""Pictures and files of a check: what they show, and what they do not overwrite."""

import errno

import numpy as np
import pytest
import water_files as files

from kcons.errors import OccupiedError
from kcons.mdanalysis import check_trajectory
from kcons.mdanalysis.check import report

N = 20


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("command")
    x = files.water(N, 5)
    files.topology(folder / "t.gro", N, x[0])
    files.write(folder / "good.xtc", x)
    v = np.random.default_rng(0).normal(size=x.shape)
    files.write(folder / "good.trr", x, velocities=v)
    x[3, 7] += 0.2
    files.write(folder / "bad.xtc", x % 12.0)
    data = (folder / "bad.xtc").read_bytes()
    (folder / "cut.xtc").write_bytes(data[:-20])
    (folder / "short.xtc").write_bytes((folder / "good.xtc").read_bytes()[:-20])
    y = files.water(N, 5)
    y[3, 7] = np.nan
    files.write(folder / "nan.dcd", y)
    files.write(folder / "nothing.dcd", y[3:])
    return folder


def test_writing_refuses_others_and_follows_no_links(folder, tmp_path):
    one = check_trajectory(folder / "good.xtc", folder / "t.gro", "none", rank=False)
    other = check_trajectory(folder / "good.trr", folder / "t.gro", "none", rank=False)
    report.write(one, tmp_path / "out")
    with pytest.raises(OccupiedError, match=r"of other file \(.*good\.xtc\); give another folder"):
        report.write(other, tmp_path / "out")
    for name in ("check.json.unfinished", ".kcons.lock"):  # links that somebody has put there
        (tmp_path / "out" / name).symlink_to(tmp_path / "victim")
    with pytest.raises(OccupiedError, match=r"\.kcons\.lock is a link"):
        report.write(one, tmp_path / "out")
    (tmp_path / "out" / ".kcons.lock").unlink()
    report.write(one, tmp_path / "out")
    assert not (tmp_path / "victim").exists()


def test_a_full_disk_blocks_no_folder(folder, tmp_path, monkeypatch):
    """What could not be written is not there, and a check of any trajectory can be written there later."""
    one, other = (check_trajectory(folder / f, folder / "t.gro", "none", rank=False) for f in ("good.xtc", "good.trr"))

    def full(path):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(report, "in_one_piece", full)
        with pytest.raises(OSError, match="No space left"):
            report.write(one, tmp_path / "out")
    assert list((tmp_path / "out").iterdir()) == []
    assert report.write(other, tmp_path / "out")


def drawn(monkeypatch, result):
    """Lines of the first panel by label, and its scale."""
    from matplotlib.figure import Figure

    kept = []
    monkeypatch.setattr(Figure, "savefig", lambda self, *_, **__: kept.append(self))
    report.plot(result, None)
    axes = kept[0].axes[0]
    return {line.get_label(): line for line in axes.lines}, axes


def test_the_picture_shows_what_was_allowed(folder, monkeypatch):
    result = check_trajectory(folder / "bad.xtc", folder / "t.gro", "none", rank=False, tolerance=0.01)
    lines, axes = drawn(monkeypatch, result)
    shown = {name: np.asarray(line.get_ydata(), dtype=float) for name, line in lines.items()}
    rounding = 4 * np.sqrt(3) * 0.005  # of a frame and of the targets
    np.testing.assert_allclose(shown["rounding of the file, at most"], rounding, rtol=1e-9)
    shortest = min(
        row.target
        for row in check_trajectory(folder / "bad.xtc", folder / "t.gro", "none", rank=False, worst=999).worst
    )
    np.testing.assert_allclose(shown["rounding and tolerance of 0.01"], rounding + 0.01 * shortest, rtol=1e-9)
    over = shown["largest"] > shown["rounding and tolerance of 0.01"]
    assert over.tolist() == [False, False, False, True, False]
    assert {"largest", "rms"} < set(shown)
    low, high = axes.get_ylim()
    assert low < rounding < high and np.nanmax(shown["largest"]) < high
    exact = check_trajectory(folder / "bad.xtc", folder / "t.gro", "none", rank=False, tolerance=0.0)
    assert not any("tolerance" in label for label in drawn(monkeypatch, exact)[0])


def test_the_picture_has_no_stroke_to_the_zero_of_the_first_frame(folder, monkeypatch):
    """The frame that gives targets is off by nothing, which has no place on a logarithmic scale."""
    result = check_trajectory(folder / "good.xtc", folder / "t.gro", "none", rank=False)
    assert result.series["largest Å"][0] < 1e-15
    lines, axes = drawn(monkeypatch, result)
    assert axes.get_yscale() == "log"
    for label in ("largest", "rms"):
        y = np.asarray(lines[label].get_ydata(), dtype=float)
        assert np.isnan(y[0]) and np.isfinite(y[1:]).all()
    assert axes.get_ylim()[0] > 1e-5


def test_plot_of_one_frame_and_of_nothing_wrong(folder, tmp_path):
    result = check_trajectory(folder / "good.xtc", folder / "t.gro", "none", frames="2:3", rank=False)
    assert max(result.series["largest Å"]) < 1e-12 and result.status == "incomplete"
    report.plot(result, tmp_path / "p.png")
    assert (tmp_path / "p.png").stat().st_size > 5000


def test_a_full_disk_leaves_nothing_that_blocks_the_folder(folder, tmp_path):
    """Files may grow to some bytes only, as on a disk that is full."""
    resource = pytest.importorskip("resource")
    result = check_trajectory(folder / "good.xtc", folder / "t.gro", "none", rank=False)
    report.plot(result, tmp_path / "drawn.png")  # with all that has to be imported or kept
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    for write in (report.write, lambda _, out: report.write_failure(folder / "good.xtc", "no" * 200, out)):
        resource.setrlimit(resource.RLIMIT_FSIZE, (200, before[1]))
        try:
            with pytest.raises(OSError):
                write(result, tmp_path / "out")
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        assert not list((tmp_path / "out").iterdir())
    assert len(report.write(result, tmp_path / "out")) == 2
