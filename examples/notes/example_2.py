"""Example 2: the oscillator with friction in its three regimes (eqs. 20-25).

At eta = 2 Omega the two eigenvalues meet and A is defective: the Jordan form of the notes, diag with T of eq. 24, does
not exist there, yet exp(At) passes smoothly through.

python examples/notes/example_2.py        writes example_2.png and example_2.pdf
"""

import matplotlib.pyplot as plt
import numpy as np

from kcons.models.flows import DampedOscillator, classify, phase_volume

t = np.linspace(0, 15, 400)
fig, (left, right) = plt.subplots(1, 2, figsize=(10, 4.2), layout="constrained")
for eta in (0.2, 1.0, 2.0, 5.0):
    flow = DampedOscillator(1.0, eta)
    X = np.array([flow.closed_form(s) @ [1.0, 0.0] for s in t])
    left.plot(t, X[:, 0], label=rf"$\eta = {eta}\,\Omega$")
    right.plot(*X.T)
    blocks = [b.sizes for b in flow.jordan_form().blocks]
    volume = phase_volume(flow, [1.0, 0.0], [0.0, 3.0]).log_volume[-1]
    print(
        f"eta = {eta}: {classify(flow.matrix)}, Jordan blocks {blocks}, "
        f"ln of the phase volume after t = 3: {volume:.6f} = -3 eta"
    )
left.set(xlabel=r"time $\Omega t$ (dimensionless)", ylabel=r"$x_1 = \Omega x$ (in parts of the start)")
right.set(xlabel=r"$x_1 = \Omega x$ (in parts of the start)", ylabel=r"$x_2 = \dot x$ (in parts of the start)")
fig.legend(loc="outside upper center", ncols=4, fontsize=9)
for ending in ("png", "pdf"):
    fig.savefig(f"example_2.{ending}", dpi=120)
