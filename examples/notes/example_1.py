"""Example 1: the harmonic oscillator by exp(At) (eqs. 7-19).

python examples/notes/example_1.py        writes example_1.png
"""

import matplotlib.pyplot as plt
import numpy as np

from kcons.flows import HarmonicOscillator

omega = 2.0
flow = HarmonicOscillator(omega)
A = flow.matrix

# The Jordan form of eqs. 16, 17: T J T^-1 = A.
T = np.array([[1j, -1j], [1, 1]])
J = np.diag([-1j * omega, 1j * omega])
print(f"eigenvalues {flow.eigenvalues()}; T J T^-1 - A: {abs(T @ J @ np.linalg.inv(T) - A).max():.1e}")

# exp(At) three ways (eqs. 9, 13, 18).
t = 0.7
series, term = np.eye(2), np.eye(2)
for n in range(1, 40):
    term = term @ A * t / n
    series = series + term
by_jordan = (T @ np.diag(np.exp(np.diag(J) * t)) @ np.linalg.inv(T)).real
turn = np.array([[np.cos(omega * t), np.sin(omega * t)], [-np.sin(omega * t), np.cos(omega * t)]])
for name, P in (("series", series), ("Jordan form", by_jordan), ("rotation", turn)):
    print(f"exp(At) by {name:12s} differs from flow.propagator by {abs(P - flow.propagator(t)).max():.1e}")

times = np.linspace(0, 6, 300)
fig, axes = plt.subplots(figsize=(5, 3), layout="constrained")
axes.plot(times, flow.circle(times, [1.0, 0.0]), label=["$x_1$", "$x_2$"])
axes.set(xlabel="$t$")
axes.legend()
fig.savefig("example_1.png", dpi=120)
