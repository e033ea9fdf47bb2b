"""What goes with a release says the same as the package: version, dependencies, licenses."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

import pytest

import kcons

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
CONDA = (ROOT / ".github" / "conda" / "meta.yaml").read_text(encoding="utf-8")


def parts(requirement):
    """Name and least version."""
    name, least = re.fullmatch(r"([\w.-]+)(?:\[\w+\])?>=([\d.]+)", requirement).groups()
    return name.lower(), least


def test_the_version_is_one():
    version = kcons.__version__
    assert json.loads((ROOT / ".zenodo.json").read_text(encoding="utf-8"))["version"] == version
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f'{{% set version = "{version}" %}}' in CONDA


@pytest.mark.parametrize("requirement", PROJECT["dependencies"])
def test_the_conda_recipe_needs_what_the_package_needs(requirement):
    name, least = parts(requirement)
    assert f"    - {name} >={least}\n" in CONDA.partition("  run:")[2].partition("run_constrained")[0]


def test_the_conda_recipe_needs_nothing_else():
    run = re.findall(r"- (\S+) >=", CONDA.partition("  run:")[2].partition("run_constrained")[0])
    assert set(run) == {"python", *(parts(r)[0] for r in PROJECT["dependencies"])}


def test_licenses_of_all_dependencies_are_listed():
    page = (ROOT / "docs" / "licenses.md").read_text(encoding="utf-8")
    listed = {
        name.lower(): extra for name, extra in re.findall(r"^\| ([\w-]+) \| (?:`([\w-]+)`)? ?\|", page, re.MULTILINE)
    }
    wanted = {parts(r)[0]: "" for r in PROJECT["dependencies"]}
    extras = PROJECT["optional-dependencies"]
    within = re.fullmatch(r"kcons\[(.*)\]", extras["all"][0])[1].split(",")
    wanted |= {parts(r)[0]: extra for extra in within for r in extras[extra]}
    assert {name: extra for name, extra in listed.items() if name != "package"} == wanted


def test_hosted_checks_are_those_of_the_project():
    text = (ROOT / ".github" / "workflows" / "checks.yml").read_text(encoding="utf-8")
    assert "run: bash .ci/run" in text
    versions = re.findall(r'"(3\.\d+)"', text)
    assert versions[0] == PROJECT["requires-python"].removeprefix(">=") and len(versions) >= 3


def test_works_cited_in_the_paper_are_in_its_bibliography():
    paper, works = ((ROOT / "docs" / "paper" / name).read_text(encoding="utf-8") for name in ("paper.md", "paper.bib"))
    cited = set(re.findall(r"@([\w-]+)\]", paper))
    assert cited and cited == set(re.findall(r"^@\w+\{([\w-]+),", works, re.MULTILINE))
    for picture in re.findall(r"\]\((\.\./[^)]+\.png)\)", paper):
        assert (ROOT / "docs" / "paper" / picture).is_file()


def test_the_source_distribution_has_what_it_names():
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["hatch"]["build"]["targets"]
    for entry in listed["sdist"]["include"]:
        assert (ROOT / entry.lstrip("/")).exists(), entry
