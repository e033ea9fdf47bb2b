"""Diagrams of a page: every point is in them, and nothing that ends the script around them."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from kcons.comparison.work_precision import interactive, whole
from kcons.comparison.work_precision.chosen_curves import chosen
from kcons.comparison.work_precision.fronts import points

FOLDER = Path(__file__).parents[3] / "docs" / "results" / "report"


@pytest.fixture(scope="module")
def rotor():
    (part,) = [part for part in whole.parts(FOLDER) if part.key == "rotor"]
    return part.comparison


def data_of(html):
    (text,) = re.findall(r'<script type="application/json">(.*?)</script>', html)
    return json.loads(text)


def test_every_point_is_there(rotor):
    data = data_of(interactive.diagram(rotor))
    wanted = [m for m in points(rotor, "evaluations") if m.error]
    found = {(c["t"], p[3], p[2]) for c in data["curves"] for p in c["p"]}
    assert len(found) == len(wanted) == sum(len(c["p"]) for c in data["curves"])
    assert {(m.title, m.error) for m in wanted} == {(title, error) for title, _, error in found}
    on = {c["t"] for c in data["curves"] if c["on"]}
    assert on == {title for curve in chosen(rotor) for title in (curve.label, *curve.alike)}
    assert data["axes"][2] == "error / length"


def test_titles_cannot_end_the_script(rotor):
    bad = replace(rotor, measurements=[replace(m, title="</script><b>") for m in rotor.measurements])
    html = interactive.diagram(bad)
    assert html.count("</script>") == 1 and data_of(html)["curves"][0]["t"] == "</script><b>"


def test_without_errors_there_is_no_diagram(rotor):
    none = replace(rotor, measurements=[replace(m, error=None) for m in rotor.measurements])
    assert interactive.diagram(none) == "" and interactive.diagrams({"rotor": none}) == {}


def test_the_script_fetches_nothing():
    assert not re.search(r"https?://(?!www\.w3\.org/2000/svg)|fetch\(|import\(", interactive.head())
