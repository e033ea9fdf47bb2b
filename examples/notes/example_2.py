"""Example 2: the oscillator with friction in its three regimes (eqs. 20-25).

At eta = 2 Omega the two eigenvalues meet and A is defective: the Jordan form of the notes, diag with T of eq. 24, does
not exist there, yet exp(At) passes smoothly through.

python examples/notes/example_2.py        writes example_2.png
"""

import matplotlib.pyplot as plt
import numpy as np

from kcons.flows import DampedOscillator, phase_volume

t = np.linspace(0, 15, 400)
fig, (left, right) = plt.subplots(1, 2, figsize=(9, 3.5), layout="constrained")
for eta in (0.2, 1.0, 2.0, 5.0):
    flow = DampedOscillator(1.0, eta)
    X = np.array([flow.closed_form(s) @ [1.0, 0.0] for s in t])
    left.plot(t, X[:, 0], label=rf"$\eta = {eta}$, {flow.regime}")
    right.plot(*X.T)
    blocks = [b.sizes for b in flow.jordan_blocks()]
    volume = phase_volume(flow, [1.0, 0.0], [0.0, 3.0]).log_volume[-1]
    print(
        f"eta = {eta}: {flow.regime}, {flow.classification()}, Jordan blocks {blocks}, "
        f"ln of the phase volume after t = 3: {volume:.6f} = -3 eta"
    )
left.set(xlabel="$t$", ylabel="$x_1$")
left.legend(fontsize=8)
right.set(xlabel="$x_1$", ylabel="$x_2$")
fig.savefig("example_2.png", dpi=120)
