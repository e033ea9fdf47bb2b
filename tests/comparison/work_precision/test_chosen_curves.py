"""Few curves in a diagram, and those that coincide as one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from kcons.comparison.work_precision import whole
from kcons.comparison.work_precision.chosen_curves import MOST, chosen
from kcons.comparison.work_precision.fronts import is_ours, points

FOLDER = Path(__file__).parents[3] / "docs" / "results" / "report"


@pytest.fixture(scope="module")
def water():
    (part,) = [part for part in whole.parts(FOLDER) if part.key == "water-216"]
    return part.comparison


def test_at_most_eight_of_both_kinds(water):
    found = chosen(water)
    assert len({m.method for m in points(water, "evaluations")}) > 20
    assert len(found) == MOST
    ours = [curve for curve in found if is_ours(curve.points[0])]
    assert len(ours) >= 4 and len(found) - len(ours) >= 3
    assert "rattle" in {curve.method for curve in found}
    assert len(chosen(water, 4)) == 4


def test_what_coincides_is_one_curve(water):
    alike = {curve.label: list(curve.alike) for curve in chosen(water, 100)}
    groups = [{label, *others} for label, others in alike.items()]
    assert any({"OpenMM Verlet, 1e-8", "OpenMM Verlet, 1e-12"} <= group for group in groups)
    named = [title for label, others in alike.items() for title in (label, *others)]
    assert len(named) == len(set(named)) == len({m.method for m in points(water, "evaluations") if m.error})


def test_an_error_apart_is_another_curve(water):
    one, *_ = [m for m in water.measurements if m.method == "rattle"]
    twins = [m for m in water.measurements if m.method == "rattle" and m.status == "ok"]
    copies = [replace(m, method="geodesic", title="twin") for m in twins]
    both = replace(water, measurements=[*twins, *copies])
    (merged,) = chosen(both)
    assert merged.name == f"{one.title} = twin"
    copies[0] = replace(copies[0], error=1.2 * copies[0].error)
    assert len(chosen(replace(water, measurements=[*twins, *copies]))) == 2
