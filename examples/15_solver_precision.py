"""What is left of a constraint after how much time: kcons' engine, Gauss-Seidel sweeps, ASE, OpenMM and LAMMPS alone.

    python examples/15_solver_precision.py                  small systems, fifteen seconds
    python examples/15_solver_precision.py --full --out F   water, CH3 groups, chain, DHFR; ten minutes; F receives
                                                            JSON and is continued if it is there; F.png the diagrams

P brings positions back onto the constraints after a step of 2 fs at 300 K, V takes out of thermal velocities what
leaves them. Each solver does both alone, warm, on one thread, at every tolerance it has; kcons has none but rounding.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.console import Console

from kcons.comparison import scripts, solver_precision


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", action="store_true", help="large systems")
    parser.add_argument("--out", type=Path, help="JSON file for the results")
    options = parser.parse_args()
    result = scripts.continued(options.out, solver_precision.measure, quick=not options.full)
    if options.out:
        solver_precision.figure(result).savefig(options.out.with_suffix(".png"), dpi=130)
    page, title = solver_precision.table(result), "Constraint solvers alone: time a constraint, and what is left"
    Console(width=170).print(scripts.table(title, page.headings, page.headings, page.rows))


if __name__ == "__main__":
    main()
