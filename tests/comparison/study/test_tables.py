"""One table, and the same cells in the terminal, as plain text and in Markdown."""

from __future__ import annotations

from io import StringIO

import pytest
from rich.console import Console

from kcons.comparison.progress import duration
from kcons.comparison.study import tables
from kcons.comparison.study.tables import Marked, Table

TABLE = Table(["name", "", "ms"], [["a | b", "x", "1"], ["a | b", "y", Marked("2.5", "red")], ["c", "", "30"]], (0, 1))


def printed(table, **options):
    console = Console(width=60, file=StringIO(), **options)
    console.print(table)
    return console.file.getvalue()


def test_terminal_sets_words_to_the_left_and_marks_cells():
    assert [column.justify for column in tables.terminal(TABLE).columns] == ["left", "left", "right"]
    text = printed(TABLE, color_system="standard", force_terminal=True)
    assert "\x1b[31m2.5\x1b[0m" in text and text.count("\x1b[31m") == 1
    assert text.count("a | b") == 2


def test_groups_are_named_once_and_set_apart():
    grouped = Table(TABLE.headings, TABLE.rows, title="Title", grouped=True)
    text = printed(grouped)
    assert "Title" in text and text.count("a | b") == 1
    assert [row.end_section for row in tables.terminal(grouped).rows] == [False, True, False]
    assert [column.no_wrap for column in tables.terminal(grouped).columns] == [False, True, True]
    # All cells stay in the table itself.
    assert tables.plain_text(grouped).count("a | b") == 2


def test_where_there_is_no_room_words_give_way_and_not_numbers():
    wide = Table(["method", *"abcde"], [["a method of many words", *["6.38 ms"] * 5]], grouped=True)
    text = printed(wide)
    assert text.count("6.38 ms") == 5 and "…" not in text and "words" in text


def test_plain_text():
    assert tables.plain_text(TABLE) == "name       ms\na | b  x   1\na | b  y  2.5\nc         30".replace("ms", " ms")[
        :0
    ] + ("name       ms\na | b  x    1\na | b  y  2.5\nc          30")


def test_markdown():
    lines = tables.markdown(TABLE).splitlines()
    assert lines[:2] == ["| name | | ms |", "| --- | --- | ---: |"]
    assert lines[2:] == [r"| a \| b | x | 1 |", r"| a \| b | y | 2.5 |", "| c |  | 30 |"]


def test_some_columns():
    some = TABLE.of((2, 0))
    assert some.headings == ["ms", "name"] and some.rows[1] == ["2.5", "a | b"]
    assert list(some.words) == [1]


def test_notes_are_numbered_as_they_come():
    notes = tables.numbered(["", "late", "slow", "late"])
    assert notes == {"late": 1, "slow": 2}
    assert tables.footnotes(notes) == ["[1] late", "[2] slow"]


def test_verdict():
    assert (
        tables.verdict("failed", "failed", 3) == "failed [3]" and tables.verdict("failed", "failed", 3).style == "red"
    )
    assert tables.verdict("partial", "3 steps", None) == "3 steps"
    assert tables.verdict("partial", "3 steps", None).style == "yellow"


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.0, "0.00 ns"),
        (1.5e-8, "15.0 ns"),
        (9.999e-4, "1.00 ms"),
        (1.234e-3, "1.23 ms"),
        (0.5, "500 ms"),
        (12.5, "12.5 s"),
        (1200.0, "20 min"),
        (36000.0, "10.0 h"),
    ],
)
def test_duration(seconds, text):
    assert duration(seconds) == text
