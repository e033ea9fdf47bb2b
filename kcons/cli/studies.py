"""The commands `kcons hardcases` and `kcons stability`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from kcons.cli.terminal import console, names, say_written, show


def add(commands: Any) -> None:
    """Their options."""
    hard = commands.add_parser(
        "hardcases",
        help="what kcons, ASE and OpenMM do where constraints are difficult",
        description="Run the hard cases side by side; table, picture, page and JSON of the verdicts.",
    )
    hard.add_argument("--quick", action="store_true", help="shorter runs, some minutes")
    hard.add_argument("--out", type=Path, default=Path("hardcases"), help="folder (default ./hardcases); goes on there")
    hard.add_argument("--only", type=names, help="numbers of cases, comma separated, such as H14,H16")
    hard.add_argument("--list", action="store_true", help="list the cases, and leave")
    hard.set_defaults(run=_hard_cases)

    stability = commands.add_parser(
        "stability",
        help="largest stable steps, drift of the energy, reversibility, random molecules",
        description="How far each method can be pushed on small test systems, and what it does beyond.",
    )
    stability.add_argument("--quick", action="store_true", help="shorter runs, some minutes")
    stability.add_argument("--out", type=Path, default=Path("stability"), help="folder (default ./stability)")
    stability.add_argument("--only", type=names, help="of steps, drift, reversal, fuzz; comma separated")
    stability.add_argument("--scenes", type=names, help="of water, chain, dumbbells, rotor, pendulum, butane")
    stability.add_argument(
        "--into", type=Path, nargs="+", metavar="FILE", help="add to these results (JSON) and this page (Markdown)"
    )
    stability.set_defaults(run=_stability)


def _hard_cases(chosen: argparse.Namespace) -> int:
    from kcons.cli.progress import Bars
    from kcons.comparison import hard_cases
    from kcons.comparison.hard_cases import report

    cases = hard_cases.chosen(chosen.only)
    if chosen.list:
        for case in cases.values():
            print(f"{case.number}  {case.title}: {case.limit}")
        return 0
    chosen.out.mkdir(parents=True, exist_ok=True)
    kept = chosen.out / "hard_cases.json"
    with Bars() as watcher:
        result = hard_cases.run(only=chosen.only, quick=chosen.quick, kept=kept, watcher=watcher)
    show(report.table(result), report.summary(result), console())
    say_written([kept, *report.write(result, chosen.out)])
    return 0


def _stability(chosen: argparse.Namespace) -> int:
    from kcons.cli.progress import Bars
    from kcons.comparison import stability
    from kcons.comparison.stability import report

    chosen.out.mkdir(parents=True, exist_ok=True)
    kept = chosen.out / "stability.json"
    with Bars() as watcher:
        found = stability.run(
            only=chosen.only, test_systems=chosen.scenes, quick=chosen.quick, kept=kept, watcher=watcher
        )
    result = stability.digest(found)
    if chosen.into:
        before, result = stability.put_into(result, chosen.into[0])
        for page in chosen.into[1:]:
            report.renew(page, before, result)
        say_written(chosen.into)
    print(report.text(result))
    say_written([kept, *report.write(result, chosen.out)])
    return 0
