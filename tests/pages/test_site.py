"""The site: its reference leaves no public name out, and its pages and commands are those that there are."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path

import kcons
from kcons.cli import main

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"


def described():
    """Modules that the reference is made of."""
    text = "".join(page.read_text(encoding="utf-8") for page in sorted((DOCS / "reference").glob("*.md")))
    return re.findall(r"^\.\. automodule:: ([\w.]+)$", text, re.MULTILINE)


def test_the_reference_has_every_package_with_public_names():
    """Those at the top, and what documents may import besides (`tests/contracts/test_layout.py`)."""
    packages = [path.parent.name for path in sorted((ROOT / "kcons").glob("*/__init__.py"))]
    public = {f"kcons.{name}" for name in packages if hasattr(import_module(f"kcons.{name}"), "__all__")}
    assert len(public) > 10
    assert public | {"kcons.models.flows", "kcons.comparison.test_systems", "kcons.errors"} <= set(described())
    assert len(described()) == len(set(described()))


def test_the_reference_finds_all_public_names():
    """What is imported when it is asked for is found by `dir`, of which the reference is made."""
    for name in described():
        module = import_module(name)
        assert set(getattr(module, "__all__", ())) <= set(dir(module)), name


def test_what_the_front_door_hands_on_is_described_where_it_lives():
    for name in kcons.__all__:
        thing = getattr(kcons, name)
        home = getattr(thing, "__module__", None) or getattr(thing, "__name__", "")
        assert name == "__version__" or any(f"{home}.".startswith(f"{at}.") for at in described()), name


def test_modules_among_the_public_names_have_their_place():
    from types import ModuleType

    found = import_module("kcons.comparison")
    modules = {value.__name__ for name in found.__all__ if isinstance(value := getattr(found, name), ModuleType)}
    assert modules <= set(described())


def test_each_command_has_its_help():
    commands = main.parser_of_all().commands
    assert {"compare", "plan", "check", "scan", "freeenergy", "warmup"} <= set(commands)
    for name, parser in commands.items():
        assert f"usage: kcons {name}" in parser.format_help()


def test_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 120
