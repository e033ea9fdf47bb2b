"""A double pendulum: two rods, gravity, order 6. Energy is kept to 1e-9 while the motion is chaotic.

python double_pendulum.py [FOLDER] [FRAMES]     writes double_pendulum.gif
"""

import sys

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter

from kcons import ConstraintSet, Motion, State, System, run
from kcons.constraints import Distance, FixedAtoms
from kcons.steppers import BlanesMoan6

folder, frames = (sys.argv[1:] + [".", "120"][len(sys.argv) - 1 :])[:2]
x = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 1.0]])  # the pivot, and two bobs
masses = np.array([1.0, 1.0, 1.0])
motion = Motion(ConstraintSet([FixedAtoms([0]), Distance([[0, 1], [1, 2]])], x, masses), x)
gravity = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -9.81], [0.0, 0.0, -9.81]])
system = System(motion, lambda x, t: gravity, potential=lambda x, t: -float((gravity * x).sum()))
start = State(x, np.zeros_like(x))
path = []
run(system, start, 0.005, 10 * int(frames), stepper=BlanesMoan6(), observers=[path.append], every=10)
energies = [system.total_energy(state) for state in path]
at = np.array([state.positions for state in path])
print(f"energy kept to {np.ptp(energies):.1e} of {9.81:.2f}")
assert np.ptp(energies) < 1e-6

figure, axes = plt.subplots(figsize=(4, 4), layout="constrained")
axes.set(xlim=(-2.1, 2.1), ylim=(-2.1, 2.1), aspect="equal", xlabel="x / m", ylabel="z / m")
(trace,) = axes.plot([], [], color="#D55E00", lw=0.8)
(rods,) = axes.plot([], [], "o-", color="#0072B2", lw=2)


def show(k: int) -> None:
    rods.set_data(at[k, :, 0], at[k, :, 2])
    trace.set_data(at[max(0, k - 40) : k + 1, 2, 0], at[max(0, k - 40) : k + 1, 2, 2])


FuncAnimation(figure, show, len(path)).save(f"{folder}/double_pendulum.gif", PillowWriter(fps=20), dpi=60)
