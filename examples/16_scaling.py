"""How cost and memory of constraint solvers grow with the size of the system, with fitted exponents.

    python examples/16_scaling.py                  two sizes, twenty seconds
    python examples/16_scaling.py --full --out F   water to 10^5 molecules, a chain to 10^6 bonds; a quarter of an hour;
                                                   F receives JSON and is continued if it is there; F.png the diagrams

Each solver runs in a process of its own, from small to large, and is stopped where one size takes longer than 90 s.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.console import Console

from kcons.comparison import scaling, scripts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", action="store_true", help="all sizes and solvers")
    parser.add_argument("--out", type=Path, help="JSON file for the results")
    options = parser.parse_args()
    result = scripts.continued(options.out, scaling.measure, quick=not options.full)
    if options.out:
        scaling.figure(result).savefig(options.out.with_suffix(".png"), dpi=130)
    page = scaling.table(result)
    Console(width=150).print(scripts.table("Cost and memory against size", page.headings, page.headings, page.rows))


if __name__ == "__main__":
    main()
