"""Example 3: the pendulum, from its Lagrangian to Hamilton's equations (section 2).

python examples/notes/example_3.py        writes example_3.png and example_3.pdf
"""

import matplotlib.pyplot as plt
import numpy as np
from scipy.special import ellipj, ellipk

from kcons.models.flows import HamiltonianFlow, hamiltonian, lagrange_residual, momentum

m, length, g = 1.5, 0.8, 9.81  # kg, m, m/s^2
omega = np.sqrt(g / length)


def lagrangian(q, v, t):
    """T - U. (The notes print m l^2/2 theta'^2 twice.)"""
    return 0.5 * m * length**2 * v[0] ** 2 - m * g * length * (1 - np.cos(q[0]))


# The momentum and H from the Lagrangian (eqs. 45, 48), against the formulas of the example.
theta, rate = 1.1, -0.6
p = momentum(lagrangian, [theta], [rate])
H = hamiltonian(lagrangian, [theta], p)
wanted = p[0] ** 2 / (2 * m * length**2) + m * g * length * (1 - np.cos(theta))
print(f"p = {p[0]:.9f}, m l^2 theta' = {m * length**2 * rate:.9f}; H = {H:.9f}, formula {wanted:.9f}")
residual = lagrange_residual(lagrangian, [theta], [rate], [-(omega**2) * np.sin(theta)])
print(f"Lagrange's equation holds for theta'' = -Omega^2 sin theta: residual {abs(residual[0]):.1e}")

# Hamilton's equations, integrated, against the exact solution by an elliptic function.
flow = HamiltonianFlow(lambda q, p, t: p[0] ** 2 / (2 * m * length**2) + m * g * length * (1 - np.cos(q[0])), 1)
fig, axes = plt.subplots(figsize=(7, 4.5), layout="constrained")
for theta0 in (0.5, 1.5, 2.5, 3.1):
    found = flow.solve((0.0, 4.0), [theta0, 0.0], t_eval=np.linspace(0, 4, 401))
    k = np.sin(theta0 / 2)
    exact = 2 * np.arcsin(k * ellipj(omega * found.t + ellipk(k**2), k**2)[0])
    energy = np.array([flow.energy(X) for X in found.y.T])
    axes.plot(found.y[0], found.y[1] / (m * length**2 * omega), label=rf"$\theta(0) = {theta0}$ rad")
    print(
        f"theta(0) = {theta0}: off the exact solution by {abs(found.y[0] - exact).max():.1e}, "
        f"energy kept to {np.ptp(energy) / energy[0]:.1e}"
    )
axes.set(xlabel=r"$x_1 = \theta$ (rad)", ylabel=r"$x_2 = p_\theta/(m l^2 \Omega)$ (rad)")
fig.legend(loc="outside upper center", ncols=4, fontsize=9)
for ending in ("png", "pdf"):
    fig.savefig(f"example_3.{ending}", dpi=120)
