"""The site: its reference leaves no public name out, and its pages and commands are those that there are."""

from __future__ import annotations

import re
from importlib import import_module

import pytest
from committed_pages import DOCS, ROOT, entries, text_of

import kcons
from kcons.cli import main

NEED_TORCH = ("kcons.batched", "kcons.torchsim")


def described():
    """Modules that the reference is made of."""
    text = "".join(map(text_of, sorted((DOCS / "reference").glob("*.md"))))
    return re.findall(r"^\.\. automodule:: ([\w.]+)$", text, re.MULTILINE)


def test_the_reference_has_every_package_with_public_names():
    """Those at the top, and what documents may import besides (`tests/contracts/test_layout.py`)."""
    packages = [path.parent.name for path in sorted((ROOT / "kcons").glob("*/__init__.py"))]
    texts = {name: text_of(ROOT / "kcons" / name / "__init__.py") for name in packages}
    public = {f"kcons.{name}" for name, text in texts.items() if re.search(r"^__all__\b", text, re.MULTILINE)}
    assert len(public) > 10
    assert public | {"kcons.models.flows", "kcons.comparison.test_systems", "kcons.errors"} <= set(described())
    assert len(described()) == len(set(described()))


def test_the_reference_finds_all_public_names_and_those_of_the_front_door_where_they_live():
    """What is imported when it is asked for is found by `dir`, of which the reference is made."""
    for name in described():
        if not name.startswith(NEED_TORCH):  # which import all names
            module = import_module(name)
            assert set(getattr(module, "__all__", ())) <= set(dir(module)), name
    for name in kcons.__all__:
        thing = getattr(kcons, name)
        home = getattr(thing, "__module__", None) or getattr(thing, "__name__", "")
        assert name == "__version__" or any(f"{home}.".startswith(f"{at}.") for at in described()), name


def test_each_command_has_its_help():
    commands = main.parsers()[1]
    assert {"compare", "plan", "check", "scan", "freeenergy", "warmup"} <= set(commands)
    for name, parser in commands.items():
        assert f"usage: kcons {name}" in parser.format_help()


#: Pages whose length is that of a table of what there is.
LISTS = {"equations.md", "glossary.md", "index.md", "solved_threads.md"}


@pytest.mark.parametrize("page", sorted(page.name for page in DOCS.glob("*.md") if page.name not in LISTS))
def test_a_page_is_read_in_one_sitting(page):
    """At most 200 lines and a picture; results are on the pages of docs/evidence, made from the result files."""
    assert len(text_of(page).splitlines()) <= 200
    assert "](figures/" in text_of(page) or page in {"licenses.md", "theory.md"}


def test_readme_and_sidebar_are_short_and_the_prose_stays_a_guide():
    """What is written by hand; docs/evidence is made from results, docs/reference from docstrings."""
    assert len(text_of(ROOT / "README.md").splitlines()) <= 100
    pages = [*DOCS.glob("*.md"), *(DOCS / "tutorials").glob("*.md")]
    assert sum(len(text_of(page).splitlines()) for page in pages) <= 4500
    links = entries(DOCS / "index.md")
    assert {"ase", "openmm", "glossary", "reference/index"} <= set(links)
    assert len(links) <= 20
