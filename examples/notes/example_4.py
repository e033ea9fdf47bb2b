"""Example 4: a particle on a sphere (eqs. 108-110).

The acceleration of the projection formalism (eq. 105) is the formula of the example (eq. 110). Free, the particle
follows a great circle; under gravity it is a spherical pendulum.

python examples/notes/example_4.py        writes example_4.png and example_4.pdf
"""

import matplotlib.pyplot as plt
import numpy as np

from kcons.constraints import projection
from kcons.models.flows import ParticleOnSphere

R, m = 1.0, 2.0  # m, kg
gravity = np.array([0.0, 0.0, -m * 9.81])
x0, v0 = np.array([0.8, 0.0, -0.6]), np.array([0.0, 1.5, 0.0])  # m, m/s

# sigma = x.x - R^2: A = 2 x^T, b = -2 v.v. (The notes print A = v^T.)
by_projection = projection.acceleration(2 * x0[None, :], [m], gravity, [-2 * v0 @ v0])
by_formula = ParticleOnSphere(R, m, lambda x: gravity).acceleration(x0, v0)
print(f"accelerations by (105) and (110) differ by {abs(by_projection - by_formula).max():.1e}")

free, falling = ParticleOnSphere(R, m), ParticleOnSphere(R, m, lambda x: gravity)
t = np.linspace(0, 4, 500)
circle = free.solve((0, 4), np.concatenate([x0, v0]), t_eval=t, rtol=1e-12, atol=1e-13).y[:3].T
swing = falling.solve((0, 4), np.concatenate([x0, v0]), t_eval=t).y[:3].T
print(
    f"radius along the free path: {R} to {abs(np.linalg.norm(circle, axis=1) - R).max():.0e}; "
    f"of the integrated swing to {abs(np.linalg.norm(swing, axis=1) - R).max():.0e}: it drifts"
)

fig = plt.figure(figsize=(6.5, 6), layout="constrained")
axes = fig.add_subplot(projection="3d")
polar, around = np.meshgrid(np.linspace(0, np.pi, 13), np.linspace(0, 2 * np.pi, 25))
globe = R * np.array([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)])
axes.plot_wireframe(*globe, color="0.85", linewidth=0.5)
axes.plot(*circle.T, color="royalblue", label="free: a great circle")
axes.plot(*swing.T, color="crimson", linestyle="--", label="under gravity, 4 s")
axes.plot(*x0, "ko", label="start")
axes.set(xlabel="$x$ (m)", ylabel="$y$ (m)", zlabel="$z$ (m)", box_aspect=(1, 1, 1))
axes.set(xticks=(-1, 0, 1), yticks=(-1, 0, 1), zticks=(-1, 0, 1))
axes.view_init(elev=18, azim=-50)
fig.legend(loc="outside upper center", ncols=3)
for ending in ("png", "pdf"):
    fig.savefig(f"example_4.{ending}", dpi=120)
