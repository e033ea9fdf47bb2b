"""The page on steppers has every stepper, with its own properties."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from kcons import steppers
from kcons.comparison.methods import STEPPERS

PAGE = (Path(__file__).parents[2] / "docs" / "steppers.md").read_text(encoding="utf-8")


def table_of_the_page():
    head, _, *lines = re.search(r"^\| stepper \|.*?(?=\n\n)", PAGE, re.MULTILINE | re.DOTALL).group().splitlines()
    names = [cell.strip() for cell in head.strip("|").split("|")]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return {row[0].strip("`"): dict(zip(names, row, strict=True)) for row in rows}


def test_table_names_every_stepper():
    kinds = {kind.__name__ for kind in STEPPERS.values()}
    assert set(table_of_the_page()) == kinds


@pytest.mark.parametrize("name", table_of_the_page())
def test_table_says_what_the_stepper_says(name):
    row = table_of_the_page()[name]
    stepper = getattr(steppers, name)()
    assert int(row["order"]) == stepper.order
    assert int(row["forces a step"]) == stepper.force_evaluations
    assert (row["reversible"] == "yes") == stepper.reversible
    assert (row["symplectic"] == "yes") == stepper.symplectic
    refuses = isinstance(stepper, steppers.RungeKuttaNystrom)
    assert (row["velocity-dependent forces"] == "no") == refuses
    if isinstance(stepper, steppers.Splitting):
        drifts = [abs(a * w) for a in stepper.drifts for w in stepper.flight]
        assert int(row["flights a step"]) == len(drifts)
        assert float(row["longest flight"]) == pytest.approx(max(drifts), rel=0.05)
    else:
        assert row["flights a step"] == row["longest flight"] == ""
