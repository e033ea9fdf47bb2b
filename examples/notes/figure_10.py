"""Figure 10: the shape of the linear conditions A a = b on the accelerations (eqs. 90-98).

Two rows for two atoms, six accelerations: A has fewer rows than columns, and A+ b is the shortest solution.

python examples/notes/figure_10.py        writes figure_10.png
"""

import matplotlib.pyplot as plt
import numpy as np

from kcons import projection

# A distance between two atoms, and the first one on the plane z = 0.
x = np.array([[0.0, 0.0, 0.0], [0.6, 0.3, 0.8]])
v = np.array([[0.2, -0.1, 0.0], [0.1, 0.3, 0.0]])
v[1, 2] = -np.dot(x[1, :2] - x[0, :2], v[1, :2] - v[0, :2]) / (x[1, 2] - x[0, 2])  # tangent: r . dv = 0
r, w = x[1] - x[0], v[1] - v[0]
A = np.array([np.concatenate([-2 * r, 2 * r]), [0, 0, 1, 0, 0, 0]])
b = np.array([-2 * w @ w, 0.0])

shortest = projection.pseudo_inverse(A).matrix @ b
other = projection.general_solution(A, b, np.arange(6.0))
print(f"residuals of A a = b: {abs(A @ shortest - b).max():.1e} and {abs(A @ other - b).max():.1e}")
print(f"lengths: A+ b has {np.linalg.norm(shortest):.4f}, another solution {np.linalg.norm(other):.4f}")

fig, panels = plt.subplots(1, 3, figsize=(7, 2.6), width_ratios=[6, 1, 1], layout="constrained")
limit = abs(A).max()
for axes, matrix, name in zip(
    panels, (A, shortest[:, None], b[:, None]), ("$A\\ (s \\times 3N)$", "$\\ddot x$", "$b$"), strict=True
):
    axes.imshow(matrix, cmap="RdBu", vmin=-limit, vmax=limit)
    axes.set(title=name, xticks=[], yticks=[])
fig.savefig("figure_10.png", dpi=120)
