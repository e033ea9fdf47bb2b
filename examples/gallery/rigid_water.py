"""Twenty-seven rigid waters at 300 K: shapes are kept to rounding, whatever the molecules do.

python rigid_water.py [FOLDER] [FRAMES]     writes rigid_water.gif
"""

import sys

import matplotlib.pyplot as plt
import numpy as np
from ase import units
from matplotlib.animation import FuncAnimation, PillowWriter

from kcons import State, System, run
from kcons.comparison import test_systems
from kcons.thermostats import Langevin

folder, frames = (sys.argv[1:] + [".", "80"][len(sys.argv) - 1 :])[:2]
water = test_systems.build("water", 27, forces="ase")
system, kT = System(water.motion, water.potential.forces), water.thermal_energy
start = State(water.positions, water.velocities)
stepper = Langevin(kT, 1e-3 / units.fs, 1)
path = []
run(system, start, 2 * units.fs, 5 * int(frames), stepper=stepper, observers=[path.append], every=5)
atoms = np.array([state.positions for state in path]).reshape(len(path), -1, 3, 3)
lengths = np.linalg.norm(atoms[:, :, [1, 2, 2]] - atoms[:, :, [0, 0, 1]], axis=-1)
print(f"lengths kept to {np.ptp(lengths, axis=0).max():.1e} angstrom")
assert np.ptp(lengths, axis=0).max() < 1e-12

figure, axes = plt.subplots(figsize=(4, 4), layout="constrained")
low, high = atoms.min() - 1, atoms.max() + 1
axes.set(xlim=(low, high), ylim=(low, high), aspect="equal", xlabel="x / Å", ylabel="y / Å")
bonds = [axes.plot([], [], color="0.6", lw=1.5, zorder=1)[0] for _ in range(atoms.shape[1])]
oxygens = axes.scatter([], [], s=70, color="#D55E00", zorder=3)
hydrogens = axes.scatter([], [], s=20, color="#56B4E9", zorder=2)


def show(k: int) -> None:
    now = atoms[k]
    for bond, molecule in zip(bonds, now, strict=True):
        bond.set_data(molecule[[1, 0, 2], 0], molecule[[1, 0, 2], 1])
    oxygens.set_offsets(now[:, 0, :2])
    hydrogens.set_offsets(now[:, 1:, :2].reshape(-1, 2))


FuncAnimation(figure, show, len(path)).save(f"{folder}/rigid_water.gif", PillowWriter(fps=20), dpi=60)
