"""Hard cases side by side: kcons on arrays, in ASE and in OpenMM, and ASE and OpenMM by themselves.

    python examples/studies/hard_cases.py --list                   numbers, titles and what must be true
    python examples/studies/hard_cases.py --quick --out DIR        some minutes; --only H14,X06 for some of them
    python examples/studies/hard_cases.py --out DIR                all, ten minutes

DIR/hard_cases.csv has a row a case and program. The exit status is 1, with a line for each, where kcons is silently
wrong, ends in NaN or gives no answer. The cases are functions of a few lines in tests/hard_cases.
"""

from __future__ import annotations

import multiprocessing
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd

HERE = Path(__file__).resolve().parent
# The package of the cases has the name of this file: it is found first.
sys.path[:0] = [str(HERE.parents[1] / "tests"), str(HERE)]

import harness  # noqa: E402
from hard_cases.case import OURS, SYSTEMS, Case, Cell, all_cases, run_numbered  # noqa: E402

#: Seconds after which a program that has not answered is given up: quick and full.
LIMITS = (60.0, 3600.0)
SILENT = ("silently wrong", "crash/NaN")


class Child:
    """A process that judges one cell after another, and is replaced where it hangs or dies."""

    def __init__(self) -> None:
        self.start()

    def start(self) -> None:
        self.pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"))

    def cell(self, case: Case, program: str, quick: bool) -> Cell:
        try:
            return self.pool.submit(run_numbered, case.number, program, quick).result(LIMITS[0 if quick else 1])
        except TimeoutError:
            words = f"no answer within {LIMITS[0 if quick else 1]:g} s"
        except BrokenProcessPool:
            words = "the process died"
        for process in list(self.pool._processes.values()):
            process.kill()
        self.pool.shutdown()
        self.start()
        return Cell("crash/NaN", False, words)


def rows(child: Child, case: Case, program: str, quick: bool) -> Iterator[dict[str, Any]]:
    """The one row of a cell: its verdict, and the number that decided."""
    begun = time.perf_counter()
    cell = child.cell(case, program, quick)
    yield {
        "case": case.number,
        "title": case.title,
        "must be true": case.limit,
        "program": program,
        "verdict": cell.verdict,
        "as asked": cell.met,
        "check": cell.check and cell.check.name,
        "value": cell.check and cell.check.value,
        "limit": cell.check and cell.check.limit,
        "words": cell.text,
        "seconds": round(time.perf_counter() - begun, 3),
    }


def silent(table: pd.DataFrame) -> list[str]:
    """A line for each cell of kcons that is silently wrong, NaN or without an answer."""
    bad = table[table.program.isin(OURS) & table.verdict.isin(SILENT)]
    return [f"{row.case}, {row.program}: {row.verdict}: {row.words}" for row in bad.itertuples()]


def tables(table: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Verdicts: cases by programs."""
    told = table.assign(words=[words_of(row) for row in table.to_dict("records")])
    wide = told.pivot(index=["case", "title"], columns="program", values="words").reset_index()
    return {"verdicts": wide[["case", "title", *(name for name in SYSTEMS if name in wide)]]}


def words_of(row: Mapping[str, Any]) -> str:
    """A verdict, with the number or the error that decides it."""
    if row["verdict"] == "cannot express":
        return "–"
    if row["verdict"] == "refused":
        kind = str(row["words"]).split(":", 1)[0]
        return f"refused ({kind})" if kind.isidentifier() else "refused (warned)"
    told = row["verdict"] if row["verdict"] == "right" else f"**{row['verdict']}**"
    return told if pd.isna(row["check"]) else f"{told}: {row['check']} {row['value']:.2g}"


def main(arguments: list[str] | None = None) -> int:
    parser = harness.options(__doc__, "hard-cases")
    parser.add_argument("--only", type=lambda words: words.split(","), help="numbers of cases, comma separated")
    parser.add_argument("--list", action="store_true", help="list the cases, and leave")
    chosen = parser.parse_args(arguments)
    cases = {name: case for name, case in all_cases().items() if not chosen.only or name in chosen.only}
    if not cases or len(cases) < len(chosen.only or ()):
        parser.error(f"there are cases {', '.join(all_cases())}")
    if chosen.list:
        print("\n".join(f"{case.number}  {case.title}: {case.limit}" for case in cases.values()))
        return 0
    child = Child()
    pieces = {
        f"{name}, {program}": partial(rows, child, case, program, chosen.quick)
        for name, case in cases.items()
        for program in SYSTEMS
    }
    table = harness.run(chosen.out / "hard_cases.csv", pieces, quick=chosen.quick)
    for program, part in table.groupby("program", sort=False):
        counts = ", ".join(f"{count} {verdict}" for verdict, count in Counter(part.verdict).items())
        print(f"{program}: {part['as asked'].sum()} of {len(part)} as asked for ({counts})")
    faults = silent(table)
    print("\n".join(faults))
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
