"""How cost and memory of constraint solvers grow with the size of the system, with fitted exponents.

    python examples/16_scaling.py                  two sizes, twenty seconds
    python examples/16_scaling.py --full --out F   water to 10^5 molecules, a chain to 10^6 bonds; a quarter of an hour;
                                                   F receives JSON and is continued if it is there; F.png the diagrams

Each solver runs in a process of its own, from small to large, and is stopped where one size takes longer than 90 s.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from rich.console import Console
from rich.table import Table

from kcons import compare, scaling


def show(result: dict, console: Console) -> None:
    page = scaling.table(result)
    table = Table(title="Cost and memory against size")
    for heading in page.headings:
        table.add_column(heading)
    for row in page.rows:
        table.add_row(*row)
    console.print(table)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", action="store_true", help="all sizes and solvers")
    parser.add_argument("--out", type=Path, help="JSON file for the results")
    options = parser.parse_args()
    earlier = None

    def keep(result: dict) -> None:
        if options.out:
            whole = {**result, "environment": compare.environment()}
            options.out.write_text(json.dumps(whole, indent=1) + "\n")

    if options.out and options.out.exists():
        earlier = json.loads(options.out.read_text())
    result = scaling.measure(quick=not options.full, keep=keep, earlier=earlier)
    if options.out:
        scaling.figure(result).savefig(options.out.with_suffix(".png"), dpi=130)
    show(result, Console(width=150))


if __name__ == "__main__":
    main()
