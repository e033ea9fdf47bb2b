"""Each mutant of `mutants` fails the tests named for it, which pass without it. Long; run by `-m mutants`."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
from mutants import MUTANTS

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "kcons"
#: What pytest returns: all passed, some failed.
PASSED, FAILED = 0, 1


def ids(mutant):
    file, old, *_ = mutant
    return f"{file}-{old.splitlines()[-1].strip()[:40]}"


def needed(file: str) -> str:
    """The package that tests of a module need, if `all` does not install it."""
    return {"batched": "torch", "torchsim": "torch_sim"}.get(file.partition("/")[0], "kcons")


def copied(folder: Path) -> Path:
    """The package with its compiled kernels, and its tests, where lines can be changed."""
    shutil.copytree(PACKAGE, folder / "kcons")
    shutil.copytree(ROOT / "tests", folder / "tests", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(ROOT / "examples", folder / "examples")
    shutil.copy(ROOT / "pyproject.toml", folder)
    return folder


def run(folder: Path, tests: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    for name in ("NUMBA_CACHE_DIR", "PYTEST_ADDOPTS", "PYTEST_XDIST_WORKER"):
        environment.pop(name, None)
    command = [sys.executable, "-m", "pytest", "-q", "-x", "--tb=line", "-p", "no:cacheprovider", "-p", "no:xdist"]
    return subprocess.run(
        [*command, *tests.split()], cwd=folder, env=environment, capture_output=True, text=True, timeout=1200
    )


def test_the_list_is_true():
    """The text is there, once, and so are the tests."""
    wrong = []
    for file, old, new, tests in MUTANTS:
        if (PACKAGE / file).read_text().count(old) != 1 or old == new or not tests:
            wrong.append(f"{file}: {old}")
        for path, _, name in (test.partition("::") for test in tests.split()):
            if name and f"def {name.partition('[')[0]}(" not in (ROOT / path).read_text():
                wrong.append(f"{path}::{name}")
    assert wrong == []


@pytest.mark.mutants
def test_the_tests_pass_without_mutants(tmp_path):
    folder = copied(tmp_path)
    where = [sys.executable, "-c", "import kcons; print(kcons.__file__)"]
    found = subprocess.run(
        where, cwd=folder, env={**os.environ, "PYTHONPATH": str(folder)}, capture_output=True, text=True
    )
    assert Path(found.stdout.strip()).is_relative_to(folder), found
    named = {test for file, *_, tests in MUTANTS if find_spec(needed(file)) for test in tests.split()}
    result = run(folder, " ".join(sorted(named)))
    assert result.returncode == PASSED, result.stdout


@pytest.mark.mutants
@pytest.mark.parametrize("mutant", MUTANTS, ids=ids)
def test_the_mutant_is_killed(mutant, tmp_path):
    file, old, new, tests = mutant
    pytest.importorskip(needed(file))
    folder = copied(tmp_path)
    target = folder / "kcons" / file
    text = target.read_text()
    assert text.count(old) == 1
    target.write_text(text.replace(old, new))
    for test in tests.split():
        result = run(folder, test)
        assert result.returncode == FAILED, f"{test} does not fail:\n{result.stdout[-3000:]}"
        # What does not run at all shows nothing about the test.
        assert not re.search(r"TypingError|LoweringError|NameError|SyntaxError", result.stdout), result.stdout[-3000:]
