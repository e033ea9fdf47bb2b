"""Figure 11: a hypercycle of five species under three kinds of constraints (section 4.3.2).

(a) fixed total population, dotted; (b) with production of entropy, black; (c) without production, grey.
k_h = 3, tau_s = 30, mu0_l = (0.1 + 0.05 l) k_B T.

The notes give neither the start nor T(s_eq - s_0). Only one budget is consistent, g(x_0) - g_eq, and it is computed.

python examples/notes/figure_11.py        writes figure_11.png
"""

import matplotlib.pyplot as plt
import numpy as np

from kcons.growth import Hypercycle, Populations, solve

model = Hypercycle(n=5, k_h=3.0)
x0 = [0.6, 0.1, 0.1, 0.1, 0.1]
t = np.linspace(0, 120, 1500)

systems = {
    "(a) fixed total": (model.with_fixed_total(), {"color": "black", "linestyle": ":"}),
    "(b) entropy produced": (model.with_entropy_production(tau=30.0), {"color": "black"}),
    "(c) none produced": (model.without_entropy_production(), {"color": "0.6"}),
}
fig, panels = plt.subplots(5, 1, figsize=(8, 9), sharex=True, layout="constrained")
for name, (system, style) in systems.items():
    found = solve(system, (0, 120), x0, t_eval=t, rtol=1e-7, atol=1e-8)
    for axes, x in zip(panels, found.y, strict=True):
        axes.plot(t, x, label=name, linewidth=1, **style)
    g = model.mixture.gibbs_energy(Populations.from_logarithms(found.t, found.log_y))
    print(
        f"{name}: g - g_eq from {g[0] - model.mixture.least_gibbs_energy():.4f} to "
        f"{g[-1] - model.mixture.least_gibbs_energy():.4f}; sum x = 1 to {abs(found.y.sum(axis=0) - 1).max():.0e}"
    )
for k, axes in enumerate(panels, start=1):
    axes.set(ylabel=f"$x_{k}$", ylim=(0, 0.85))
panels[0].legend(ncols=3, fontsize=8)
panels[-1].set_xlabel("$t$ / a.t.u.")
fig.savefig("figure_11.png", dpi=120)
