"""Cells that run in a process of their own."""

from __future__ import annotations

from kcons.comparison.hard_cases.worker import Worker


def test_a_program_that_hangs_is_given_up():
    with Worker() as worker:
        cell = worker.run("H06", "kcons in ASE", False, 0.01)
        assert (cell.verdict, cell.met) == ("crash/NaN", False)
        assert "no answer within 0.01 s" in cell.text
        assert worker.run("H02", "kcons", True, 60.0).verdict == "refused"
