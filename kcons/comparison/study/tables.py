"""A table, and what writes it: to the terminal, as plain text, in Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import TYPE_CHECKING, Self

from rich import box
from rich.text import Text

if TYPE_CHECKING:
    from rich.table import Table as RichTable


class Marked(str):
    """A cell that the terminal shows in a style of its own, such as 'bold red'."""

    style: str

    def __new__(cls, text: str, style: str) -> Self:
        made = super().__new__(cls, text)
        made.style = style
        return made


@dataclass(frozen=True)
class Table:
    """A table of text; `rich` prints it as it is.

    Attributes
    ----------
    headings : sequence of str
    rows : sequence of sequence of str
        Cells, as many as headings.
    words : sequence of int
        Columns that are words, set to the left; all others are numbers.
    marks : sequence of str
        'good', 'bad' or '' for each row; empty for none.
    title : str
    grouped : bool
        Rows that begin with the same cell belong together: in the terminal it is shown once.
    """

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    words: Sequence[int] = (0,)
    marks: Sequence[str] = ()
    title: str = ""
    grouped: bool = False

    def of(self, columns: Iterable[int]) -> Table:
        """Some of the columns."""
        chosen = list(columns)
        return replace(
            self,
            headings=[self.headings[k] for k in chosen],
            rows=[[row[k] for k in chosen] for row in self.rows],
            words=[new for new, old in enumerate(chosen) if old in self.words],
        )

    def __rich__(self) -> RichTable:
        return terminal(self)


def terminal(table: Table) -> RichTable:
    """The table of the terminal; in tables with groups, words give way before any digit or unit does."""
    from rich.table import Table as RichTable

    if table.grouped:
        made = RichTable(title=table.title or None, title_style="bold", box=box.SIMPLE_HEAD, padding=(0, 1))
    else:
        made = RichTable(title=table.title or None)
    for k, heading in enumerate(table.headings):
        made.add_column(
            heading, justify="left" if k in table.words else "right", no_wrap=table.grouped and k not in table.words
        )
    for number, (_, group) in enumerate(groupby(table.rows, key=lambda row: row[0] if table.grouped else None)):
        if number:
            made.add_section()
        for k, row in enumerate(group):
            shown = [Text(cell, style=cell.style) if isinstance(cell, Marked) else cell for cell in row]
            made.add_row(*(["", *shown[1:]] if table.grouped and k else shown))
    return made


def plain_text(table: Table) -> str:
    """The table in columns of characters."""
    rows = [list(table.headings), *[list(row) for row in table.rows]]
    widths = [max(len(row[k]) for row in rows) for k in range(len(table.headings))]

    def line(cells: Sequence[str]) -> str:
        padded = (
            cell.ljust(width) if k in table.words else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(cells, widths, strict=True))
        )
        return "  ".join(padded).rstrip()

    return "\n".join(line(row) for row in rows)


def markdown(table: Table) -> str:
    """The table in Markdown, for the documentation."""
    ruler = ["---" if k in table.words else "---:" for k in range(len(table.headings))]
    rows = [[cell.replace("|", r"\|") for cell in row] for row in table.rows]
    head = "".join(f"| {heading} " if heading else "| " for heading in table.headings)
    return "\n".join([f"{head}|", *(f"| {' | '.join(cells)} |" for cells in (ruler, *rows))])


# -- what cells say ---------------------------------------------------------------------------------


def numbered(notes: Iterable[str]) -> dict[str, int]:
    """Notes in the order of their first appearance, numbered from 1."""
    return {note: k for k, note in enumerate(dict.fromkeys(note for note in notes if note), 1)}


def footnotes(notes: Mapping[str, int]) -> list[str]:
    """Below a table: each note after its number."""
    return [f"[{number}] {note}" for note, number in notes.items()]


def verdict(status: str, word: str, note: int | None) -> Marked:
    """Why there is no number: in a word, and which note tells more."""
    return Marked(f"{word} [{note}]" if note else word, "red" if status == "failed" else "yellow")
