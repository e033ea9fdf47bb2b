"""The page on OpenMM shows what the code does."""

from __future__ import annotations

import json
import re
import statistics
from pathlib import Path

from kcons.openmm import ProjectedIntegrator
from kcons.openmm.integrator.schemes import SCHEMES

DOCS = Path(__file__).resolve().parents[2] / "docs"
PAGE = (DOCS / "openmm.md").read_text(encoding="utf-8")


def test_listing_on_the_page_is_that_of_the_integrator():
    (shown,) = re.findall(r"^```text\n(constraints of the System\b.*?)\n```", PAGE, re.MULTILINE | re.DOTALL)
    assert shown == ProjectedIntegrator(0.002).listing()


def test_table_of_schemes():
    rows = re.findall(r"^\| (`.*?) \| (\d) \| ([\d, ]+) \| (?!\d)", PAGE, re.MULTILINE)
    table = {}
    for names, order, evaluations in rows:
        keys = re.findall(r"`(.*?)`", names)
        table |= {k: (int(order), int(e)) for k, e in zip(keys, evaluations.split(","), strict=True)}
    assert table.pop("leapfrog") == (2, 1)
    assert table == {name: (make().order, make().force_evaluations) for name, make in SCHEMES.items()}


def test_table_of_costs():
    rows = re.findall(r"^\| ([a-z0-9-]+) \| (\d+) \| (\d+) \| (\d+) \|$", PAGE, re.MULTILINE)
    assert {name for name, *_ in rows} == {*SCHEMES, "leapfrog"}
    for name, *numbers in rows:
        counts = ProjectedIntegrator(0.002, name).counts()
        found = [counts.passes, counts.constraint_solves, counts.force_evaluations]
        assert [int(n) for n in numbers] == found, name


def compared(part):
    return json.loads((DOCS / "results" / "report" / f"{part}.json").read_text("utf-8"))["comparison"]


def test_costs_of_compiled_steps_are_those_of_the_committed_comparison():
    def shown(part, method):
        found = compared(part)
        rows = [dict(zip(found["columns"], m, strict=True)) for m in found["measurements"]]
        shared = {m["setting"] for m in rows if m["method"] == "openmm-verlet"}
        value = statistics.median(
            m["step_seconds"] * 1e6 for m in rows if m["method"] == method and m["setting"] in shared
        )
        return f"{value:.2g}" if value < 10 else f"{value:.0f}"

    for part, title in (("dumbbells", "two dumbbells"), ("chain-1e3", "chain of 1000 bonds")):
        for tolerance, suffix in (("1e-12", ""), ("1e-4", "-1e-4")):
            third = "" if suffix else shown(part, "openmm-kcons-rattle")
            first, second = shown(part, f"openmm-verlet-{tolerance}"), shown(part, f"openmm-rattle{suffix}")
            assert f"| {title}, tolerance {tolerance} | {first} | {second} | {third} |" in PAGE

    dumbbells, chain = (compared(part)["timing"]["margin"] for part in ("dumbbells", "chain-1e3"))
    assert f"repeat to {dumbbells:.0%} (dumbbells) and {chain:.0%} (chain)".replace("%", " %") in PAGE


def test_figures_of_the_page_are_those_of_the_committed_results():
    measured = json.loads((DOCS / "results" / "openmm.json").read_text("utf-8"))["measurements"]
    fewer = measured["work and precision"]["fewer_than_rattle"]["blanes-moan6"]
    words = " ".join(PAGE.split())
    assert round(fewer) == 16 and "`blanes-moan6` needs sixteen times fewer force evaluations than `rattle`" in words
    ratio = measured["plain water"]["rows"]["kcons rattle"]["ratio"]
    assert f"`rattle` makes {ratio:.2f} of the steps a second of `VerletIntegrator`" in words
