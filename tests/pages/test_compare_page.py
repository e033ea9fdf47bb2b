"""The first table of the page on comparisons is that of the committed run of the command above it."""

import json
from dataclasses import replace
from pathlib import Path

from kcons.cli.terminal import rendered
from kcons.comparison.work_precision import answer, report
from kcons.comparison.work_precision.measurement import Comparison

ROOT = Path(__file__).parents[2]
SHOWN = ("rattle", "suzuki4", "blanes-moan6", "ase-kcons", "ase-bonds", "ase-internals", "dop853")


def committed():
    data = json.loads((ROOT / "docs" / "results" / "compare_water.json").read_text(encoding="utf-8"))
    return Comparison.from_dict(data)


def test_the_page_shows_the_committed_run():
    found = committed()
    found = replace(found, measurements=[m for m in found.measurements if m.method in SHOWN])
    notes = [line for line in report.explanation(found).splitlines() if line.startswith("[")]
    lines = [line.rstrip() for line in (*rendered(report.table(found)).splitlines(), *notes)]
    wanted = "\n".join(line for line in lines if line)
    page = (ROOT / "docs" / "compare.md").read_text(encoding="utf-8")
    assert wanted in page, f"docs/compare.md has another table than\n\n{wanted}"


def test_the_page_shows_the_answer():
    found = committed()
    found = replace(found, measurements=[m for m in found.measurements if m.method in SHOWN])
    page = (ROOT / "docs" / "compare.md").read_text(encoding="utf-8")
    assert answer.text(answer.answer(found)) in page


def test_what_the_page_says_of_it():
    found = committed()
    best, finest = found.of("blanes-moan6")[0], found.of("rattle")[-1]
    assert (best.setting, finest.setting) == (12.0, 0.5)
    assert round(finest.error / best.error) == 36
    assert 0.4 < best.seconds_per_time / finest.seconds_per_time < 0.5
