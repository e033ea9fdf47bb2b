"""Rigid water in ASE: hold every molecule, run dynamics, read off what the constraints did.

Run with ``python examples/rigid_water_ase.py``; about ten seconds.
"""

import numpy as np
from ase import Atoms, units
from ase.build import molecule
from ase.calculators.tip3p import TIP3P
from ase.md.verlet import VelocityVerlet

from kcons.ase import ConstrainedLangevin, constrain, draw_velocities, rigid_water


def water_box(side: int = 3, spacing: float = 3.1) -> Atoms:
    """Waters in random orientations on a cubic grid, periodic."""
    rng = np.random.default_rng(1)
    box = Atoms(cell=[side * spacing] * 3, pbc=True)
    for place in np.ndindex(side, side, side):
        water = molecule("H2O")
        water.rotate(rng.uniform(0, 360), rng.normal(size=3))
        water.translate(spacing * np.array(place))
        box += water
    return box


def main(steps: int = 100) -> None:
    atoms = water_box()
    atoms.calc = TIP3P(rc=4.5)

    # One object holds everything. project=True moves the atoms onto the TIP3P geometry.
    held = constrain(atoms, rigid_water(atoms, "tip3p"), project=True)
    draw_velocities(atoms, 300, rng=2)
    ConstrainedLangevin(atoms, 2 * units.fs, 300, 0.1 / units.fs, rng=3).run(steps)  # takes up the heat of the start
    print(held.report(atoms), "\n")

    dynamics = VelocityVerlet(atoms, 2 * units.fs)
    start = atoms.get_total_energy()
    print(" time/fs  total energy - start/eV  temperature/K  max |length - target|/A")
    for _ in range(5):
        dynamics.run(steps // 5)
        lengths_off = np.abs(held.engine(atoms).constraint_set.value(atoms.positions)).max()
        print(
            f"{dynamics.get_time() / units.fs:8.1f}  {atoms.get_total_energy() - start:23.6f}"
            f"  {atoms.get_temperature():13.1f}  {lengths_off:23.1e}"
        )


if __name__ == "__main__":
    main()
