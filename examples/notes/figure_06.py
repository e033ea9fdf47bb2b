"""Figure 6: velocity field of the pendulum and a trajectory of large amplitude (eqs. 56, 57).

As in the notes, x_1(0) = 10 and x_2(0) = 0. Arrows alternate between stable points at even multiples of pi and unstable
ones at odd multiples (eqs. 58-61).

python examples/notes/figure_06.py        writes figure_06.png
"""

import matplotlib.pyplot as plt
import numpy as np

from kcons.flows import Pendulum, find_equilibria

pendulum = Pendulum(1.0)
fig, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")

x1, x2 = np.meshgrid(np.linspace(-7, 7, 29), np.linspace(-3, 3, 13))
left.quiver(x1, x2, x2, -np.sin(x1))
for point in find_equilibria(pendulum, [[-7, 7], [-3, 3]]):
    stable = point.classification.stability.value == "stable"
    left.plot(*point.position, "o", color="royalblue" if stable else "crimson")
    print(f"x_1 = {point.position[0] / np.pi:+.0f} pi: {point.classification}")

t = np.linspace(0, 20, 600)
right.plot(*pendulum.exact(t, [10.0, 0.0]).T, "royalblue")
right.plot(10, 0, "ko")
for axes in (left, right):
    axes.set(xlabel="$x_1$", ylabel="$x_2$")
fig.savefig("figure_06.png", dpi=120)
