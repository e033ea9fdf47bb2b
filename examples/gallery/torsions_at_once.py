"""Nine butanes in one batch of TorchSim, each held at a torsion of its own, at 300 K.

python torsions_at_once.py [FOLDER] [FRAMES]     writes torsions_at_once.gif; needs the extra torchsim
"""

import sys

import matplotlib.pyplot as plt
import numpy as np
import torch
import torch_sim as ts
from ase.build import molecule
from matplotlib.animation import FuncAnimation, PillowWriter
from torch_sim.models.pair_potential import PairPotentialModel

from kcons.constraints import Dihedral
from kcons.torchsim import hold, langevin

folder, frames = (sys.argv[1:] + [".", "80"][len(sys.argv) - 1 :])[:2]


def lennard_jones(r, zi, zj):
    depth = torch.where(zi == 6, 0.0535, 0.0361) * torch.where(zj == 6, 0.0535, 0.0361)
    six = (torch.where(zi == 6, 3.5, 2.5) * torch.where(zj == 6, 3.5, 2.5) / r**2) ** 3
    return 4 * depth * (six * six - six)


butane = molecule("trans-butane")
model = PairPotentialModel(lennard_jones, cutoff=7.0, reduce_to_half_list=True)
states = []
for torsion in np.radians(np.linspace(60, 300, 9)):
    states.append(ts.io.atoms_to_state(butane, torch.device("cpu"), torch.float64))
    hold(states[-1], ["allangles", Dihedral([0, 1, 2, 3], torsion)], project=True)
state = langevin.init(ts.concatenate_states(states), model, kT=300 * ts.units.MetalUnits.temperature)
state.rng = 1
femtosecond, seen = 1e-3 * ts.units.MetalUnits.time, []
for _ in range(int(frames)):
    for _ in range(4):
        state = langevin.step(state, model, dt=2 * femtosecond, kT=0.02585, gamma=0.002 / femtosecond)
    seen.append(state.positions.reshape(9, -1, 3).numpy())
path = np.array(seen)
ends = np.linalg.norm(path[:, :, 0] - path[:, :, 3], axis=-1)  # fixed by bonds, angles and the torsion
assert np.ptp(ends, axis=0).max() < 1e-10
path -= path[:, :, 1:3].mean(2, keepdims=True)

figure, panels = plt.subplots(3, 3, figsize=(4, 4), layout="constrained")
heavy = butane.numbers == 6
bonds = np.argwhere(np.triu(butane.get_all_distances() < np.where(heavy & heavy[:, None], 1.6, 1.2), 1))
lines = [[axes.plot([], [], "o-", ms=3, color="C0" if b[1] > 3 else "0.2")[0] for b in bonds] for axes in panels.flat]
for axes in panels.flat:
    axes.set(xlim=(-2.6, 2.6), ylim=(-2.6, 2.6), aspect="equal", xticks=[], yticks=[])


def show(k: int) -> None:
    for molecule_lines, x in zip(lines, path[k], strict=True):
        for line, bond in zip(molecule_lines, bonds, strict=True):
            line.set_data(x[bond, 0], x[bond, 1])


FuncAnimation(figure, show, len(path)).save(f"{folder}/torsions_at_once.gif", PillowWriter(fps=20), dpi=60)
