"""The site: `python -m sphinx -W --keep-going -b html docs site`, with the optional extras `docs` and `all`."""

from __future__ import annotations

import os
import re
import sys
from importlib.util import find_spec
from pathlib import Path

from docutils import nodes
from docutils.parsers.rst import Directive

sys.path.insert(0, str(Path(__file__).parent))

import notebooks

from kcons import __version__
from kcons.cli.main import parsers

os.environ.setdefault("MPLBACKEND", "Agg")

project = "kcons"
author = "the kcons developers"
copyright = "the kcons developers"
version = release = __version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx_design",
]
exclude_patterns = ["results", "paper", "_notebooks"]
templates_path = ["_templates"]
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 4
suppress_warnings = ["myst.header", "config.cache", "ref.python"]
# Of one name in several classes the nearest is linked. Docstrings write code between single backquotes.
default_role = "code"
autodoc_member_order = "bysource"
# Described also where they are not installed.
autodoc_mock_imports = [name for name in ("torch", "torch_sim") if find_spec(name) is None]
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
napoleon_google_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True
copybutton_exclude = ".linenos, .gp, .go"

html_theme = "furo"
html_title = "kcons"
html_static_path = ["_static"]
html_css_files = ["wide.css"]
html_show_sourcelink = False
toc_object_entries_show_parents = "hide"


class CommandHelp(Directive):
    """What `kcons COMMAND --help` says, for every command."""

    def run(self) -> list[nodes.Node]:
        found: list[nodes.Node] = []
        for name, parser in parsers()[1].items():
            section = nodes.section(ids=[nodes.make_id(f"kcons-{name}")])
            section += nodes.title(text=f"kcons {name}")
            section += nodes.literal_block(text=parser.format_help(), language="text")
            found.append(section)
        return found


def keep_bars(app: object, what: str, name: str, thing: object, options: object, lines: list[str]) -> None:
    """|v| is a norm in docstrings, and no substitution, but between backquotes."""
    for k, line in enumerate(lines):
        parts = re.split(r"(`+[^`]*`+)", line)
        lines[k] = "".join(part if part.startswith("`") else part.replace("|", r"\|") for part in parts)


def write_notebooks(app: object) -> None:
    """Tutorials as notebooks, run where KCONS_RUN_NOTEBOOKS is 1."""
    notebooks.write(Path(__file__).parent / "_notebooks", executed=os.environ.get("KCONS_RUN_NOTEBOOKS") == "1")


def offer_notebook(app: object, docname: str, source: list[str]) -> None:
    """Below the title of a tutorial, where it can be had as a notebook."""
    folder, _, name = docname.rpartition("/")
    if folder == "tutorials" and name in {page.stem for page in notebooks.pages()}:
        title, _, rest = source[0].partition("\n")
        source[0] = f"{title}\n\n{{download}}`This page as a notebook <../_notebooks/{name}.ipynb>`\n{rest}"


def setup(app: object) -> None:
    app.connect("autodoc-process-docstring", keep_bars, priority=900)  # type: ignore[attr-defined]
    app.connect("builder-inited", write_notebooks)  # type: ignore[attr-defined]
    app.connect("source-read", offer_notebook)  # type: ignore[attr-defined]
    app.add_directive("command-help", CommandHelp)  # type: ignore[attr-defined]
