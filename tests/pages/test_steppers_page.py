"""The page on steppers has the table of all steppers as it is made from them."""

from __future__ import annotations

import importlib.util
from pathlib import Path

DOCS = Path(__file__).parents[2] / "docs"


def test_the_table_is_as_it_is_made():
    spec = importlib.util.spec_from_file_location("make_tables", DOCS / "make_tables.py")
    tables = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tables)
    page = (DOCS / "steppers.md").read_text(encoding="utf-8")
    row = "| `BlanesMoan4` | `blanes-moan4` | 4 | yes | yes | 6 | 30 | 0.398 | no |"
    assert row in page and tables.renewed(page) == page, "run docs/make_tables.py"
