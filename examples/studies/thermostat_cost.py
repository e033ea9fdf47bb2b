"""What a step at constant kinetic energy costs in ASE, beside one at constant energy.

    python thermostat_cost.py                 a few seconds
    python thermostat_cost.py --full --out F  a minute, what docs/thermostats.md shows; F receives JSON
    python thermostat_cost.py --show F        the table of an earlier result

The fluids of `kcons compare`, with forces from compiled code and nothing else in the calculator, so that what the
dynamics takes is not hidden. CPU time of this thread, in blocks of steps taken in turn in one process; medians.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import study_scripts as scripts
from ase import Atoms
from ase.calculators.calculator import Calculator

from kcons.ase import ConstrainedDynamics, IsokineticDynamics, constrain
from kcons.comparison import Fluid, environment, processor_of, test_systems
from kcons.thermostats import thermal_velocities

#: Fluid, molecules, steps of a block: 10 to 20 ms.
SYSTEMS = (
    ("8 dumbbells", "thermostat-dumbbells", 8, 400),
    ("27 rigid waters", "thermostat-water", 27, 150),
    ("216 rigid waters", "thermostat-water", 216, 5),
)


class Forces(Calculator):
    """The forces of a fluid."""

    implemented_properties = ("energy", "forces")

    def __init__(self, fluid: Fluid) -> None:
        super().__init__()
        self._force = fluid.forces.force

    def calculate(self, atoms=None, properties=("energy",), system_changes=()):
        self.results = {"energy": 0.0, "forces": self._force(atoms.positions, 0.0)}


def made(fluid: Fluid, kind: type[ConstrainedDynamics]) -> ConstrainedDynamics:
    """Dynamics of the fluid from its lattice, with the smallest step that `kcons compare` takes it at."""
    atoms = Atoms(
        fluid.symbols, positions=fluid.positions, masses=fluid.constraint_set.masses, calculator=Forces(fluid)
    )
    constrain(atoms, fluid.constraint_set.constraints)
    atoms.set_velocities(
        thermal_velocities(fluid.system(), fluid.positions, fluid.thermal_energy, 1, zero_momentum=True)
    )
    return kind(atoms, min(fluid.time_steps))


def timed(dynamics: ConstrainedDynamics, steps: int) -> float:
    """Microseconds a step."""
    start = time.thread_time()
    dynamics.run(steps)
    return 1e6 * (time.thread_time() - start) / steps


def cost(title: str, name: str, molecules: int, steps: int, repeats: int) -> dict[str, Any]:
    """Both dynamics of one fluid, block after block, each of them first every other time."""
    fluid = test_systems.build_fluid(name, molecules)
    runs = [made(fluid, ConstrainedDynamics), made(fluid, IsokineticDynamics)]
    found = np.empty((repeats, 2))
    for dynamics in runs:
        timed(dynamics, 2 * steps)
    for k in range(repeats):
        for which in (0, 1) if k % 2 == 0 else (1, 0):
            found[k, which] = timed(runs[which], steps)
    energy, kinetic = (float(t) for t in np.median(found, axis=0))
    low, ratio, high = (float(r) for r in np.quantile(found[:, 1] / found[:, 0], (0.25, 0.5, 0.75)))
    return {
        "system": title,
        "steps": steps,
        "repeats": repeats,
        "constant_energy_us": energy,
        "isokinetic_us": kinetic,
        "ratio": ratio,
        "quartiles": [low, high],
    }


def show(result: dict[str, Any]) -> None:
    print("Microseconds of CPU a step in ASE, medians; the middle half of the ratios of neighbouring blocks")
    print("system            constant energy  isokinetic  ratio  (middle half)")
    for r in result["cost"]:
        low, high = r["quartiles"]
        line = f"{r['system']:16s} {r['constant_energy_us']:16.1f} {r['isokinetic_us']:11.1f}"
        print(f"{line} {r['ratio']:6.2f}  ({low:.2f} to {high:.2f})")
    computer = result["machine"]
    names = ("numpy", "numba", "ase")
    versions = ", ".join(f"{name} {computer['versions'][name]}" for name in names if computer["versions"].get(name))
    print(f"\n{processor_of(computer)}; Python {computer['python']}, {versions}")
    print(f"commit {computer['commit']}, {computer['date']}")


def run(full: bool) -> dict[str, Any]:
    repeats = 301 if full else 15
    return {"full": full, "machine": environment(), "cost": [cost(*system, repeats) for system in SYSTEMS]}


def main() -> None:
    parser = scripts.options(__doc__, full="as many blocks as the page shows")
    scripts.script(parser, lambda options: run(options.full), show)


if __name__ == "__main__":
    main()
