"""Figure 4: the pendulum and its coordinates.

python examples/notes/figure_04.py        writes figure_04.png and figure_04.pdf
"""

import matplotlib.pyplot as plt
import numpy as np

length, theta = 1.0, np.radians(35)
# r = (l sin theta, 0, l (1 - cos theta)), the origin at the lowest point; it hangs from (0, 0, l).
pivot = np.array([0.0, length])
mass = np.array([length * np.sin(theta), length * (1 - np.cos(theta))])

fig, axes = plt.subplots(figsize=(4, 4), layout="constrained")
axes.plot(*np.array([pivot, mass]).T, "k")
axes.plot(*pivot, "ks", markersize=5)
axes.plot(*mass, "ko", markersize=14)
axes.plot([0, 0], [length, -0.1], "k--", linewidth=0.8)
arc = np.linspace(0, theta, 40)
axes.plot(0.35 * np.sin(arc), length - 0.35 * np.cos(arc), "k", linewidth=0.8)
axes.plot(np.sin(np.linspace(-0.2, 1, 60)), length - np.cos(np.linspace(-0.2, 1, 60)), ":", color="0.6")
axes.annotate(r"$\theta$", (0.06, 0.6))
axes.annotate("$l$", (0.36, 0.62))
axes.annotate("$m$", (mass[0] + 0.08, mass[1] - 0.02))
axes.annotate("", (mass[0], mass[1] - 0.3), mass, arrowprops={"arrowstyle": "->"})
axes.annotate("$mg$", (mass[0] + 0.03, mass[1] - 0.25))
axes.set(
    xlabel="$x$ (in units of $l$)", ylabel="$z$ (in units of $l$)", aspect="equal", xlim=(-0.5, 1.1), ylim=(-0.25, 1.1)
)
for ending in ("png", "pdf"):
    fig.savefig(f"figure_04.{ending}", dpi=120)
print(f"distance from the pivot: {np.linalg.norm(mass - pivot):.15g}")
