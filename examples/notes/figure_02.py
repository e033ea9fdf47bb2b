"""Figure 2: velocity field and a trajectory of the oscillator with friction (eqs. 22, 25).

python examples/notes/figure_02.py        writes figure_02.png and figure_02.pdf
"""

import matplotlib.pyplot as plt
import numpy as np

from kcons.models.flows import DampedOscillator, classify

oscillator = DampedOscillator(omega=1.0, eta=0.2)

fig, (left, right) = plt.subplots(1, 2, figsize=(9, 4.5), layout="constrained")

x1, x2 = np.meshgrid(np.linspace(-2, 2, 17), np.linspace(-2, 2, 17))
V = np.einsum("kl,lij->kij", oscillator.matrix, np.array([x1, x2]))
left.quiver(x1, x2, *V)

# The closed form (25), one formula for all regimes.
t = np.linspace(0, 40, 800)
X = np.array([oscillator.closed_form(s) @ [1.0, 0.0] for s in t])
right.plot(*X.T)
right.plot(1, 0, "ko")

for axes in (left, right):
    axes.set(xlabel=r"$x_1 = \Omega x$ (arbitrary units)", ylabel=r"$x_2 = \dot x$ (arbitrary units)", aspect="equal")
for ending in ("png", "pdf"):
    fig.savefig(f"figure_02.{ending}", dpi=120)
print(f"eigenvalues {oscillator.eigenvalues()}; {classify(oscillator.matrix)}")
