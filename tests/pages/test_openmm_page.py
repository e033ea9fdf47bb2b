"""The page on OpenMM shows what the code does."""

from __future__ import annotations

import re
from pathlib import Path

from kcons.openmm import SCHEMES, ProjectedIntegrator

DOCS = Path(__file__).resolve().parents[2] / "docs"
PAGE = (DOCS / "openmm.md").read_text(encoding="utf-8")


def test_listing_on_the_page_is_that_of_the_integrator():
    (shown,) = re.findall(r"^```text\n(constraints of the System\b.*?)\n```", PAGE, re.MULTILINE | re.DOTALL)
    assert shown == ProjectedIntegrator(0.002, device=False).listing()


def test_table_of_schemes():
    rows = re.findall(r"^\| (`.*?) \| (\d) \| ([\d, ]+) \| (?!\d)", PAGE, re.MULTILINE)
    table = {}
    for names, order, evaluations in rows:
        keys = re.findall(r"`(.*?)`", names)
        table |= {k: (int(order), int(e)) for k, e in zip(keys, evaluations.split(","), strict=True)}
    made = {name: SCHEMES[name]() for name in table}  # the page on steppers has all of them
    assert len(table) > 5 and table == {name: (made[name].order, made[name].force_evaluations) for name in table}
