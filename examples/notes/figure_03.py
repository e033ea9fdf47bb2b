"""Figure 3: the optimal trajectory and variations of it (eqs. 42, 43).

The action of a pendulum is least on its true path q(t), among all paths with the same ends.

python examples/notes/figure_03.py        writes figure_03.png and figure_03.pdf
"""

import matplotlib.pyplot as plt
import numpy as np

from kcons.models.flows import Pendulum, action


def lagrangian(q, v, t):
    """T - U of a pendulum with m = l = g = 1 (eq. 41)."""
    return 0.5 * v[0] ** 2 - (1 - np.cos(q[0]))


t = np.linspace(0.0, 1.5, 301)
true = Pendulum().solve((0, 1.5), [0.4, 0.9], t_eval=t).y[0]
bump = np.sin(np.pi * t / t[-1])  # zero at both ends

fig, (left, right) = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
sizes = np.linspace(-0.3, 0.3, 13)
for size in sizes:
    (variation,) = left.plot(t, true + size * bump, "--", color="0.6", linewidth=0.8)
variation.set_label("variations with the same ends")
left.plot(t, true, "k", label="true path")
left.plot(t[[0, -1]], true[[0, -1]], "ko")
left.set(xlabel=r"time $\Omega t$ (dimensionless)", ylabel="$q$ (rad)")

S = [action(lagrangian, t, true + size * bump) for size in sizes]
right.plot(sizes, S, "k.-")
right.set(xlabel="size of the variation (rad)", ylabel=r"action $S$ (in units of $m l^2 \Omega$)")
fig.legend(loc="outside upper center", ncols=2)
for ending in ("png", "pdf"):
    fig.savefig(f"figure_03.{ending}", dpi=120)
print(f"the action is least at a variation of {sizes[np.argmin(S)]:.2f}: S = {min(S):.6f}")
