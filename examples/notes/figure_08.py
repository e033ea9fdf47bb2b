"""Figure 8: prey and predators in time, and their phase portrait (eqs. 69, 70).

python examples/notes/figure_08.py        writes figure_08.png and figure_08.pdf
"""

import matplotlib.pyplot as plt
import numpy as np

from kcons.models.growth import ConstrainedGrowth, LotkaVolterra, solve

model = LotkaVolterra(alpha1=1, beta1=1, alpha2=1, beta2=2)
start = [1.0, 0.5]  # not given in the notes
found = solve(ConstrainedGrowth(model), (0, 20), start, t_eval=np.linspace(0, 20, 800))

fig, (left, right) = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
left.plot(found.t, found.y[0], color="royalblue", label="prey $x_1$")
left.plot(found.t, found.y[1], color="crimson", linestyle="--", label="predators $x_2$")
left.set(xlabel="time $t$ (a.t.u.)", ylabel="populations (arbitrary units)", xticks=range(0, 21, 5))
right.plot(*found.y, color="0.2")
right.plot(*start, "ko", label="start")
right.plot(*model.equilibrium, "k+", markersize=10, label="stationary point (74)")
right.set(xlabel="prey $x_1$ (arbitrary units)", ylabel="predators $x_2$ (arbitrary units)")
fig.legend(loc="outside upper center", ncols=4)
for ending in ("png", "pdf"):
    fig.savefig(f"figure_08.{ending}", dpi=120)
G = model.invariant(found.y)
print(f"G = {G[0]:.6f}, conserved to {np.ptp(G):.1e} (eq. 73)")
