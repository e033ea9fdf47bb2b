"""Figure 6: velocity field of the pendulum and a trajectory of large amplitude (eqs. 56, 57).

As in the notes, x_1(0) = 10 and x_2(0) = 0: a swing about the lowest position 4 pi. Arrows alternate between stable
points at even multiples of pi and unstable ones at odd multiples (eqs. 58-61).

python examples/notes/figure_06.py        writes figure_06.png and figure_06.pdf
"""

import matplotlib.pyplot as plt
import numpy as np

from kcons.models.flows import Pendulum, Stability, find_equilibria

pendulum = Pendulum(1.0)
fig, (left, right) = plt.subplots(1, 2, figsize=(11, 4.5), layout="constrained", width_ratios=[3, 2])

x1, x2 = np.meshgrid(np.linspace(-7, 7, 25), np.linspace(-3, 3, 13))
left.quiver(x1, x2, x2, -np.sin(x1), angles="xy", color="0.4", width=0.0025)
for point in find_equilibria(pendulum, [[-7, 7], [-3, 3]]):
    stable = point.classification.stability is not Stability.UNSTABLE
    left.plot(*point.position, "o" if stable else "s", color="royalblue" if stable else "crimson", zorder=3)
    print(f"x_1 = {point.position[0] / np.pi:+.0f} pi: {point.classification}")

t = np.linspace(0, 20, 600)
X = pendulum.solve((0, 20), [10.0, 0.0], t_eval=t).y.T
right.plot(*X.T, color="0.2")
right.plot(10, 0, "k>", markersize=9)
right.plot(4 * np.pi, 0, "o", color="royalblue")
for axes in (left, right):
    axes.set(xlabel=r"$x_1 = \theta$ (rad)", ylabel=r"$x_2 = \dot\theta/\Omega$ (rad)")
left.set_xticks(np.pi * np.arange(-2, 3), [r"$-2\pi$", r"$-\pi$", "0", r"$\pi$", r"$2\pi$"])
right.set_xticks(np.pi * np.arange(3, 6), [r"$3\pi$", r"$4\pi$", r"$5\pi$"])
marks = [
    plt.Line2D([], [], marker=m, color=c, linestyle="", label=name)
    for m, c, name in (
        ("o", "royalblue", "stable: a center"),
        ("s", "crimson", "unstable: a saddle"),
        (">", "k", "start (10, 0) of the trajectory"),
    )
]
fig.legend(handles=marks, loc="outside upper center", ncols=3)
for ending in ("png", "pdf"):
    fig.savefig(f"figure_06.{ending}", dpi=120)
