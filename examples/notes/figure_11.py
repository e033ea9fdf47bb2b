"""Figure 11: a hypercycle of five species under three kinds of constraints (section 4.3.2).

(a) fixed total population, dotted; (b) with production of entropy, black; (c) without production, grey.
k_h = 3/a.t.u., tau_s = 30 a.t.u., mu0_l = (0.1 + 0.05 l) k_B T.

The notes give neither the start nor T(s_eq - s_0). Only one budget is consistent, g(x_0) - g_eq, and it is computed.
The start is chosen: four species alike, the first with so much more that the text of the notes holds. (a) forgets its
start and runs into one cycle; (c) keeps g - g_eq for ever, so that its swings are set by the start. "Slightly reduced"
against (a), as the notes have them, they are for x_1(0) = 0.75: 0.70 against 0.78. (With 0.6 it would be 0.53.)

What differs from the printed figure, and cannot be compared without its start: the phases of all curves, the period of
(c), which depends on g - g_eq, and how large (b) is on its way to rest at x_eq.

python examples/notes/figure_11.py        writes figure_11.png and figure_11.pdf
"""

import matplotlib.pyplot as plt
import numpy as np

from kcons.models.growth import Hypercycle, Populations, solve

model = Hypercycle(n=5, k_h=3.0)
x0 = [0.75, 0.0625, 0.0625, 0.0625, 0.0625]
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
        (line,) = axes.plot(t, x, linewidth=1.2, **style)
    line.set_label(name)
    g = model.mixture.gibbs_energy(Populations.from_logarithms(found.t, found.log_y))
    largest = found.y[:, t > 60].max()
    print(
        f"{name}: g - g_eq from {g[0] - model.mixture.least_gibbs_energy():.4f} to "
        f"{g[-1] - model.mixture.least_gibbs_energy():.4f} k_B T; largest x after half the time {largest:.3f}; "
        f"sum x = 1 to {abs(found.y.sum(axis=0) - 1).max():.0e}"
    )
for k, axes in enumerate(panels, start=1):
    axes.set(ylabel=f"$x_{k}$ (fraction)", ylim=(0, 0.85), xlim=(0, 120))
panels[-1].set_xlabel("time $t$ (a.t.u.)")
fig.legend(loc="outside upper center", ncols=3)
for ending in ("png", "pdf"):
    fig.savefig(f"figure_11.{ending}", dpi=120)
