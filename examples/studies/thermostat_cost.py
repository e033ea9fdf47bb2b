"""What a step at constant kinetic energy costs in ASE, beside one at constant energy.

    python thermostat_cost.py --quick --out DIR   a few seconds
    python thermostat_cost.py --out DIR           a minute, what docs/evidence/ase.md shows

Small fluids with forces from compiled code and nothing else in the calculator, so that what the
dynamics takes is not hidden. CPU time of this thread, in blocks of steps taken in turn in one process; medians.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from ase import Atoms, units
from ase.calculators.calculator import Calculator

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parents[1] / "tests" / "systems"), str(HERE)]

import fluids  # noqa: E402
import harness  # noqa: E402

from kcons.ase import ConstrainedDynamics, IsokineticDynamics, constrain  # noqa: E402
from kcons.thermostats import thermal_velocities  # noqa: E402

#: Fluid, its step, and steps of a block: 10 to 20 ms.
SYSTEMS = {
    "8 dumbbells": (partial(fluids.dumbbells, 8), 0.005, 400),
    "27 rigid waters": (partial(fluids.water, 27), units.fs, 150),
    "216 rigid waters": (partial(fluids.water, 216), units.fs, 5),
}


class Forces(Calculator):
    """The forces of a fluid."""

    implemented_properties = ("energy", "forces")

    def __init__(self, fluid: fluids.Fluid) -> None:
        super().__init__()
        self._force = fluid.forces.force

    def calculate(self, atoms=None, properties=("energy",), system_changes=()):
        self.results = {"energy": 0.0, "forces": self._force(atoms.positions, 0.0)}


def made(fluid: fluids.Fluid, step: float, kind: type[ConstrainedDynamics]) -> ConstrainedDynamics:
    """Dynamics of the fluid from its lattice."""
    atoms = Atoms(
        fluid.symbols, positions=fluid.positions, masses=fluid.constraint_set.masses, calculator=Forces(fluid)
    )
    constrain(atoms, fluid.constraint_set.constraints)
    atoms.set_velocities(
        thermal_velocities(fluid.system(), fluid.positions, fluid.thermal_energy, 1, zero_momentum=True)
    )
    return kind(atoms, step)


def timed(dynamics: ConstrainedDynamics, steps: int) -> float:
    """Microseconds a step."""
    start = time.thread_time()
    dynamics.run(steps)
    return 1e6 * (time.thread_time() - start) / steps


def cost(name: str, repeats: int) -> Iterator[dict[str, Any]]:
    """Both dynamics of one fluid, block after block, each of them first every other time."""
    build, step, steps = SYSTEMS[name]
    runs = [made(build(), step, kind) for kind in (ConstrainedDynamics, IsokineticDynamics)]
    found = np.empty((repeats, 2))
    for dynamics in runs:
        timed(dynamics, 2 * steps)
    for k in range(repeats):
        for which in (0, 1) if k % 2 == 0 else (1, 0):
            found[k, which] = timed(runs[which], steps)
    energy, kinetic = (float(t) for t in np.median(found, axis=0))
    low, ratio, high = (float(r) for r in np.quantile(found[:, 1] / found[:, 0], (0.25, 0.5, 0.75)))
    yield {
        "part": "cost",
        "system": name,
        "steps": steps,
        "repeats": repeats,
        "constant_energy_us": energy,
        "isokinetic_us": kinetic,
        "ratio": ratio,
        "low": low,
        "high": high,
    }


def tables(table: pd.DataFrame) -> dict[str, pd.DataFrame]:
    title = "Microseconds of CPU a step in ASE, medians; the middle half of the ratios of neighboring blocks"
    forms = {"constant_energy_us": "{:.1f}", "isokinetic_us": "{:.1f}", "ratio": "{:.2f}", "low": "{:.2f}"}
    return {title: harness.shown(table, "cost", system="{}", **forms, high="{:.2f}")}


def main() -> None:
    harness.main(
        "thermostat_cost",
        harness.options(__doc__, "thermostat-cost"),
        lambda chosen: {name: partial(cost, name, 3 if chosen.quick else 301) for name in SYSTEMS},
        tables,
    )


if __name__ == "__main__":
    main()
