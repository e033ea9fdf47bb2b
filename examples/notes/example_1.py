"""Example 1: the harmonic oscillator by exp(At) (eqs. 7-19).

python examples/notes/example_1.py        writes example_1.png and example_1.pdf
"""

import matplotlib.pyplot as plt
import numpy as np

from kcons.models.flows import HarmonicOscillator

omega = 2.0
flow = HarmonicOscillator(omega)
A = flow.matrix

# The Jordan form of eqs. 16, 17: T J T^-1 = A.
form = flow.jordan_form()
print(f"eigenvalues {flow.eigenvalues()}; T J T^-1 - A: {abs(form.T @ form.J @ np.linalg.inv(form.T) - A).max():.1e}")

# exp(At) three ways (eqs. 9, 13, 18).
t = 0.7
series, term = np.eye(2), np.eye(2)
for n in range(1, 40):
    term = term @ A * t / n
    series = series + term
by_jordan = form.propagator(t).real
turn = np.array([[np.cos(omega * t), np.sin(omega * t)], [-np.sin(omega * t), np.cos(omega * t)]])
for name, P in (("series", series), ("Jordan form", by_jordan), ("rotation", turn)):
    print(f"exp(At) by {name:12s} differs from flow.propagator by {abs(P - flow.propagator(t)).max():.1e}")

times = np.linspace(0, 6, 300)
X = np.array([flow.closed_form(s) @ [1.0, 0.0] for s in times])  # eq. 19
fig, axes = plt.subplots(figsize=(6, 3.8), layout="constrained")
axes.plot(omega * times, X[:, 0], color="royalblue", label=r"$x_1 = \Omega x$")
axes.plot(omega * times, X[:, 1], color="crimson", linestyle="--", label=r"$x_2 = \dot x$")
axes.set(xlabel=r"time $\Omega t$ (dimensionless)", ylabel="$x_1$, $x_2$ (in parts of the amplitude)")
fig.legend(loc="outside upper center", ncols=2)
for ending in ("png", "pdf"):
    fig.savefig(f"example_1.{ending}", dpi=120)
