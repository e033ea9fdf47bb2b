"""The layout of the package: few rooms, a story in each, imports without circles, a public surface."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import re
from collections import Counter
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import kcons

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "kcons"
FILES = sorted(PACKAGE.rglob("*.py"))
FOLDERS = sorted({path.parent for path in FILES})
#: Folders in which one file is one test system or one theme.
CATALOGUES = {"comparison/scenes", "comparison/hard_cases"}
#: Names that several modules may have: each says what its folder's is.
SHARED = {"topology", "report", "study"}


def entries(folder: Path) -> set[str]:
    modules = {path.stem for path in folder.glob("*.py")} - {"__init__", "__main__"}
    return modules | {path.name for path in folder.iterdir() if (path / "__init__.py").exists()}


def module_of(path: Path) -> str:
    parts = ("kcons", *path.relative_to(PACKAGE).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda f: f.relative_to(ROOT).as_posix())
def test_a_folder_tells_its_story(folder):
    """In at most 15 lines, with each of its modules named once."""
    story = ast.get_docstring(ast.parse((folder / "__init__.py").read_text()))
    assert story is not None and len(story.splitlines()) <= 15
    heads = [line for line in story.splitlines() if line.startswith("- `")]
    named = re.findall(r"`([^`]+)`", " ".join(re.match(r"- ((?:`[^`]+`(?:, )?)+)", line)[1] for line in heads))
    assert Counter(named) == Counter(entries(folder))


def test_folders_are_small():
    assert len(entries(PACKAGE)) <= 15
    large = {f.relative_to(PACKAGE).as_posix() for f in FOLDERS if len(entries(f)) > 15}
    assert large <= CATALOGUES


def imports_of(path: Path, names: set[str]) -> set[str]:
    """Modules of the package that a file imports, inside functions and for types as well."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
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
    """`kcons` and `kcons.X`; of what is deeper the folders that are a subject of their own."""
    own = {"cli.progress", "models.flows", "models.growth", "comparison.hard_cases", "comparison.stability"}
    deep = []
    for path in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), *sorted((ROOT / "examples").glob("*.py"))]:
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            found = re.match(r"\s*(?:from|import) kcons\.(\w+\.[\w.]+)", line)
            if found and found[1] not in own:
                deep.append(f"{path.name}:{number}: {line.strip()}")
    assert deep == []


def test_names_of_modules_are_their_own():
    """No two modules share a name, but for those whose folder says whose they are."""
    stems = Counter(path.stem for path in FILES if not path.stem.startswith("__"))
    assert {name for name, count in stems.items() if count > 1} <= SHARED


@pytest.mark.parametrize(("old", "new"), kcons.MOVED.items())
def test_modules_are_found_by_the_names_they_had(old, new):
    """One module under both names, and it knows itself by the new one."""
    module = importlib.import_module(f"kcons.{old}")
    assert module is importlib.import_module(f"kcons.{new}")
    assert module.__name__ == f"kcons.{new}" and module.__spec__.name == f"kcons.{new}"
    assert getattr(kcons, old) is module


def test_what_is_inside_a_moved_folder_is_found_too():
    from kcons.flows.linear_flow import LinearFlow as old

    from kcons.models.flows.linear_flow import LinearFlow as new

    assert old is new
    with pytest.raises(ImportError, match=r"kcons\.models\.flows\.nothing"):
        importlib.import_module("kcons.flows.nothing")
    assert importlib.util.find_spec("kcons.nothing") is None
