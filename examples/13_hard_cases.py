"""Hard cases by hand: benzene by all 66 distances, and a case of your own, through kcons, ASE and OpenMM.

python examples/13_hard_cases.py             a few cases, seconds
kcons hardcases --quick                      all of them, some minutes
python examples/13_hard_cases.py --table F   the table of a result of kcons hardcases, for the documentation
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from kcons.comparison.hard_cases import SYSTEMS, Case, Problem, all_cases, case, load, outcome, report, run_cell


@case("Y01", "Cube by all 28 distances, tumbling", "residual 1e-10, kinetic energy 1e-3")
def cube(program, quick):
    """A case is a function: set a problem up, let the program run it, return numbers with their limits."""
    x = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)], dtype=float)
    pairs = [(i, j) for i in range(8) for j in range(i + 1, 8)]
    v = np.cross([0.3, 0.5, -0.2], x - x.mean(axis=0))
    problem = Problem(x, np.full(8, 12.0), pairs, velocities=v)
    end = program.run(problem, dt=0.01, steps=100)
    return outcome(
        ("residual", problem.residual(end.x), 1e-10),
        ("kinetic energy", abs(problem.kinetic(end.v) / problem.kinetic(v) - 1), 1e-3),
    )


def show(chosen: Case) -> None:
    print(f"\n{chosen.number}  {chosen.title}: {chosen.limit}")
    for program in SYSTEMS:
        cell = run_cell(chosen, program, quick=True)
        print(f"    {program:16} {cell.verdict:15} {cell.text[:90]}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--table", type=Path, help="a hard_cases.json, to print its table and leave")
    parser.add_argument("cases", nargs="*", default=["X06", "H02", "Y01"], help="numbers of cases")
    chosen = parser.parse_args()
    if chosen.table:
        print(report.markdown(load(chosen.table)))
        return
    known = all_cases()
    for number in chosen.cases:
        show(known[number])


if __name__ == "__main__":
    main()
