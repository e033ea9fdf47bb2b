"""Figure 9: velocity field of the Lotka-Volterra model, with and without negative populations (eqs. 71-77).

No trajectory crosses the lines x_1 = 0 and x_2 = 0.

python examples/notes/figure_09.py        writes figure_09.png
"""

import matplotlib.pyplot as plt
import numpy as np

from kcons.flows import Flow, find_equilibria
from kcons.growth import LotkaVolterra

model = LotkaVolterra(alpha1=1, beta1=1, alpha2=1, beta2=2)
fig, panels = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
for axes, low in zip(panels, (0.0, -3.0), strict=True):
    x = np.array(np.meshgrid(np.linspace(low, 5, 21), np.linspace(low, 4, 21)))
    V = model.velocity(0.0, x.reshape(2, -1)).reshape(2, 21, 21)
    # Arrows of equal length; where nothing moves there is none.
    length = np.hypot(*V)
    axes.quiver(*x, *(V / np.where(length > 0, length, 1.0)), length, cmap="viridis")
    axes.axhline(0, color="0.5", linewidth=0.8)
    axes.axvline(0, color="0.5", linewidth=0.8)
    axes.set(xlabel="$x_1$", ylabel="$x_2$")

flow = Flow(model.velocity, 2, model.jacobian)
for point in find_equilibria(flow, [[-1, 5], [-1, 5]]):
    panels[1].plot(*point.position, "o", color="crimson")
    print(f"X_s = {np.round(point.position, 6) + 0.0}: {point.classification}")
fig.savefig("figure_09.png", dpi=120)
