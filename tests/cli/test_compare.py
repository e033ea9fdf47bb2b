"""`kcons compare`: a sentence, a ranking, lines of Python that run, three files; it goes on where it was cut off."""

from __future__ import annotations

from pathlib import Path

import pytest
from host_systems import ALANINE

from kcons.cli import main
from kcons.comparison import measure, observed_orders, production, read_csv

CHAIN = ("compare", "chain", "--size", 4, "--dt", "5,10,5", "--budget", 5)


def run(*arguments):
    return main.main([str(a) for a in arguments])


def test_what_is_shown_and_written(tmp_path, capsys):
    assert run(*CHAIN, "--methods", "rattle,verlet", "--out", tmp_path) == 0
    printed = capsys.readouterr()
    lines = printed.out.splitlines()
    assert lines[0].startswith("Use kcons RATTLE at ") and "for an error of at most" in lines[0]
    assert lines[2].split() == ["method", "at", "error", "cost", "times", "timed"]
    assert "In Python:" in lines and "dynamics = ConstrainedDynamics(atoms, " in printed.out
    assert len(lines) <= 30 and lines[-1].endswith(f"the whole table is in {tmp_path / 'compare.csv'}")
    assert "reference solution" in printed.err  # progress goes to the other stream
    table = read_csv(tmp_path / "compare.csv")
    assert list(table.method) == ["rattle"] * 2 + ["verlet"] * 2 and list(table.setting) == [10.0, 5.0] * 2
    assert (table.attrs["atoms"], table.attrs["rank"]) == (5, 4)
    assert observed_orders(table)["kcons RATTLE"] == pytest.approx(2.0, abs=0.1)
    assert (tmp_path / "compare.txt").read_text(encoding="utf-8").startswith(lines[0])
    assert (tmp_path / "compare.png").read_bytes().startswith(b"\x89PNG")


def test_the_folder_is_named_after_the_system_and_lines_of_python_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run("compare", "sphere", "--quick", "--methods", "rattle") == 0
    assert (tmp_path / "compare-sphere" / "compare.csv").exists()
    printed = capsys.readouterr().out
    code = printed[printed.index("In Python:") + 11 : printed.index("wrote ")]
    made: dict[str, object] = {}
    exec(code, made)
    assert made["end"].positions.shape[1] == 3


def test_a_target_error_is_reached(tmp_path, capsys):
    words = ("--methods", "rattle,blanes-moan4", "--target-error", "1e-6", "--out", tmp_path)
    assert run("compare", "chain", "--size", 4, "--budget", 5, *words) == 0
    assert "for an error of at most 1e-06 Å (asked for)" in capsys.readouterr().out
    table = read_csv(tmp_path / "compare.csv")
    assert (table.error.iloc[-3:] <= 1e-6).any() and (table.rounds > 0).all()  # found steps take turns with the others


def test_it_goes_on_from_the_rows_that_are_there(tmp_path, monkeypatch, capsys):
    whole = measure.all_settings
    asked = []

    def stopped(system, method, *more):
        asked.append(method.name)
        if 1 < len(asked) < 4:
            raise KeyboardInterrupt
        return whole(system, method, *more)

    monkeypatch.setattr(measure, "all_settings", stopped)
    words = (*CHAIN, "--methods", "rattle,suzuki4", "--out", tmp_path)
    assert run(*words) == 130
    assert "--resume goes on from what is in" in capsys.readouterr().err
    assert list(read_csv(tmp_path / "compare.csv").method) == ["rattle", "rattle"]
    first = read_csv(tmp_path / "compare.csv").error.tolist()
    (tmp_path / "compare.txt").touch()
    assert run(*words, "--resume") == 130 and not (tmp_path / "compare.txt").exists()  # it was of another table
    assert run(*words, "--resume") == 0
    assert asked == ["rattle", "suzuki4", "suzuki4", "suzuki4"]
    table = read_csv(tmp_path / "compare.csv")
    assert set(table.method) == {"rattle", "suzuki4"} and table.error.tolist()[:2] == first
    capsys.readouterr()
    assert run(*words, "--resume", "--budget", 2) == 2
    assert "give another --out" in capsys.readouterr().err
    assert run(*words, "--out", tmp_path / "new", "--resume") == 2
    assert "leave --resume out" in capsys.readouterr().err


def test_nothing_is_written_where_nothing_was_done(tmp_path, monkeypatch, capsys):
    def stopped(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(measure, "all_settings", stopped)
    assert run(*CHAIN, "--methods", "rattle", "--out", tmp_path) == 130
    assert capsys.readouterr().err.endswith("kcons: interrupted\n") and list(tmp_path.glob("[!.]*")) == []


def test_a_file_of_ones_own(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names = "openmm-verlet,openmm-kcons-rattle"
    assert run("compare", ALANINE, "--constrain", "allbonds", "--methods", names, "--dt", "2,1", "--quick") == 0
    assert "OpenMM + kcons rattle" in capsys.readouterr().out
    table = read_csv(tmp_path / f"compare-{ALANINE.name}" / "compare.csv")
    assert "allbonds: 21 Distance" in table.attrs["title"] and table.attrs["asked"]["constrain"] == "allbonds"
    assert observed_orders(table)["OpenMM + kcons rattle"] == pytest.approx(2.0, abs=0.2)


def test_a_file_says_which_step_is_right_for_averages(tmp_path, monkeypatch, capsys):
    seen = []

    def checked(system, steps, budget, **_):
        seen.append((system.name, tuple(steps), budget))
        return [
            {"setting": 2.0, "status": "ok", "error": 0.005, "shift": 0.001, "shift_error": 0.002, "climb": 0.5},
            {"setting": 3.0, "status": "ok", "error": 0.1, "turn": 0.08, "turn_error": 0.01, "climb": 0.5},
        ]

    monkeypatch.setattr(production, "check_steps", checked)
    words = ("compare", ALANINE, "--methods", "openmm-verlet", "--dt", "2", "--budget", 3, "--out", tmp_path)
    assert run(*words) == 0
    assert "For averages at 300 K the step may be 2 fs" in capsys.readouterr().out
    assert len(seen) == 1 and seen[0][2] == 3.0
    monkeypatch.setattr(measure, "force_seconds", lambda system: 1.0)
    assert run(*words) == 0
    assert "too long to see here which step is right for averages" in capsys.readouterr().out
    assert len(seen) == 1


def test_a_topology_with_coordinates(tmp_path, monkeypatch, capsys):
    pytest.importorskip("MDAnalysis")
    monkeypatch.chdir(tmp_path)
    lines = ["3", "water", "O 0 0 0", "H 0.9572 0 0", "H -0.2400 0.9266 0"]
    for name in ("water.xyz", "start.xyz"):
        Path(name).write_text("\n".join(lines) + "\n")
    words = ["--coordinates", "start.xyz", "--forces", "tip3p", "--methods", "rattle", "--dt", "4", "--quick"]
    assert run("compare", "water.xyz", *words) == 0
    assert read_csv(Path("compare-water.xyz/compare.csv")).attrs["asked"]["coordinates"] == "start.xyz"
    printed, said = capsys.readouterr()
    assert "kcons: 2 bonds were guessed" in said
    code = printed[printed.index("In Python:") + 11 : printed.index("wrote ")]
    made: dict[str, object] = {}
    with pytest.warns(UserWarning, match="were guessed"):
        exec(code, made)  # the lines of Python run as they are
    assert len(made["atoms"]) == 3
    Path("start.xyz").write_text("\n".join([*lines[:-1], "H -0.24 0.95 0"]) + "\n")
    assert run("compare", "water.xyz", *words, "--resume") == 2  # rows of the file that it was before
    assert "of settings" in capsys.readouterr().err
