"""A wheel that rolls down a slope without slipping: a nonholonomic constraint. It falls behind one that slides.

python rolling_wheel.py [FOLDER] [FRAMES]     writes rolling_wheel.gif
"""

import sys

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter

from kcons import ConstraintSet, Motion, State, System, run
from kcons.constraints import Distance, Plane, VelocityFormula

folder, frames = (sys.argv[1:] + [".", "80"][len(sys.argv) - 1 :])[:2]
slope, radius = np.radians(10), 1.0
#: The speed of the hub along the slope, less R times the rate at which a point of the rim turns about it.
ROLLS = "c*vx1 - s*vz1 - R*((z2 - z1)*(vx2 - vx1) - (x2 - x1)*(vz2 - vz1))/((x2 - x1)**2 + (z2 - z1)**2)"
along, up = np.array([np.cos(slope), 0, -np.sin(slope)]), np.array([np.sin(slope), 0, np.cos(slope)])
# A hub, and three masses on the rim.
turns = np.radians([0, 120, 240])[:, None]
hub = radius * up
x = np.vstack([hub, hub + radius * (np.cos(turns) * along + np.sin(turns) * up)])
masses = np.array([0.5, 1.0, 1.0, 1.0])
held = [
    Plane([0], up, radius),  # the hub keeps its height above the slope
    Plane([0, 1, 2, 3], [0.0, 1.0, 0.0], 0.0),
    Distance([[0, 1], [0, 2], [0, 3], [1, 2], [2, 3]]),
    VelocityFormula(ROLLS, [0, 1], {"R": radius, "s": np.sin(slope), "c": np.cos(slope)}),
]
motion = Motion(ConstraintSet(held, x, masses), x)
weight = masses[:, None] * np.array([0.0, 0.0, -9.81])
path, start = [], State(x, np.zeros_like(x))
end = run(System(motion, lambda x, t: weight), start, 0.005, 5 * int(frames), observers=[path.append], every=5)
far = (end.positions[0] - x[0]) @ along
exact = 9.81 * np.sin(slope) * masses.sum() / (masses.sum() + 3.0) * end.time**2 / 2
print(f"rolled {far:.5f} m, by theory {exact:.5f} m")
assert abs(far / exact - 1) < 1e-3

figure, axes = plt.subplots(figsize=(6, 2.4), layout="constrained")
axes.set(xlim=(-1.5, far + 1.5), ylim=(-far * np.tan(slope) - 0.5, 2.2), aspect="equal", xlabel="x / m", ylabel="z / m")
ground = np.linspace(-3, far + 3, 2)
axes.plot(ground, -np.tan(slope) * ground, color="0.5")
(rim,) = axes.plot([], [], color="#0072B2")
(spokes,) = axes.plot([], [], "o-", color="#D55E00")
circle = np.linspace(0, 2 * np.pi, 80)


def show(k: int) -> None:
    at = path[k].positions
    rim.set_data(at[0, 0] + radius * np.cos(circle), at[0, 2] + radius * np.sin(circle))
    spokes.set_data(at[[1, 0, 2, 0, 3], 0], at[[1, 0, 2, 0, 3], 2])


FuncAnimation(figure, show, len(path)).save(f"{folder}/rolling_wheel.gif", PillowWriter(fps=20), dpi=60)
