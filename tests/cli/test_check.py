"""`kcons check`: exit status, table, files, errors on one line."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
import water_files as files

from kcons.cli.main import main
from kcons.mdanalysis.check import report

N = 20
OPTIONS = ["--constrain", "none"]


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
    for cut, whole in (("cut", "bad"), ("short", "good")):
        (folder / f"{cut}.xtc").write_bytes((folder / f"{whole}.xtc").read_bytes()[:-20])
    y = files.water(N, 5)
    y[3, 7] = np.nan
    files.write(folder / "nan.dcd", y)
    files.write(folder / "nothing.dcd", y[3:])
    return folder


def command(folder, name, *more):
    arguments = [str(folder / name), "--topology", str(folder / "t.gro"), *OPTIONS]
    return main(["check", *arguments, "--out", str(folder / f"out-{name}"), *more])


def test_kept_and_violated(folder, capsys):
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

    # Violated, in a file that ends too early.
    assert command(folder, "cut.xtc") == 1
    page = capsys.readouterr().out
    assert "violated by" in page and "SOL3:OW–HW1 (6, 7)" in page and "0.001 nm" in page
    assert "4 of 5 frames" in page and "ends too early, at frame 4" in page


@pytest.mark.parametrize(
    "name,more,words",
    [
        ("short.xtc", [], "ends too early, at frame 4"),
        ("nan.dcd", [], "frame 3 cannot be used, nor what follows: position of atom 7"),
        ("good.xtc", ["--frames", "2:3"], "targets come from the only frame"),
    ],
)
def test_incomplete_has_a_status_of_its_own(folder, capsys, name, more, words):
    assert command(folder, name, *more) == 3
    page = " ".join(capsys.readouterr().out.split())
    assert words in page and "incomplete: " in page and "violated" not in page
    data = json.loads((folder / f"out-{name}" / "check.json").read_text(encoding="utf-8"))
    assert data["status"] == "incomplete" and words in data["verdict"] and data["gaps"]


def test_nothing_that_can_be_read_is_incomplete_too(folder, capsys):
    """Numbers, picture and table of an earlier check of the same file do not stay beside."""
    out = folder / "out-nothing.dcd"
    good = (folder / "nothing.dcd").read_bytes()
    (folder / "nothing.dcd").write_bytes((folder / "nan.dcd").read_bytes())
    assert command(folder, "nothing.dcd", "--frames", ":3") == 0
    assert {path.name for path in out.iterdir()} == {*report.FILES, ".kcons.lock"}
    (folder / "nothing.dcd").write_bytes(good)
    capsys.readouterr()
    assert command(folder, "nothing.dcd") == 3
    said = capsys.readouterr()
    assert said.err.startswith("kcons: ") and "atom 7" in said.err
    data = json.loads((out / "check.json").read_text(encoding="utf-8"))
    assert data["status"] == "incomplete" and "atom 7" in data["verdict"]
    assert {path.name for path in out.iterdir()} == {"check.json", ".kcons.lock"}


def test_formats_by_option(folder, tmp_path, capsys):
    for name in ("good.trr", "t.gro"):
        (tmp_path / name.partition(".")[0]).write_bytes((folder / name).read_bytes())
    arguments = ["check", str(tmp_path / "good"), "--topology", str(tmp_path / "t"), "--out", str(tmp_path / "out")]
    formats = ["--format", "trr", "--topology-format", "GRO"]
    assert main([*arguments, *formats, *OPTIONS]) == 0
    capsys.readouterr()
    for given, words in (([], "--topology-format NAME"), (formats[2:], "--format NAME"), (["--format", "x"], "--topo")):
        assert main([*arguments, *given, *OPTIONS]) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1 and words in said
    assert main([*arguments, *formats, *OPTIONS, "--forces", "lj"]) == 2
    assert "--forces does not go with --format" in capsys.readouterr().err


# -- folders ----------------------------------------------------------------------------------------


def test_the_check_of_another_trajectory_is_not_overwritten(folder, tmp_path, monkeypatch, capsys):
    """Files of one stem, and a folder that is a link."""
    monkeypatch.chdir(tmp_path)
    words = ["--topology", str(folder / "t.gro"), *OPTIONS]
    (tmp_path / "a").mkdir()
    for name in ("a/run.xtc", "run.xtc"):
        (tmp_path / name).write_bytes((folder / "good.xtc").read_bytes())
    for _ in range(2):
        assert main(["check", "a/run.xtc", *words]) == 0
    before = (tmp_path / "check-run" / "check.json").read_bytes()
    assert json.loads(before)["file"] == str((tmp_path / "a" / "run.xtc").resolve())
    capsys.readouterr()
    assert main(["check", "run.xtc", *words]) == 2
    said = capsys.readouterr().err
    assert "check-run has a check of another file" in said and "a/run.xtc); give another folder (--out)" in said
    assert (tmp_path / "check-run" / "check.json").read_bytes() == before


# -- terminals --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name,status,where", [("bad.xtc", 1, ""), ("short.xtc", 3, "2>&1 | head -c 0")])
def test_in_a_c_locale_and_into_a_pipe_that_nobody_reads(folder, name, status, where):
    words = f"check {folder / name} --topology {folder / 't.gro'} --constrain none --out {folder / f'plain-{name}'}"
    environment = os.environ | {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONIOENCODING": "ascii"}
    command = f"'{sys.executable}' -m kcons {words} {where}; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, env=environment)
    assert done.returncode == status and not done.stderr
    assert ("SOL3:OW?HW1" in done.stdout.decode("ascii")) == (not where)
    assert "Å" in (folder / f"plain-{name}" / "check.txt").read_text(encoding="utf-8")


@pytest.mark.parametrize("more,words", [(["--targets", "nope.toml"], "nope.toml"), (["--frames", "9:"], "no frames")])
def test_errors_take_one_line(folder, capsys, more, words):
    assert command(folder, "good.xtc", *more) == 2
    said = capsys.readouterr()
    assert said.err.startswith("kcons: ") and said.err.count("\n") == 1 and words in said.err


def test_advice_is_of_the_command(folder, tmp_path, capsys):
    bare, few = tmp_path / "t.xyz", files.topology(tmp_path / "few.gro", N - 1, files.water(N - 1, 1)[0])
    atoms = "".join(f"{'OHH'[k % 3]} {k}.0 0.0 0.0\n" for k in range(3 * N))
    bare.write_text(f"{3 * N}\n\n{atoms}")
    for top in (bare, few):
        words = ["check", str(folder / "good.trr"), "--topology", str(top), "--constrain", "allbonds"]
        assert main([*words, "--no-rigid-water", "--out", str(tmp_path / top.stem)]) in (0, 1, 2)
    said = capsys.readouterr()
    page = " ".join((said.out + said.err).split())
    assert "bonds were guessed from distances and covalent radii" in page and "give a topology with bonds" in page
    for words in ("guess_bonds", "universe", "guess_TopologyAttrs", "backend", "select_atoms"):
        assert words not in page


def test_hydrogens_without_a_bond_are_a_gap(tmp_path, capsys):
    """ASE's extended XYZ has a cell, which MDAnalysis does not read: rows of molecules at its faces are missing."""
    from ase.build import molecule
    from ase.io import write

    water = molecule("H2O", vacuum=1.6, pbc=True) * (2, 2, 2)
    write(tmp_path / "whole.xyz", [water, water])
    water.positions += 3
    water.wrap()
    write(tmp_path / "cut.xyz", [water, water])
    for name, status in (("cut", 3), ("whole", 0)):
        path = str(tmp_path / f"{name}.xyz")
        assert main(["check", path, "--topology", path, "--out", str(tmp_path / name)]) == status
        page = " ".join(capsys.readouterr().out.split())
        told = "incomplete: no bond was found for 4 hydrogens, the first of which is H (atom 8)" in page
        assert told == (name == "cut")
    assert "give files with the cell" in json.loads((tmp_path / "cut" / "check.json").read_text())["gaps"][0]


def test_temperatures_of_configurations(folder, capsys, monkeypatch):
    from kcons.comparison import trajectory_temperatures
    from kcons.thermostats import Estimate, SplitTemperatures

    asked = []

    def along(*where, **options):
        asked.append((where[2], list(where[3]), options["constrain"]))
        return SplitTemperatures(Estimate(0.0259, 0.0001), Estimate(0.0267, 0.0002), None, 60, 60, 0.1, 0.2, 5, ())

    assert command(folder, "good.xtc", "--forces", "lj") == 2
    out, err = capsys.readouterr()
    assert "5 frames are too few for temperatures; give 32 or more" in err
    # The check itself is not lost.
    assert "kept to the precision" in out and (folder / "out-good.xtc" / "check.json").is_file()
    monkeypatch.setattr(trajectory_temperatures, "along", along)
    assert command(folder, "good.xtc", "--forces", "lj") == 0
    told = "shifts of whole clusters 300.6 ± 1.2 K, turns of whole clusters 309.8 ± 2.3 K"
    assert told in " ".join(capsys.readouterr().out.split()) and asked == [("lj", [0, 1, 2, 3, 4], "none")]
    assert any(told in line for line in json.loads((folder / "out-good.xtc" / "check.json").read_text())["remarks"])
    assert command(folder, "good.xtc", "--forces", "lj", "--temperature", "300") == 0
    assert "not 300 K: turns of whole clusters 3.3% too warm" in " ".join(capsys.readouterr().out.split())
    assert command(folder, "good.xtc", "--temperature", "300") == 2
    assert "--temperature needs --forces" in capsys.readouterr().err
    assert command(folder, "good.xtc", "--forces", "lj", "--no-rigid-water") == 2
    assert "--forces does not go with --no-rigid-water" in capsys.readouterr().err
