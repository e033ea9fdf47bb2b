"""Cells of the table run in a child process: where one hangs or dies, the study continues."""

from __future__ import annotations

import multiprocessing
import os
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from kcons.comparison.hard_cases.case import Case, Cell, all_cases, judge
from kcons.comparison.hard_cases.programs import PROGRAMS, quiet
from kcons.comparison.study.machine import kernels_cached


def run_cell(case: Case, program: str, quick: bool) -> Cell:
    """The verdict on one program in one case, in this process."""
    if program in case.cannot:
        return Cell("cannot express", False, case.cannot[program])
    warned = ""
    try:
        found, warned = quiet(lambda: case.function(PROGRAMS[program](), quick))
    except Exception as error:
        found = error
    return judge(case, found, warned, program)


#: Wall time, in parts of the limit, after which even an idle process is given up.
PATIENCE = 10.0
#: What the child finds as 1 in its environment.
THREADS = "OPENMM_CPU_THREADS"


class Worker:
    """Runs cells one after another in a child process, which is replaced when it hangs or dies."""

    def __init__(self) -> None:
        self._process: Any = None
        self._pipe: Connection | None = None

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *_: object) -> None:
        self._stop()

    def run(self, number: str, program: str, quick: bool, limit: float) -> Cell:
        """The verdict; 'crash/NaN' where the program dies or gives no answer within `limit` seconds.

        Where the system tells, the seconds are those of the processor, so that a busy machine makes no difference.
        """
        if self._process is None:
            self._start()
        assert self._pipe is not None
        start = time.perf_counter()
        self._pipe.send((number, program, quick))
        text = f"no answer within {limit:g} s"
        try:
            if self._answers(start, limit):
                return _timed(self._pipe.recv(), time.perf_counter() - start)
        except EOFError:
            self._process.join()
            text = f"the process died (exit status {self._process.exitcode})"
        self._stop()
        return Cell("crash/NaN", False, text, seconds=round(time.perf_counter() - start, 3))

    def _answers(self, start: float, limit: float) -> bool:
        """Whether there is an answer before the time is up."""
        assert self._pipe is not None
        spent = _processor_seconds(self._process.pid)
        while not self._pipe.poll(min(0.5, limit)):
            wall = time.perf_counter() - start
            now = _processor_seconds(self._process.pid)
            if wall > limit and (now is None or spent is None or now - spent > limit or wall > PATIENCE * limit):
                return False
        return True

    def _start(self) -> None:
        before = os.environ.get(THREADS)
        os.environ[THREADS] = "1"
        try:
            context = multiprocessing.get_context("spawn")
            self._pipe, there = context.Pipe()
            self._process = context.Process(target=_serve, args=(there,), daemon=True)
            self._process.start()
            there.close()
        finally:
            if before is None:
                del os.environ[THREADS]
            else:
                os.environ[THREADS] = before
        # Importing the programs is no part of any case.
        self._pipe.recv()

    def _stop(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.join()
            assert self._pipe is not None
            self._pipe.close()
        self._process = self._pipe = None


def _processor_seconds(pid: int) -> float | None:
    """Of another process, on Linux."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError, IndexError):
        return None


def _timed(cell: Cell, seconds: float) -> Cell:
    return Cell(cell.verdict, cell.met, cell.text, cell.checks, round(seconds, 3))


def _serve(pipe: Connection) -> None:
    """The child: answers until the pipe is closed."""
    cases = all_cases()
    # Kernels that are compiled for the first time are no part of any case either.
    if not kernels_cached():
        for number in ("H01", "H06", "H08", "H26"):
            run_cell(cases[number], "kcons", True)
    pipe.send("ready")
    while True:
        try:
            number, program, quick = pipe.recv()
        except (EOFError, KeyboardInterrupt):
            return
        cell = run_cell(cases[number], program, quick)
        try:
            pipe.send(cell)
        except BrokenPipeError:  # nobody waits any more
            return
