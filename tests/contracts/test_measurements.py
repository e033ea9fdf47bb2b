"""Committed measurements are listed with the command that makes each, and are known to be stale when they are."""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def measurements():
    spec = importlib.util.spec_from_file_location("measurements", ROOT / ".ci" / "measurements.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["measurements"] = module  # for its dataclass
    spec.loader.exec_module(module)
    yield module
    del sys.modules["measurements"]


def test_each_result_is_listed(measurements):
    results = {p.name for p in (ROOT / "docs" / "results").iterdir() if p.suffix == ".json" or p.is_dir()}
    assert results == set(measurements.TABLE)


def test_what_is_listed_exists(measurements):
    for name, item in measurements.TABLE.items():
        assert all((ROOT / "kcons" / part).is_dir() for part in item.parts), name
        for command in item.commands:
            for script in re.findall(r"\S+\.py", command):
                assert (ROOT / script).is_file(), command
    assert all(m.minutes is None or m.minutes > 0 for m in measurements.TABLE.values())


@pytest.fixture
def repository(measurements, tmp_path, monkeypatch):
    """A repository with one folder of code and one result of its only commit."""
    code = tmp_path / "kcons" / "solvers" / "sweeps.py"
    code.parent.mkdir(parents=True)
    code.write_text('"""Sweeps."""\n\n\ndef sweep(x):\n    return 2 * x\n')
    results = tmp_path / "results"
    results.mkdir()

    def git(*words):
        command = ["git", "-c", "user.name=a", "-c", "user.email=a@b", "-C", str(tmp_path), *words]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    git("init", "-q")
    git("add", ".")
    git("commit", "-q", "-m", "first")
    monkeypatch.setattr(measurements, "ROOT", tmp_path)
    monkeypatch.setattr(measurements, "RESULTS", results)
    monkeypatch.setattr(
        measurements, "TABLE", {"speed.json": measurements.Measurement(("solvers",), ("python -c pass",), 3)}
    )

    def state(commit=None, **more):
        if commit is not None:
            about = {"runs": [{"machine": {"commit": commit, "date": "2026-01-02 03:04 UTC", **more}}]}
            (results / "speed.json").write_text(json.dumps(about))
        for function in (measurements.sources, measurements.definitions, measurements.state):
            function.cache_clear()
        return measurements.state("speed.json")

    yield code, state, git("rev-parse", "HEAD")
    for function in (measurements.sources, measurements.definitions, measurements.state):
        function.cache_clear()


def test_a_result_is_stale_when_what_it_measures_has_changed(repository):
    code, state, commit = repository
    assert state(commit) == "current"
    code.write_text('"""Other words."""\nimport math\n\ndef sweep(x):\n    """Twice."""\n    return (2 * x)\n')
    assert state() == "current"
    code.write_text(f"{code.read_text()}\n\ndef more(x):\n    return math.sin(x)\n")
    assert state() == "current"
    code.write_text("def sweep(x):\n    return 3 * x\n")
    assert state() == "stale: definitions changed: 1 in solvers"
    code.unlink()
    assert state() == "stale: definitions changed: 1 in solvers"


def test_a_result_of_code_that_nobody_has_is_stale(repository):
    _, state, commit = repository
    assert state("0" * 40) == "stale: 0000000 is not in this repository"
    assert state(f"{commit}+") == f"stale: of uncommitted code on {commit[:7]}"
    assert state("") == "stale: no commit"


def test_the_table_says_how_long_it_takes(repository, measurements, capsys):
    code, state, commit = repository
    state(commit, simd=512)
    assert measurements.main([]) == 0
    head, line, last = capsys.readouterr().out.splitlines()
    assert head.split() == ["result", "min", "commit", "date", "bits", "state"]
    assert line.split() == ["speed.json", "3", commit[:7], "2026-01-02", "512", "current"]
    assert last == "0 of 1 are stale; to measure 0 again takes about 0 minutes"
    code.write_text("def sweep(x):\n    return 3 * x\n")
    state()
    assert measurements.main(["--stale"]) == 0
    out = capsys.readouterr().out
    assert "1 of 1 are stale; to measure 1 again takes about 3 minutes" in out
    assert "== speed.json took 0.0 minutes" in out


def test_a_command_that_fails_is_said(repository, measurements, monkeypatch, capfd):
    _, state, _ = repository
    state("0" * 40)
    broken = measurements.Measurement(("solvers",), ('python -c "raise SystemExit(3)"',))
    monkeypatch.setattr(measurements, "TABLE", {"speed.json": broken})
    assert measurements.main(["--stale"]) == 1
    captured = capfd.readouterr()
    assert "FAILED: speed.json" in captured.err and "and 1 of unknown length" in captured.out


def test_pages_show_the_new_lines(measurements, repository, tmp_path, monkeypatch):
    """Whole where a page has all of it, block by block where it has parts; other lines stay."""
    _, state, commit = repository
    state(commit)
    example = tmp_path / "examples" / "01_speed.py"
    example.parent.mkdir()
    example.write_text(
        "import json, pathlib, sys\n"
        "path = pathlib.Path(sys.argv[2])\n"
        "n = json.loads(path.read_text()).get('n', 1)\n"
        "if sys.argv[1] == '--out':\n"
        "    path.write_text(json.dumps({'n': n + 1}))\n"
        "else:\n"
        "    print(f'first {n}   \\n\\nsecond {n}')\n"
    )
    made = measurements.Measurement(("solvers",), ("python examples/01_speed.py --out F",))
    monkeypatch.setattr(measurements, "TABLE", {"speed.json": made})
    docs = tmp_path / "docs"
    docs.mkdir()
    (docs / "whole.md").write_text("a\nfirst 1\n\nsecond 1\nb\n")
    assert measurements.measure("speed.json")
    assert (docs / "whole.md").read_text() == "a\nfirst 2\n\nsecond 2\nb\n"
    (docs / "whole.md").write_text("second 2\n\na\n\nfirst 2\nfirst 1\n")
    assert measurements.measure("speed.json")
    assert (docs / "whole.md").read_text() == "second 3\n\na\n\nfirst 3\nfirst 1\n"
