"""Figure 1: velocity field and a trajectory of the harmonic oscillator (eqs. 15, 19).

python examples/notes/figure_01.py        writes figure_01.png and figure_01.pdf
"""

import matplotlib.pyplot as plt
import numpy as np

from kcons.models.flows import HarmonicOscillator, classify

oscillator = HarmonicOscillator(omega=1.0)

fig, (left, right) = plt.subplots(1, 2, figsize=(9, 4.5), layout="constrained")

# The field V(X) = A X at the points of a grid.
x1, x2 = np.meshgrid(np.linspace(-2, 2, 17), np.linspace(-2, 2, 17))
V = np.einsum("kl,lij->kij", oscillator.matrix, np.array([x1, x2]))
left.quiver(x1, x2, *V)

# exp(At) turns the start (1, 0) on a circle.
t = np.linspace(0, 2 * np.pi, 200)
X = oscillator.exact(t, [1.0, 0.0])
right.plot(*X.T)
right.plot(1, 0, "ko")

for axes in (left, right):
    axes.set(xlabel=r"$x_1 = \Omega x$ (arbitrary units)", ylabel=r"$x_2 = \dot x$ (arbitrary units)", aspect="equal")
for ending in ("png", "pdf"):
    fig.savefig(f"figure_01.{ending}", dpi=120)
print(f"radius of the trajectory: 1 to within {abs(np.hypot(*X.T) - 1).max():.1e}; {classify(oscillator.matrix)}")
