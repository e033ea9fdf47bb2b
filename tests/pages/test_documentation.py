"""Every snippet in README.md and docs/, and every example, runs as it stands."""

from __future__ import annotations

import os
import re
import runpy
import shlex
import subprocess
import sys
import warnings

import pytest
from committed_pages import ROOT, entries, said, text_of

import kcons.comparison.measure  # noqa: F401  (conftest shortens its timings once it is there)
from kcons.cli import main
from kcons.constraints import Constraint, projection
from kcons.constraints.constraint_set import ConstraintSet
from kcons.motion import Motion

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
#: Scripts with tests of their own, in tests/studies and tests/batched, and those that write no table.
OWN = {*("harness", "bare_solvers", "bare_systems", "hard_cases", "stability", "solvers_alone", "whole_comparison")}
OWN |= {"batched", "water_model_by_gradients"}
PLAIN = {"constraint_figures", "own_constraints"}
STUDIES = [path for path in sorted((ROOT / "examples" / "studies").glob("*.py")) if path.stem not in OWN]
#: An example that runs in a process of its own.
BY_ITSELF = ROOT / "examples" / "rigid_water_ase.py"
EXAMPLES = [path for path in sorted((ROOT / "examples").glob("*.py")) if path.stem not in OWN and path != BY_ITSELF]
EXAMPLES += STUDIES
#: Pages on a program that `all` does not install; `.ci/run` has torch for some of these.
NEEDS = {"batched.md": "torch_sim"} | {
    f"tutorials/{name}.md": package for name, package in runpy.run_path(ROOT / "docs/notebooks.py")["NEEDS"].items()
}
FENCE = re.compile(r"^```(\w+)[^\n]*\n(.*?)^```", re.MULTILINE | re.DOTALL)

#: Between the cells of a table.
BAR = re.compile(r"(?<!\\)\|")


def name_of(page):
    return page.name if page.parent in (ROOT, ROOT / "docs") else page.relative_to(ROOT / "docs").as_posix()


def snippets(language):
    return [
        pytest.param(page, match[2], id=f"{name_of(page)}:{match.string.count(chr(10), 0, match.start()) + 1}")
        for page in PAGES
        for match in FENCE.finditer(text_of(page))
        if match[1] == language
    ]


def python_pages():
    """The Python snippets of one page continue each other; the site, in `.ci/run`, runs tutorials as notebooks."""
    pages = {}
    for parameter in snippets("python"):
        page, code = parameter.values
        pages.setdefault(page, []).append(code)
    slow = {page: pytest.mark.validation for page in pages if page.parent.name == "tutorials"}
    return [pytest.param("\n".join(codes), id=name_of(page), marks=slow.get(page, ())) for page, codes in pages.items()]


@pytest.mark.parametrize("code", python_pages())
def test_python_snippets_run(code, tmp_path, monkeypatch, request):
    if package := NEEDS.get(request.node.callspec.id):
        with warnings.catch_warnings(action="ignore"):
            pytest.importorskip(package)
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "snippet", "exec"), {"__name__": "snippet"})


@pytest.mark.parametrize(("page", "text"), snippets("console"))
def test_console_snippets_run(page, text, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    commands = [line[2:] for line in text.splitlines() if line.startswith("$ ")]
    assert commands, f"a console block in {page.name} has no line that starts with '$ '"
    for command in commands:
        program, *arguments = shlex.split(command, comments=True)
        assert program == "kcons", f"only kcons commands can be tested, not {command!r}"
        assert main.main(arguments) == 0, capsys.readouterr().err


@pytest.mark.filterwarnings("ignore:.*independent ones")  # quick runs are short, and say so
@pytest.mark.parametrize("script", EXAMPLES, ids=lambda path: path.name)
def test_example_runs(script, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    plain = ["."] if script.stem == "constraint_figures" else []  # draws its picture too
    quick = script in STUDIES and script.stem not in PLAIN
    assert said(script, *(["--quick", "--out", "found"] if quick else plain)).strip()


def test_examples_are_short_and_listed_under_the_tutorials():
    """Sixteen scripts that a user reads and changes; each says what it shows and how it is run."""
    scripts = sorted((ROOT / "examples").glob("*.py"))
    listed = re.findall(r"\]\(\.\./\.\./examples/(\w+\.py)\)", text_of("tutorials/index.md"))
    assert sorted(listed) == [script.name for script in scripts] and len(scripts) == 16
    for script in scripts:
        text = script.read_text(encoding="utf-8")
        assert len(text.splitlines()) <= 60 and not re.search(r"\d", script.name), script.name
        assert text.startswith('"""') and f"python examples/{script.name}" in text.split('"""')[1], script.name
        assert not re.search(r"^\s*(from|import) tests", text, re.MULTILINE), script.name


def test_an_example_runs_by_itself(tmp_path):
    """Nothing but what it imports, and no warning of anybody."""
    result = subprocess.run(
        [sys.executable, "-W", "error", str(BY_ITSELF)],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
    )
    assert result.returncode == 0 and result.stdout.strip(), result.stderr


@pytest.mark.parametrize("page", [*PAGES, ROOT / "CONTRIBUTING.md"], ids=name_of)
def test_links_lead_somewhere_and_all_of_a_page_is_seen(page):
    """To MyST a line that begins with % is a comment; the text of a picture loses the ends of its lines."""
    for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text_of(page)):
        assert (page.parent / target).exists(), f"{page.name} links to {target}"
    text = FENCE.sub("", text_of(page))
    assert not re.findall(r"^\s*%.*", text, re.MULTILINE)
    assert not re.findall(r"!\[[^\]]*\n", text)
    for table in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE):
        head, *rows = table.splitlines()
        cells = len(BAR.findall(head))
        assert [row for row in rows if len(BAR.findall(row)) != cells] == []


def in_the_tables(page):
    """The pages that the tables of contents of a page name, and those that these name."""
    named = [inner for entry in entries(page) if (inner := (page.parent / f"{entry}.md").resolve()).is_file()]
    return {*named, *(found for inner in named for found in in_the_tables(inner))}


def test_every_page_is_found_from_the_front():
    """In the tables of contents of the site, or linked from README."""
    linked = re.findall(r"\]\((docs/[\w/-]+\.md)\)", text_of(ROOT / "README.md"))
    index = ROOT / "docs" / "index.md"
    found = {index, ROOT / "README.md", *in_the_tables(index), *(ROOT / page for page in linked)}
    assert sorted(page.relative_to(ROOT).as_posix() for page in set(PAGES) - found) == []
    assert ROOT / "docs" / "compare.md" in PAGES and STUDIES


def test_names_in_the_glossary_exist():
    owners = {"projection": projection, "Motion": Motion, "ConstraintSet": ConstraintSet, "Constraint": Constraint}
    named = re.findall(r"`(projection|Motion|ConstraintSet|Constraint)\.(\w+)", text_of("glossary.md"))
    assert len(named) > 20
    for owner, name in named:
        assert hasattr(owners[owner], name), f"{owner}.{name}"
