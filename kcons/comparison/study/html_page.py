"""One self-contained HTML page: text, tables and pictures, nothing fetched from elsewhere."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

from kcons.comparison.study.tables import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STYLE = """
:root { color-scheme: light dark; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 76rem; margin: 0 auto; padding: 1rem 1.5rem 4rem; }
nav ol { columns: 18rem; padding-left: 1.5rem; }
h2 { margin-top: 3rem; border-top: 1px solid #8886; padding-top: 1rem; }
img { max-width: 100%; height: auto; background: #fff; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 0.85rem; font-variant-numeric: tabular-nums; }
th, td { padding: 0.2rem 0.7rem; text-align: right; white-space: nowrap; }
th { position: sticky; top: 0; background: Canvas; border-bottom: 2px solid #888; }
td { border-bottom: 1px solid #8884; vertical-align: top; }
th.text, td.text { text-align: left; }
td.long { white-space: normal; min-width: 16rem; }
tr.good td:first-child { border-left: 4px solid #2a9d4a; }
tr.bad td:first-child { border-left: 4px solid #d0342c; }
pre { white-space: pre-wrap; font-size: 0.8rem; }
th { cursor: pointer; }
details > summary { cursor: pointer; margin: 0.5rem 0; }
"""

#: A click on a heading sorts its table, by number where cells begin with one; another click turns the order round.
SORTING = """
document.addEventListener("click", event => {
  const head = event.target.closest("th");
  if (!head) return;
  const body = head.closest("table").tBodies[0], column = head.cellIndex;
  const down = head.dataset.order === "up";
  head.dataset.order = down ? "down" : "up";
  const value = row => {
    const text = row.cells[column].textContent.trim();
    const number = parseFloat(text.replaceAll(",", ""));
    return Number.isNaN(number) ? text : number;
  };
  const rows = [...body.rows].sort((a, b) => {
    const [x, y] = [value(a), value(b)];
    if (typeof x !== typeof y) return typeof x === "number" ? -1 : 1;
    return (x < y ? -1 : x > y ? 1 : 0) * (down ? -1 : 1);
  });
  body.append(...rows);
});
"""

#: Cells with more characters than this may be broken into lines.
LONG = 40


@dataclass(frozen=True)
class Section:
    """A heading, and under it paragraphs, pictures and tables in this order; `literal` is set as it is.

    `diagram` is HTML that is put before the pictures; `folded` tables are shown after a click.
    """

    heading: str
    paragraphs: Sequence[str] = ()
    figures: Sequence[Figure] = ()
    tables: Sequence[Table] = ()
    literal: str = ""
    diagram: str = ""
    folded: bool = False


def write(
    path: Path, title: str, sections: Sequence[Section], *, introduction: Sequence[str] = (), head: str = ""
) -> Path:
    """Write the page.

    Parameters
    ----------
    path : Path
    title : str
    sections : sequence of Section
        Listed with links at the top.
    introduction : sequence of str
        Paragraphs before the list.
    head : str
        What diagrams need: HTML.

    Returns
    -------
    path : Path
    """
    links = "".join(f'<li><a href="#s{n}">{escape(s.heading)}</a></li>' for n, s in enumerate(sections))
    body = "".join(_section(n, section) for n, section in enumerate(sections))
    path.write_text(
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<link rel="icon" href="data:,"><title>{escape(title)}</title><style>{STYLE}</style>'
        f"<script>{SORTING}</script>{head}</head>\n"
        f"<body><h1>{escape(title)}</h1>{_paragraphs(introduction)}<nav><ol>{links}</ol></nav>\n{body}</body></html>\n",
        encoding="utf-8",
    )
    return path


def _section(number: int, section: Section) -> str:
    pictures = "".join(
        f'<p><img alt="{escape(section.heading)}" src="data:image/png;base64,{_png(figure)}"></p>'
        for figure in section.figures
    )
    literal = f"<pre>{escape(section.literal)}</pre>" if section.literal else ""
    tables = "".join(_table(table) for table in section.tables)
    if section.folded and tables:
        tables = f"<details><summary>All measurements</summary>{tables}{literal}</details>"
        literal = ""
    return (
        f'<section><h2 id="s{number}">{escape(section.heading)}</h2>'
        f"{_paragraphs(section.paragraphs)}{section.diagram}{pictures}{tables}{literal}</section>\n"
    )


def _paragraphs(paragraphs: Sequence[str]) -> str:
    return "".join(f"<p>{escape(paragraph)}</p>" for paragraph in paragraphs)


def _table(table: Table) -> str:
    def row(cells: Sequence[str], tag: str, mark: str = "") -> str:
        shown = "".join(f"<{tag}{_kind(n, cell)}>{escape(cell)}</{tag}>" for n, cell in enumerate(cells))
        return f'<tr class="{mark}">{shown}</tr>' if mark else f"<tr>{shown}</tr>"

    def _kind(column: int, cell: str) -> str:
        kinds = ["text"] * (column in table.words) + ["long"] * (len(cell) > LONG)
        return f' class="{" ".join(kinds)}"' if kinds else ""

    marks = table.marks or [""] * len(table.rows)
    rows = "".join(row(cells, "td", mark) for cells, mark in zip(table.rows, marks, strict=True))
    return f'<div class="wide"><table><thead>{row(table.headings, "th")}</thead><tbody>{rows}</tbody></table></div>'


def _png(figure: Figure) -> str:
    page = BytesIO()
    figure.savefig(page, format="png", dpi=110, bbox_inches="tight")
    return base64.b64encode(page.getvalue()).decode("ascii")
