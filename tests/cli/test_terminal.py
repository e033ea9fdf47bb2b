"""What all commands write: any characters into any encoding, and into pipes that nobody reads."""

import io
import os
import subprocess
import sys

import pytest
from shell_commands import shell

from kcons.cli.terminal import patient_streams

C_LOCALE = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONIOENCODING": "ascii"}


#: What the commands below import.
IMPORTED = ("kcons.cli.main", "kcons.comparison.test_systems", "kcons.comparison.methods", "rich.table")


def said(line, where="", **variables):
    """Status of `kcons line`, and what came out."""
    done = shell(*line.split(), where=where, modules=IMPORTED, **variables)
    return done.status, done.out, done.errors.encode()


@pytest.mark.parametrize("words", ["--help", "check --help", "compare --list", "plan chain --size 3", "plan nothing"])
def test_commands_in_a_c_locale(words):
    status, out, errors = said(words, **C_LOCALE)
    assert status == (2 if words == "plan nothing" else 0) and b"Traceback" not in errors
    (out + errors).decode("ascii")
    assert out or status


def test_in_a_process_of_its_own():
    """Where nothing is imported when its streams are made."""
    command = [sys.executable, "-m", "kcons", "compare", "--list"]
    done = subprocess.run(command, capture_output=True, env=os.environ | C_LOCALE)
    assert (done.returncode, done.stdout, done.stderr) == said("compare --list", **C_LOCALE)


@pytest.mark.parametrize("buffered", ["", "1"])
@pytest.mark.parametrize("words", ["--help", "compare --list", "plan chain --size 3"])
def test_commands_into_a_pipe_that_nobody_reads(words, buffered):
    said(words)  # what has to be compiled is compiled now: that is announced on the stream of errors
    status, out, errors = said(words, "| head -1", PYTHONUNBUFFERED=buffered)
    assert status == 0 and errors == b"" and out.count(b"\n") == 1


def test_a_comparison_is_written_though_nobody_reads_it(tmp_path):
    out = tmp_path / "out"
    status, _, _ = said(f"compare chain --size 3 --methods rattle --dt 10 --out {out}", "| true", **C_LOCALE)
    assert status == 0 and (out / "compare.csv").stat().st_size > 100 and (out / "compare.txt").is_file()


def test_characters_are_replaced_by_their_like(tmp_path, monkeypatch):
    path = tmp_path / "page"
    with path.open("w", encoding="ascii") as page:
        monkeypatch.setattr(sys, "stdout", page)
        with patient_streams():
            print("1.5 Å ± 0.1, OW–HW1, x², 3 × √2 ≤ … \udcff 水 ━━")
        assert sys.stdout is page
    assert path.read_text() == "1.5 A +/- 0.1, OW-HW1, x2, 3 x sqrt2 <= ... ? ? --\n"


def test_streams_of_other_programs_are_left_alone(monkeypatch):
    mine = io.StringIO()
    monkeypatch.setattr(sys, "stdout", mine)
    with patient_streams():
        assert sys.stdout is mine
        print("Å")
    assert mine.getvalue() == "Å\n"


def test_a_full_device_is_an_error():
    if not os.path.exists("/dev/full"):
        pytest.skip("needs /dev/full")
    for buffered in ("", "1"):
        status, _, errors = said("compare --list", "/dev/full", PYTHONUNBUFFERED=buffered)
        assert status == 2 and b"No space left" in errors and b"Traceback" not in errors and b"Exception" not in errors
