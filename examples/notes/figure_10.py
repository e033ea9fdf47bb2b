"""Figure 10: the shape of the linear conditions A a = b on the accelerations (eqs. 90-98).

Two rows for two atoms, six accelerations: A has fewer rows than columns, and A+ b is the shortest solution. Drawn with
the numbers of an example: a distance that is kept, and the first atom on a plane.

python examples/notes/figure_10.py        writes figure_10.png and figure_10.pdf
"""

import matplotlib.pyplot as plt
import numpy as np

from kcons.constraints import projection

# Positions in nm and velocities in nm/ps. A distance between two atoms, and the first one on the plane z = 0.
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

fig, axes = plt.subplots(figsize=(9.5, 5.2), layout="constrained")
axes.set(xlim=(-1.7, 12.2), ylim=(6.9, -1.3), aspect="equal")
axes.set_axis_off()
# Cells of one size: A from x = 0 on, the accelerations from 7.5, b from 10.
pieces = (
    (A, 0.0, "$A$\n$s \\times 3N = 2 \\times 6$"),
    (shortest, 7.5, "$\\ddot x$\n$3N = 6$"),
    (b, 10.0, "$b$\n$s = 2$"),
)
for numbers, left, title in pieces:
    matrix = np.round(numbers.reshape(len(numbers), -1), 12) + 0.0
    for (i, j), number in np.ndenumerate(matrix):
        color = "white" if number == 0.0 else "lightsteelblue" if number > 0 else "mistyrose"
        axes.add_patch(plt.Rectangle((left + j, i), 1, 1, facecolor=color, edgecolor="0.3"))
        axes.text(
            left + j + 0.5, i + 0.5, f"{number:.3f}".rstrip("0").rstrip("."), ha="center", va="center", fontsize=9
        )
    axes.text(left + 0.5 * matrix.shape[1], -0.55, title, ha="center", va="bottom", fontsize=11)
for j, name in enumerate(("$x_1$", "$y_1$", "$z_1$", "$x_2$", "$y_2$", "$z_2$")):
    axes.text(j + 0.5, -0.08, name, ha="center", va="bottom", fontsize=9)
    axes.text(8.6, j + 0.5, name.replace("$", "$\\ddot ", 1), va="center", fontsize=9)
for i, (row, unit) in enumerate((("distance", "nm$^2$/ps$^2$"), ("plane", "nm/ps$^2$"))):
    axes.text(-0.15, i + 0.5, row, ha="right", va="center", fontsize=9)
    axes.text(11.15, i + 0.5, unit, va="center", fontsize=9)
axes.text(6.75, 1.0, r"$\cdot$", ha="center", va="center", fontsize=22)
axes.text(9.5, 1.0, "=", ha="center", va="center", fontsize=16)
axes.text(3.0, 2.35, "first row in nm, second row without unit", ha="center", va="center", fontsize=9)
axes.text(8.0, 6.35, "in nm/ps$^2$", ha="center", va="center", fontsize=9)
axes.text(
    3.0,
    4.6,
    "fewer rows than columns: many solutions $\\ddot x$.\nShown is the shortest one, $A^+ b$ (98);\n"
    "all others add what $A$ does not see (93).\nBlue: positive, red: negative.",
    ha="center",
    va="center",
    fontsize=9,
)
for ending in ("png", "pdf"):
    fig.savefig(f"figure_10.{ending}", dpi=120)
