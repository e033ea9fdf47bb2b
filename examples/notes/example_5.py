"""Example 5: a thermostat that keeps the kinetic energy (eqs. 111-113), and what it does to phase space.

python examples/notes/example_5.py        writes example_5.png and example_5.pdf
"""

import matplotlib.pyplot as plt
import numpy as np
from scipy.integrate import cumulative_simpson

from kcons.models.flows import Thermostat

masses = np.array([1.0, 1.0, 2.5, 2.5])  # two particles in a plane
stiffness = np.array([1.0, 2.0, 1.5, 0.7])
flow = Thermostat(masses, lambda x: -stiffness * x - x**3)

X0 = flow.state([1.0, -0.3, 0.5, 0.8], [0.4, 0.9, -0.3, 0.2])
t = np.linspace(0, 6, 121)
path = flow.solve((0, 6), X0, t_eval=t).y.T
K = 0.5 * np.sum(path[:, 4:] ** 2, axis=1)
alpha = np.array([flow.friction(X) for X in path])
print(f"kinetic energy {K[0]:.6f}, kept to {np.ptp(K):.1e}; alpha between {alpha.min():.2f} and {alpha.max():.2f}")

# alpha is no friction: where it is negative, phase space expands. div V = -(g - 1) alpha, measured and predicted.
volume, by_alpha = flow.compression(X0, t[::10])
g = len(masses)
print(f"g = {g}: ln of the phase volume {volume[-1]:.8f}, -(g - 1) times the integral of alpha {by_alpha[-1]:.8f}")

fig, (left, right) = plt.subplots(1, 2, figsize=(9.5, 4), layout="constrained")
left.plot(t, alpha, color="0.2")
left.axhline(0, color="0.6", linewidth=0.8)
left.set(xlabel="time $t$ (reduced units)", ylabel=r"friction $\alpha$ (reduced units)")
predicted = -(g - 1) * cumulative_simpson(alpha, x=t, initial=0.0)
right.plot(t, predicted, color="royalblue", label=r"$-(g-1)\int\alpha\,dt$")
right.plot(t[::10], volume, "o", color="crimson", fillstyle="none", label="measured on tangent vectors")
right.set(xlabel="time $t$ (reduced units)", ylabel="ln of the phase volume (dimensionless)")
fig.legend(loc="outside upper center", ncols=2)
for ending in ("png", "pdf"):
    fig.savefig(f"example_5.{ending}", dpi=120)
