"""A free particle on a torus: its path is a geodesic, and its speed never changes.

python torus.py [FOLDER] [FRAMES]     writes torus.gif
"""

import sys

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter

from kcons import ConstraintSet, Motion, State, System, run
from kcons.constraints import Torus
from kcons.steppers import BlanesMoan6

folder, frames = (sys.argv[1:] + [".", "100"][len(sys.argv) - 1 :])[:2]
x = np.array([[3.0, 0.0, 0.0]])
motion = Motion(ConstraintSet([Torus([0], [0, 0, 0], [0, 0, 1], 2.0, 1.0)], x, np.ones(1)), x)
start = State(x, np.array([[0.0, 1.0, 0.4]]))
path = []
run(System(motion), start, 0.05, 8 * int(frames), stepper=BlanesMoan6(), observers=[path.append], every=4)
speeds = [np.linalg.norm(state.velocities) for state in path]
at = np.array([state.positions[0] for state in path])
print(f"speed kept to {np.ptp(speeds):.1e}")
assert np.ptp(speeds) < 1e-9

u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 60), np.linspace(0, 2 * np.pi, 30))
figure = plt.figure(figsize=(4, 3.4), layout="constrained")
axes = figure.add_subplot(projection="3d")
axes.plot_wireframe(
    (2 + np.cos(v)) * np.cos(u), (2 + np.cos(v)) * np.sin(u), np.sin(v), color="0.8", lw=0.4, rstride=2, cstride=2
)
axes.set(zlim=(-2, 2), box_aspect=(3, 3, 2))
axes.view_init(50, 30)
axes.set_axis_off()
(line,) = axes.plot([], [], [], color="#0072B2", lw=1.2)
(dot,) = axes.plot([], [], [], "o", color="#D55E00")


def show(k: int) -> None:
    line.set_data_3d(*at[: 2 * k + 1].T)
    dot.set_data_3d(*at[2 * k : 2 * k + 1].T)


FuncAnimation(figure, show, int(frames)).save(f"{folder}/torus.gif", PillowWriter(fps=20), dpi=60)
