"""Five species, each of which helps the next: fractions that add up to one, held by a constraint on a growth model.

python hypercycle.py [FOLDER] [FRAMES]     writes hypercycle.gif
"""

import sys

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter

from kcons.models.growth import Hypercycle, solve

folder, frames = (sys.argv[1:] + [".", "60"][len(sys.argv) - 1 :])[:2]
model = Hypercycle(n=5, k_h=3.0).with_fixed_total()
t = np.linspace(0, 90, 10 * int(frames))
found = solve(model, (0, 90), [0.6, 0.1, 0.1, 0.1, 0.1], t_eval=t, rtol=1e-7, atol=1e-8)
off = abs(found.y.sum(axis=0) - 1).max()
print(f"the fractions add up to 1 to {off:.1e}")
assert off < 1e-10

figure, (left, right) = plt.subplots(1, 2, figsize=(7, 3), layout="constrained", width_ratios=[1, 2])
colors = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00"]
bars = left.bar(range(1, 6), found.y[:, 0], color=colors)
left.set(ylim=(0, 1), xlabel="species", ylabel="fraction")
lines = [right.plot([], [], color=color)[0] for color in colors]
right.set(xlim=(0, 90), ylim=(0, 1), xlabel="time")


def show(k: int) -> None:
    for bar, line, x in zip(bars, lines, found.y, strict=True):
        bar.set_height(x[10 * k])
        line.set_data(t[: 10 * k + 1], x[: 10 * k + 1])


FuncAnimation(figure, show, int(frames)).save(f"{folder}/hypercycle.gif", PillowWriter(fps=20), dpi=60)
