"""What all commands write: any characters into any encoding, into pipes that nobody reads; and their progress."""

import io
import os
import subprocess
import sys

import pytest
from shell_commands import shell

from kcons.cli.main import main
from kcons.comparison.progress import Watcher

C_LOCALE = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONIOENCODING": "ascii"}
#: What the commands below import.
IMPORTED = ("kcons.cli.main", "kcons.comparison.test_systems", "kcons.comparison.methods", "rich.table")


def said(line, where="", **variables):
    """Status of `kcons line`, and what came out."""
    done = shell(*line.split(), where=where, modules=IMPORTED, **variables)
    return done.status, done.out, done.errors.encode()


def test_in_a_c_locale_as_in_a_process_of_its_own():
    """Where nothing is imported when its streams are made."""
    command = [sys.executable, "-m", "kcons", "compare", "--list"]
    done = subprocess.run(command, capture_output=True, env=os.environ | C_LOCALE)
    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout.decode("ascii") and (0, done.stdout, b"") == said("compare --list", **C_LOCALE)
    status, out, errors = said("plan nothing", **C_LOCALE)
    assert (status, out) == (2, b"") and errors.decode("ascii").startswith("kcons: ")


@pytest.mark.parametrize(("words", "buffered"), [("--help", ""), ("plan chain --size 3", "1")])
def test_commands_into_a_pipe_that_nobody_reads(words, buffered):
    said(words)  # what has to be compiled is compiled now: that is announced on the stream of errors
    status, out, errors = said(words, "| head -1", PYTHONUNBUFFERED=buffered)
    assert status == 0 and errors == b"" and out.count(b"\n") == 1


def test_a_comparison_is_written_though_nobody_reads_it(tmp_path):
    out = tmp_path / "out"
    status, _, _ = said(f"compare chain --size 3 --methods rattle --dt 10 --out {out}", "| true", **C_LOCALE)
    assert status == 0 and (out / "compare.csv").stat().st_size > 100 and (out / "compare.txt").is_file()


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
@pytest.mark.parametrize("buffered", ["", "1"])
def test_a_full_device_is_an_error(buffered):
    status, _, errors = said("compare --list", "/dev/full", PYTHONUNBUFFERED=buffered)
    assert status == 2 and b"No space left" in errors and b"Traceback" not in errors and b"Exception" not in errors


def test_streams_are_left_as_they_were(monkeypatch):
    mine = io.StringIO()
    monkeypatch.setattr(sys, "stdout", mine)
    errors = sys.stderr.errors
    assert main(["--version"]) == 0 and sys.stdout is mine and sys.stderr.errors == errors
    assert mine.getvalue().startswith("kcons ")


def test_a_line_for_each_piece_where_there_is_no_terminal(capsys):
    with Watcher(shown=True) as bars:
        with bars.piece("reference solution", 10.0):
            bars.advance(5.0)
        with bars.piece("water", 1.0):
            pass
    shown = capsys.readouterr()
    lines = [line for line in shown.err.splitlines() if line.strip()]
    assert shown.out == "" and lines == ["reference solution", "water"]


def test_bars_are_gone_however_a_piece_ends():
    bars = Watcher(shown=True)
    with pytest.raises(ZeroDivisionError), bars, bars.piece("a piece", 2.0):
        bars.advance(1.0)
        assert [(task.description, task.completed, task.total) for task in bars._bars.tasks] == [("a piece", 1.0, 2.0)]
        raise ZeroDivisionError
    assert bars._bars.tasks == [] and not bars._bars.live.is_started
    bars.advance(1.0)  # nothing is in hand
