"""Tutorials as notebooks: the cells are the snippets of the page, and they run."""

from __future__ import annotations

import re
import runpy

import pytest
from committed_pages import DOCS, blocks, text_of
from nbclient.exceptions import CellExecutionError
from nbformat import v4

NOTEBOOKS = runpy.run_path(str(DOCS / "notebooks.py"))


def test_cells_are_the_snippets_of_the_page():
    pages = NOTEBOOKS["pages"]()
    assert len(pages) >= 8
    for page in pages:
        snippets = [block.removesuffix("\n") for block in blocks(text_of(page), "python")]
        cells = NOTEBOOKS["notebook_of"](page).cells
        assert [cell.source for cell in cells if cell.cell_type == "code"] == snippets, page.name
        words = "\n".join(cell.source for cell in cells if cell.cell_type == "markdown")
        assert not re.search(r"\]\((?!https?:)", words), page.name  # nothing leads out of the notebook


def test_a_notebook_runs_and_a_cell_that_fails_is_told(tmp_path):
    (page,) = (page for page in NOTEBOOKS["pages"]() if page.stem == "check_trajectory")
    notebook = NOTEBOOKS["run"](NOTEBOOKS["notebook_of"](page), tmp_path)
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert any("kept to the precision of the file" in output.get("text", "") for output in outputs)
    notebook.cells.append(v4.new_code_cell("assert False"))
    with pytest.raises(CellExecutionError, match="assert False"):
        NOTEBOOKS["run"](notebook, tmp_path)
