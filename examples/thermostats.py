"""Three thermostats on rigid water in ASE: Langevin, Nosé-Hoover and isokinetic dynamics at 300 K, beside each other.

Run with ``python examples/thermostats.py``; some ten seconds. Each starts from the same relaxed box. The kinetic energy
tells what velocities do: Langevin and Nosé-Hoover dynamics let it fluctuate, isokinetic dynamics keeps it.
"""

import numpy as np
from ase import Atoms, units
from ase.build import molecule
from ase.calculators.tip3p import TIP3P

from kcons.ase import (
    ConstrainedLangevin,
    ConstrainedNoseHoover,
    IsokineticDynamics,
    constrain,
    draw_velocities,
    rigid_water,
)

rng = np.random.default_rng(1)
box = Atoms(cell=[9.3] * 3, pbc=True)
for place in np.ndindex(3, 3, 3):  # waters on a grid, each turned at random
    water = molecule("H2O")
    water.rotate(rng.uniform(0, 360), rng.normal(size=3))
    water.translate(3.1 * np.array(place))
    box += water
box.calc = TIP3P(rc=4.5)
held = constrain(box, rigid_water(box, "tip3p"), project=True)
draw_velocities(box, 300, rng=2)
ConstrainedLangevin(box, 2 * units.fs, 300, 0.1 / units.fs, rng=3).run(100)

step = 2 * units.fs
baths = {
    "Langevin": lambda atoms: ConstrainedLangevin(atoms, step, temperature_K=300, friction=0.01 / units.fs, rng=4),
    "Nosé-Hoover": lambda atoms: ConstrainedNoseHoover(atoms, step, temperature_K=300, tdamp=50 * units.fs),
    "isokinetic": lambda atoms: IsokineticDynamics(atoms, step, temperature_K=300),
}
print("thermostat    mean temperature/K   its fluctuation/K   drift of what is conserved/eV   off the shapes/Å")
for name, bath in baths.items():
    atoms = box.copy()
    atoms.calc = TIP3P(rc=4.5)
    draw_velocities(atoms, 300, rng=5, zero_momentum=True)
    dynamics = bath(atoms)
    dynamics.run(20)
    found, before = [], dynamics.get_conserved_energy()
    dynamics.attach(lambda dynamics=dynamics, found=found: found.append(dynamics.get_temperature()))
    dynamics.run(100)
    drift = dynamics.get_conserved_energy() - before
    off = np.abs(held.engine(atoms).constraint_set.value(atoms.positions)).max()
    print(f"{name:12s} {np.mean(found):18.1f} {np.std(found):19.1f} {drift:26.4f} {off:22.0e}")
    assert off < 1e-12 and (np.std(found) < 1e-9) == (name == "isokinetic")
