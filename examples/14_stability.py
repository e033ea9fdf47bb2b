"""How far a method can be pushed: the largest step of a rotor, drift of a pendulum, and random molecules.

python examples/14_stability.py             seconds
kcons stability                             all of it; goes on where it was interrupted
python examples/14_stability.py --table F   the tables of a stability.json, for the documentation
"""

from __future__ import annotations

import argparse
from pathlib import Path

from kcons.comparison import json_files
from kcons.comparison.stability import digest, drift, fuzz, largest_step, report, trial


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--table", type=Path, help="a stability.json, to print its tables and leave")
    parser.add_argument("--trials", type=int, default=50, help="random molecules")
    chosen = parser.parse_args()
    if chosen.table:
        result = json_files.read(chosen.table)
        result = result if "fuzz" in result else digest(result)
        print("\n\n".join(report.markdown(result).values()))
        return

    # A rotor turns by asin(omega dt) a step: beyond omega dt = 1 there is no step, and no method may pretend.
    for method in ("Rattle", "BlanesMoan4", "ASE", "OpenMM"):
        found = largest_step(method, "rotor", quick=True)
        print(f"{method:12} largest step {found['largest_step']:.3g}, then {found['how']}")

    found = drift("pendulum", seeds=4, steps=2000)
    print(f"pendulum: the energy drifts by {found['slope']:.1e} +- {found['standard_error']:.1e} per unit time")

    trials = [trial(seed) for seed in range(chosen.trials)]
    print(fuzz.summary(trials)["outcomes"])


if __name__ == "__main__":
    main()
