"""Rigid water at 300 K and 1 bar in ASE: a Monte Carlo barostat beside Langevin dynamics.

Run with ``python examples/constant_pressure.py``; some ten seconds. The box is small and the run short: for a density
take some hundred molecules and 100,000 steps. Any calculator takes the place of TIP3P, for the barostat asks energies.
"""

import numpy as np
from ase import units
from ase.build import molecule
from ase.calculators.tip3p import TIP3P, angleHOH, rOH

from kcons.ase import ConstrainedLangevin, constrain, draw_velocities, rigid_water
from kcons.thermostats import MonteCarloBarostat

water = molecule("H2O", vacuum=1.6, pbc=True)
water.set_angle(1, 0, 2, angleHOH)
for hydrogen in (1, 2):
    water.set_distance(0, hydrogen, rOH, fix=0)
atoms = water * (3, 3, 3)
atoms.calc = TIP3P(rc=4.0)
held = constrain(atoms, rigid_water(atoms, "tip3p"), project=True)
draw_velocities(atoms, 300, rng=1)

# Trials move each molecule by its center: nothing that is held is stretched.
barostat = MonteCarloBarostat(1.0 * units.bar, every=10, cutoff=4.0)
dynamics = ConstrainedLangevin(atoms, 2 * units.fs, 300, 0.01 / units.fs, rng=2, barostat=barostat)

print("time/fs   density/(g/cm3)   temperature/K   trials accepted")
gram = units.kg / 1000 / (1e8 * units.Angstrom) ** 3  # 1 g/cm3 in ASE's units
densities = []
for _ in range(4):
    dynamics.run(50)
    densities.append(atoms.get_masses().sum() / atoms.get_volume() / gram)
    accepted = barostat.acceptance(dynamics.state)[0]
    time, warm = dynamics.get_time() / units.fs, dynamics.get_temperature()
    print(f"{time:7.0f} {densities[-1]:17.3f} {warm:15.0f} {accepted:18.2f}")

off = np.abs(held.engine(atoms).constraint_set.value(atoms.positions)).max()
print(f"shapes of the molecules are kept to {off:.0e} Å")
assert off < 1e-12 and len(set(densities)) > 1
