"""The engine in random periodic cells, judged by dense mechanics on whole molecules.

``python tests/contracts/random_cells.py --cases 10000 --out docs/results/random_cells.json`` runs cases 0 to 9999. A
case is made from its number alone: ``judge(4711)`` repeats it.

Outcomes, from best to worst:

right      agrees with the oracle as far as rounding and the conditioning of the case allow.
refused    a typed error for a reason that holds, with its remedy; nothing was changed.
unfounded  a typed error although there is a solution, no gradient of a row turns by a right angle on the way there, and
           no link is near half the cell, there or where the displacement ends.
silent     a wrong result, NaN, an untyped error, changed arguments, more than 5 s, or another remedy for a link that
           nears half the cell.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import platform
import re
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from cell_judge import ANOTHER, OUTCOMES, Case, judge


def summary(cases: list[Case]) -> dict[str, Any]:
    """Counts by outcome, kind of molecule, family of rows and operation; every fault by its class."""

    def table(keys: Callable[[Case], list[str]]) -> dict[str, dict[str, int]]:
        counts: dict[str, Counter] = {}
        for case in cases:
            for key in sorted(set(keys(case))):
                counts.setdefault(key, Counter())[case.outcome] += 1
        return {key: {o: counts[key][o] for o in OUTCOMES} for key in sorted(counts)}

    operations: dict[str, Counter] = {}
    faults: dict[str, dict[str, Any]] = {}
    refusals: Counter = Counter()
    for case in cases:
        for verdict in case.verdicts:
            operations.setdefault(verdict.operation, Counter())[verdict.outcome] += 1
            words = re.sub(r"[-+]?\d[\d.e+-]*", "#", verdict.why)[:100]
            if verdict.outcome == "refused":
                refusals[words] += 1
            elif verdict.outcome != "right":
                one = faults.setdefault(
                    f"{verdict.outcome}: {verdict.operation}: {words}", {"count": 0, "seeds": [], "kinds": {}}
                )
                one["count"] += 1
                one["seeds"] = (one["seeds"] + [case.seed])[:5]
                for kind in set(case.kinds):
                    one["kinds"][kind] = one["kinds"].get(kind, 0) + 1
    allowed = [v.allowed for c in cases for v in c.verdicts if v.outcome == "right"]
    return {
        "cases": len(cases),
        "first": cases[0].seed if cases else 0,
        "outcomes": {o: sum(c.outcome == o for c in cases) for o in OUTCOMES},
        "kinds": table(lambda c: c.kinds),
        "families": table(lambda c: c.families),
        "features": table(lambda c: c.features),
        "steppers": table(lambda c: [c.stepper]),
        "operations": {k: {o: c[o] for o in OUTCOMES} for k, c in sorted(operations.items())},
        "refusals": dict(refusals.most_common(30)),
        "allowed": {"median": float(np.median(allowed)), "largest": float(max(allowed))} if allowed else {},
        "other solutions": sum(any(v.why == ANOTHER for v in c.verdicts) for c in cases),
        "faults": dict(sorted(faults.items(), key=lambda kv: -kv[1]["count"])),
    }


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=10000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--open", action="store_true", help="the same molecules without a cell")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--workers", type=int, default=1, help="processes that work side by side")
    parser.add_argument("--show", action="store_true", help="print the verdicts of each case that is not right")
    chosen = parser.parse_args(arguments)
    start = time.perf_counter()
    cases: list[Case] = []
    with multiprocessing.get_context("spawn").Pool(chosen.workers) if chosen.workers > 1 else nullcontext() as pool:
        seeds = range(chosen.first, chosen.first + chosen.cases)
        one = partial(judge, periodic=not chosen.open)
        for case in map(one, seeds) if pool is None else pool.imap(one, seeds, chunksize=20):
            cases.append(case)
            if chosen.show and case.outcome in OUTCOMES[2:]:
                print(json.dumps(asdict(case)))
            if len(cases) % 500 == 0:
                print(f"{len(cases)} cases, {time.perf_counter() - start:.0f} s", file=sys.stderr)
    result = summary(cases)
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    result |= {
        "commit": commit.stdout.strip(),
        "seconds": round(time.perf_counter() - start, 1),
        "slowest": round(max(c.seconds for c in cases), 2),
        "machine": platform.machine(),
    }
    text = json.dumps(result, indent=1)
    if chosen.out:
        chosen.out.write_text(text + "\n")
        print(json.dumps({k: result[k] for k in ("cases", "outcomes", "seconds", "commit")}))
    else:
        print(text)
    return 1 if result["outcomes"]["silent"] or result["outcomes"]["unfounded"] else 0


if __name__ == "__main__":
    sys.exit(main())
