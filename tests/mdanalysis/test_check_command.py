"""`kcons check`: exit status, table, files, errors on one line."""

import json

import numpy as np
import pytest
import water_files as files

from kcons import check_report
from kcons.cli import main
from kcons.mdanalysis import check_trajectory

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
    return folder


def command(folder, name, *more):
    arguments = [str(folder / name), "--topology", str(folder / "t.gro"), "--constrain", "none"]
    return main(["check", *arguments, "--out", str(folder / f"out-{name}"), *more])


def test_kept(folder, capsys):
    assert command(folder, "good.trr") == 0
    page = capsys.readouterr().out
    assert "5 of 5 frames, 60 atoms; 60 rows on 60 atoms" in page and "rank 60" in page
    assert "single precision" in page and " K (mean and" in page and "|Av|" in page
    out = folder / "out-good.trr"
    data = json.loads((out / "check.json").read_text())
    assert data["status"] == "kept" and len(data["series"]["largest Å"]) == 5
    assert data["degrees_of_freedom"] in (120, 117) and data["broken"] is None
    assert (out / "check.png").stat().st_size > 5000
    assert data["verdict"] in (out / "check.txt").read_text()


def test_violated(folder, capsys):
    assert command(folder, "bad.xtc", "--worst", "2", "--no-rank") == 1
    page = capsys.readouterr().out
    assert "violated by" in page and "SOL3" in page and "0.001 nm" in page and "rank" not in page


def test_a_file_that_ends_too_early(folder, capsys):
    assert command(folder, "cut.xtc") == 1
    page = capsys.readouterr().out
    assert "4 of 5 frames" in page and "ends too early, at frame 4" in page


@pytest.mark.parametrize(
    "name,more,words",
    [
        ("none.xtc", [], "no file"),
        ("good.xtc", ["--targets", "nope.toml"], "nope.toml"),
        ("good.xtc", ["--constrain", "hbnds"], "hbonds"),
        ("good.xtc", ["--select", "resname ABC"], "ABC"),
        ("good.xtc", ["--frames", "9:"], "no frames"),
        ("good.xtc", ["--tolerance", "-1"], "tolerance"),
    ],
)
def test_errors_take_one_line(folder, capsys, name, more, words):
    assert command(folder, name, *more) == 2
    said = capsys.readouterr()
    assert said.err.startswith("kcons: ") and said.err.count("\n") == 1 and words in said.err


def test_plot_of_one_frame_and_of_nothing_wrong(folder, tmp_path):
    result = check_trajectory(folder / "good.xtc", folder / "t.gro", "none", frames="2:3", rank=False)
    assert max(result.series["largest Å"]) < 1e-12
    check_report.plot(result, tmp_path / "p.png")
    assert (tmp_path / "p.png").stat().st_size > 5000
