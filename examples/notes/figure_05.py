"""Figure 5: the linear oscillator and the pendulum, at small and at large amplitude.

python examples/notes/figure_05.py        writes figure_05.png and figure_05.pdf
"""

import matplotlib.pyplot as plt
import numpy as np

from kcons.models.flows import HarmonicOscillator, Pendulum

linear, pendulum = HarmonicOscillator(1.0), Pendulum(1.0)
t = np.linspace(0, 20, 600)

gaps = []
fig, panels = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
for axes, theta0 in zip(panels, (0.2, 2.8), strict=True):
    start = [theta0, 0.0]
    both = [flow.solve((0, 20), start, t_eval=t).y[0] for flow in (linear, pendulum)]
    gaps.append(abs(both[0] - both[1]).max() / theta0)
    lines = axes.plot(t, both[0], color="mediumorchid", label="linear oscillator")
    lines += axes.plot(t, both[1], color="royalblue", linestyle="--", label="pendulum")
    axes.set(xlabel=r"time $\Omega t$ (dimensionless)", ylabel=r"$\theta$ (rad)", xticks=range(0, 21, 5))
    axes.set_title(rf"$\theta(0) = {theta0}$ rad, $\dot\theta(0) = 0$")
fig.legend(handles=lines, loc="outside upper center", ncols=2)
for ending in ("png", "pdf"):
    fig.savefig(f"figure_05.{ending}", dpi=120)
print(f"largest difference in parts of the amplitude: {gaps[0]:.3f} at 0.2 rad, {gaps[1]:.3f} at 2.8 rad")
