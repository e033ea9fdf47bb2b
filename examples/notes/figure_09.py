"""Figure 9: velocity field of the Lotka-Volterra model, with and without negative populations (eqs. 71-77).

No trajectory crosses the lines x_1 = 0 and x_2 = 0.

python examples/notes/figure_09.py        writes figure_09.png and figure_09.pdf
"""

import matplotlib.pyplot as plt
import numpy as np

from kcons.models.flows import Flow, Stability, find_equilibria
from kcons.models.growth import LotkaVolterra

model = LotkaVolterra(alpha1=1, beta1=1, alpha2=1, beta2=2)
fig, panels = plt.subplots(1, 2, figsize=(11, 4.8), layout="constrained")
for axes, low, number in zip(panels, (0.0, -3.0), (17, 21), strict=True):
    x = np.array(np.meshgrid(np.linspace(low, 5, number), np.linspace(low, 5, number)))
    V = model.velocity(0.0, x.reshape(2, -1)).reshape(2, number, number)
    # Arrows of equal length, colors for their speed; where nothing moves there is none.
    speed = np.hypot(*V)
    arrows = axes.quiver(
        *x, *(V / np.where(speed > 0, speed, 1.0)), speed, cmap="viridis", angles="xy", pivot="mid", width=0.004
    )
    arrows.set_clim(0, 30)
    axes.axhline(0, color="0.5", linewidth=0.8)
    axes.axvline(0, color="0.5", linewidth=0.8)
    axes.set(xlabel="prey $x_1$ (arbitrary units)", ylabel="predators $x_2$ (arbitrary units)", aspect="equal")
panels[0].set_title("$x_1, x_2 \\geq 0$")
panels[1].set_title("with the region that has no meaning")

flow = Flow(model.velocity, 2, model.jacobian)
for point in find_equilibria(flow, [[-1, 5], [-1, 5]]):
    stable = point.classification.stability is not Stability.UNSTABLE
    for axes in panels:
        axes.plot(*point.position, "o" if stable else "s", color="royalblue" if stable else "crimson", zorder=3)
    print(f"X_s = {np.round(point.position, 6) + 0.0}: {point.classification}")
marks = [
    plt.Line2D([], [], marker=m, color=c, linestyle="", label=name)
    for m, c, name in (("o", "royalblue", "stable: a center"), ("s", "crimson", "unstable: a saddle"))
]
fig.legend(handles=marks, loc="outside upper center", ncols=2)
fig.colorbar(arrows, ax=panels, extend="max", label="speed $|V|$ (arbitrary units per a.t.u.)")
for ending in ("png", "pdf"):
    fig.savefig(f"figure_09.{ending}", dpi=120)
