"""Figure 7: logistic growth from three starts (eqs. 65, 66).

python examples/notes/figure_07.py        writes figure_07.png
"""

import matplotlib.pyplot as plt
import numpy as np

from kcons.growth import ConstrainedGrowth, Logistic, solve

model = Logistic(alpha=1.0, beta=0.1)
t = np.linspace(0, 10, 200)

fig, axes = plt.subplots(figsize=(5, 3.5), layout="constrained")
for x0 in (0.5, 5.0, 15.0):
    axes.plot(t, model.exact(t, x0), label=f"$x(0) = {x0:g}$")
    # The same by integration of ln x.
    found = solve(ConstrainedGrowth(model), (0, 10), [x0], t_eval=t)
    print(f"x(0) = {x0:g}: closed form and integration differ by {abs(found.y[0] - model.exact(t, x0)).max():.1e}")
axes.axhline(model.plateau, color="0.6", linestyle=":")
axes.set(xlabel="$t$", ylabel="$x(t)$")
axes.legend()
fig.savefig("figure_07.png", dpi=120)
