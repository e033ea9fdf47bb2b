"""The tutorials as notebooks.

    python docs/notebooks.py DIR            write them
    python docs/notebooks.py DIR --run      run them first, so that outputs and pictures are in them

The cells are the Python snippets of a page; the site offers each notebook beside its page.
"""

from __future__ import annotations

import argparse
import re
import tempfile
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import nbformat
from nbformat import v4

TUTORIALS = Path(__file__).resolve().parent / "tutorials"
PYTHON = re.compile(r"^```python\n(.*?)\n```$", re.MULTILINE | re.DOTALL)
#: Tutorials on a program that `all` does not install: they run where it is there.
NEEDS = {"replica_exchange": "openmmtools", "sella": "sella", "torsions_at_once": "torch_sim"}
LINK = re.compile(r"(!?)\[([^\]]*)\]\((?!https?:)[^)]*\)")


def pages() -> list[Path]:
    """Those that have Python snippets."""
    found = (page for page in sorted(TUTORIALS.glob("*.md")) if page.stem != "index")
    return [page for page in found if "\n```python\n" in page.read_text(encoding="utf-8")]


def notebook_of(page: Path) -> Any:
    """A page as a notebook without outputs: links into the site lose their target, pictures are drawn by the cells."""
    cells = []
    for k, part in enumerate(PYTHON.split(page.read_text(encoding="utf-8"))):  # words and snippets in turn
        words = LINK.sub(lambda match: "" if match[1] else match[2], part).strip()
        if k % 2:
            cells.append(v4.new_code_cell(part))
        elif words:
            cells.append(v4.new_markdown_cell(words))
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    return v4.new_notebook(cells=cells, metadata={"kernelspec": kernel})


def run(notebook: Any, folder: Path) -> Any:
    """The notebook after its cells have run in `folder`; the first one that fails raises."""
    from nbclient import NotebookClient

    return NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(folder)}}).execute()


def write(folder: Path, *, executed: bool = False) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for page in pages():
        notebook = notebook_of(page)
        if executed and (page.stem not in NEEDS or find_spec(NEEDS[page.stem])):
            with tempfile.TemporaryDirectory() as place:  # some refuse to write over what an earlier run has left
                notebook = run(notebook, Path(place))
        nbformat.write(notebook, folder / f"{page.stem}.ipynb")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--run", action="store_true")
    chosen = parser.parse_args()
    write(chosen.folder, executed=chosen.run)
