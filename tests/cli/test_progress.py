"""Progress on the terminal, and a line for each piece where there is none."""

import pytest

from kcons.cli.progress import Bars


def test_a_line_for_each_piece_where_there_is_no_terminal(capsys):
    with Bars() as bars:
        bars.overall("water", 0.0, 100.0)
        with bars.piece("reference solution", 10.0):
            bars.advance(5.0)
        bars.overall("chain", 70.0, 100.0)
        bars.overall("page", 100.0, 100.0)
    shown = capsys.readouterr()
    assert shown.out == ""
    lines = [line for line in shown.err.splitlines() if line.strip()]
    assert lines == [
        "water; about 100 s left",
        "reference solution",
        "chain; about 30.0 s left",
        "page; the last of it",
    ]


def test_bars_are_gone_however_a_piece_ends():
    bars = Bars()
    with pytest.raises(ZeroDivisionError), bars, bars.piece("a piece", 2.0):
        bars.advance(1.0)
        assert [(task.description, task.completed, task.total) for task in bars._bars.tasks] == [("a piece", 1.0, 2.0)]
        raise ZeroDivisionError
    assert bars._bars.tasks == [] and not bars._bars.live.is_started
    bars.advance(1.0)  # nothing is in hand
    bars.end()


def test_the_whole_has_one_bar():
    with Bars() as bars:
        bars.overall("a", 0.0, 8.0)
        bars.overall("b", 6.0, 8.0)
        (task,) = bars._bars.tasks
        assert (task.completed, task.total, task.description) == (6.0, 8.0, "b; about 2.00 s left")
