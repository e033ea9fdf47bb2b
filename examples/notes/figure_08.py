"""Figure 8: prey and predators in time, and their phase portrait (eqs. 69, 70).

python examples/notes/figure_08.py        writes figure_08.png
"""

import matplotlib.pyplot as plt
import numpy as np

from kcons.growth import ConstrainedGrowth, LotkaVolterra, solve

model = LotkaVolterra(alpha1=1, beta1=1, alpha2=1, beta2=2)
found = solve(ConstrainedGrowth(model), (0, 20), [1.0, 0.5], t_eval=np.linspace(0, 20, 800))

fig, (left, right) = plt.subplots(1, 2, figsize=(9, 3.5), layout="constrained")
left.plot(found.t, found.y[0], label="prey $x_1$")
left.plot(found.t, found.y[1], label="predators $x_2$")
left.set(xlabel="$t$", ylabel="populations")
left.legend()
right.plot(*found.y)
right.plot(*model.equilibrium, "k+")
right.set(xlabel="$x_1$", ylabel="$x_2$")
fig.savefig("figure_08.png", dpi=120)
G = model.invariant(found.y)
print(f"G = {G[0]:.6f}, conserved to {np.ptp(G):.1e} (eq. 73)")
