"""What all commands write: any characters into any encoding, into pipes that nobody reads; and their progress."""

import io
import os
import subprocess
import sys

import pytest

from kcons.cli.main import main
from kcons.comparison import progress
from kcons.comparison.progress import Watcher

C_LOCALE = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONIOENCODING": "ascii"}


def said(line, where="", **variables):
    """Status of `kcons line` in a shell, what came out at the end of its pipe, and of errors."""
    command = f"'{sys.executable}' -m kcons {line} {where}; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, env=os.environ | variables)
    return done.returncode, done.stdout, done.stderr


def test_into_a_pipe_that_nobody_reads(tmp_path):
    main(["plan", "chain", "--size", "3"])  # compiles what has to be: that is announced on the stream of errors
    status, out, errors = said("plan chain --size 3", "| head -1", PYTHONUNBUFFERED="1")
    assert status == 0 and errors == b"" and out.count(b"\n") == 1
    # A comparison is written though nobody reads it.
    out = tmp_path / "out"
    status, _, _ = said(f"compare chain --size 3 --methods rattle --dt 10 --out {out}", "| true", **C_LOCALE)
    assert status == 0 and (out / "compare.csv").stat().st_size > 100 and (out / "compare.txt").is_file()


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
def test_a_full_device_is_an_error():
    status, _, errors = said("compare --list", "> /dev/full")
    assert status == 2 and b"No space left" in errors and b"Traceback" not in errors and b"Exception" not in errors


def test_streams_are_left_as_they_were(monkeypatch):
    mine = io.StringIO()
    monkeypatch.setattr(sys, "stdout", mine)
    errors = sys.stderr.errors
    assert main([]) == 0 and sys.stdout is mine and sys.stderr.errors == errors
    assert mine.getvalue().startswith("usage: kcons ")


def test_a_line_for_each_piece_and_one_a_minute_where_there_is_no_terminal(capsys, monkeypatch):
    clock = iter([0.0, 59.0, 61.0, 61.0, 62.0, 200.0])
    monkeypatch.setattr(progress, "monotonic", lambda: next(clock))
    with Watcher(shown=True) as bars:
        with bars.piece("reference solution", 10.0):
            for done in (1.0, 5.0, 6.0):
                bars.advance(done)
        with bars.piece("water", 1.0):
            pass
    shown = capsys.readouterr()
    lines = [line for line in shown.err.splitlines() if line.strip()]
    assert shown.out == "" and lines == ["reference solution", "reference solution: 50 %", "water"]


def test_bars_are_gone_however_a_piece_ends():
    bars = Watcher(shown=True)
    with pytest.raises(ZeroDivisionError), bars, bars.piece("a piece", 2.0):
        bars.advance(1.0)
        assert [(task.description, task.completed, task.total) for task in bars._bars.tasks] == [("a piece", 1.0, 2.0)]
        raise ZeroDivisionError
    assert bars._bars.tasks == [] and not bars._bars.live.is_started
    bars.advance(1.0)  # nothing is in hand
