"""Tutorials as notebooks: the cells are the snippets of the page, and they run."""

from __future__ import annotations

import re
import runpy

import pytest
from committed_pages import ROOT
from nbclient.exceptions import CellExecutionError
from nbformat import v4

NOTEBOOKS = runpy.run_path(str(ROOT / "docs" / "notebooks.py"))


def test_cells_are_the_snippets_of_the_page():
    pages = NOTEBOOKS["pages"]()
    assert len(pages) >= 8
    for page in pages:
        snippets = re.findall(r"^```python\n(.*?)\n```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
        cells = NOTEBOOKS["notebook_of"](page).cells
        assert [cell.source for cell in cells if cell.cell_type == "code"] == snippets, page.name
        words = "\n".join(cell.source for cell in cells if cell.cell_type == "markdown")
        assert not re.search(r"\]\((?!https?:)", words), page.name  # nothing leads out of the notebook


def test_a_notebook_runs_and_a_cell_that_fails_is_told(tmp_path):
    (page,) = (page for page in NOTEBOOKS["pages"]() if page.stem == "check_trajectory")
    notebook = NOTEBOOKS["notebook_of"](page)
    notebook = NOTEBOOKS["run"](notebook, tmp_path)
    said = [
        output.text
        for cell in notebook.cells
        if cell.cell_type == "code"
        for output in cell.outputs
        if "text" in output
    ]
    assert any("kept to the precision of the file" in text for text in said)
    notebook.cells.append(v4.new_code_cell("assert False"))
    with pytest.raises(CellExecutionError, match="assert False"):
        NOTEBOOKS["run"](notebook, tmp_path)
