"""The layout of the package: a story in each room, imports without circles, small functions, a public surface."""

from __future__ import annotations

import ast
import functools
import re
import subprocess
import sys
from collections import Counter
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "kcons"
FILES = sorted(PACKAGE.rglob("*.py"))
FOLDERS = sorted({path.parent for path in FILES})


def entries(folder: Path) -> set[str]:
    modules = {path.stem for path in folder.glob("*.py")} - {"__init__", "__main__"}
    return modules | {path.name for path in folder.iterdir() if (path / "__init__.py").exists()}


def module_of(path: Path) -> str:
    parts = ("kcons", *path.relative_to(PACKAGE).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda f: f.relative_to(ROOT).as_posix())
def test_a_folder_tells_its_story(folder):
    """With each of its modules named once."""
    story = ast.get_docstring(ast.parse((folder / "__init__.py").read_text()))
    assert story is not None
    heads = [line for line in story.splitlines() if line.startswith("- `")]
    named = re.findall(r"`([^`]+)`", " ".join(re.match(r"- ((?:`[^`]+`(?:, )?)+)", line)[1] for line in heads))
    assert Counter(named) == Counter(entries(folder))


@functools.cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def imports_of(path: Path, names: set[str]) -> set[str]:
    """Modules of the package that a file imports, inside functions and for types as well."""
    found = set()
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "kcons":
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                found.add(inner if inner in names else node.module)
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names if alias.name in names}
    return found


def test_no_circle_of_imports():
    """Imports for types only and inside functions count; the names that a folder hands on do not."""
    paths = {module_of(path): path for path in FILES if path.name != "__init__.py"}
    names = {module_of(path) for path in FILES}
    graph = {name: imports_of(path, names) & set(paths) for name, path in paths.items()}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" <- ".join(error.args[1]))


def test_documents_and_examples_import_public_names():
    """`kcons` and `kcons.X`; of what is deeper the folders that are a subject of their own, and all in studies."""
    own = {"comparison.methods", "models.flows", "models.growth"}
    deep = []
    for path in [
        ROOT / "README.md",
        *sorted((ROOT / "docs").rglob("*.md")),
        *sorted(path for path in (ROOT / "examples").rglob("*.py") if "studies" not in path.parts),
    ]:
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            found = re.match(r"\s*(?:from|import) kcons\.(\w+\.[\w.]+)", line)
            if found and found[1] not in own:
                deep.append(f"{path.name}:{number}: {line.strip()}")
    assert deep == []


def test_functions_are_small():
    """At most 100 lines; ruff counts parameters."""
    large = []
    for path in FILES:
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.end_lineno - node.lineno >= 100:
                large.append(f"{path.relative_to(PACKAGE)}: {node.name}")
    assert large == []


def test_there_is_one_tolerance_of_ranks():
    """Outside the oracle; other limits are of other quantities, and have names of their own."""
    defined = re.compile(r"^_?RANK_TOLERANCE\b.*=", re.MULTILINE)
    places = [
        path.relative_to(PACKAGE).as_posix() for path in FILES if defined.search(path.read_text(encoding="utf-8"))
    ]
    assert [place for place in places if place != "constraints/projection.py"] == ["solvers/tolerances.py"]


def test_importing_the_package_imports_nothing_else():
    """What it names is imported when it is asked for: the command prints its help in a tenth of a second."""
    code = """
import sys, kcons
before = {"numpy", "numba"} & set(sys.modules)
names = [getattr(kcons, name).__name__ for name in kcons.__all__ if name != "__version__"]
print(before, names, kcons.steppers.Rattle is kcons.Rattle, "run" in dir(kcons), hasattr(kcons, "glue"))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    names = "['ConstraintSet', 'Motion', 'Rattle', 'State', 'System', 'kcons.constraints', 'kcons.errors', 'run']"
    assert done.stdout.strip() == f"set() {names} True True False"
