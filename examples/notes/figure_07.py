"""Figure 7: logistic growth from three starts (eqs. 65, 66).

python examples/notes/figure_07.py        writes figure_07.png and figure_07.pdf
"""

import matplotlib.pyplot as plt
import numpy as np

from kcons.models.growth import ConstrainedGrowth, Logistic, solve

model = Logistic(alpha=1.0, beta=0.1)
t = np.linspace(0, 10, 200)

fig, axes = plt.subplots(figsize=(6, 4), layout="constrained")
for x0 in (0.5, 5.0, 15.0):
    axes.plot(t, model.exact(t, x0), label=f"$x(0) = {x0:g}$")
    # The same by integration of ln x.
    found = solve(ConstrainedGrowth(model), (0, 10), [x0], t_eval=t)
    print(f"x(0) = {x0:g}: closed form and integration differ by {abs(found.y[0] - model.exact(t, x0)).max():.1e}")
axes.axhline(model.plateau, color="0.6", linestyle=":", label=r"plateau $\alpha/\beta$")
axes.set(xlabel="time $t$ (a.t.u.)", ylabel="population $x$ (arbitrary units)")
fig.legend(loc="outside upper center", ncols=4, fontsize=9)
for ending in ("png", "pdf"):
    fig.savefig(f"figure_07.{ending}", dpi=120)
