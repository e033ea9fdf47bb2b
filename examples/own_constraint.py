"""Constraints of one's own: a formula and a Python function hold two beads, and the forces that hold them are read.

Run with ``python examples/own_constraint.py``; a few seconds.
"""

import numpy as np

from kcons import ConstraintSet, Motion, System, run
from kcons.constraints import Custom, Distance, Formula
from kcons.free_energy import HeldCoordinates, Recorder

# Two beads on a rod. The first is in a bowl, z = k (x² + y²), which its formula says; any consistent units.
x = np.array([[1.0, 0.0, 0.5], [1.0, 0.0, 1.5]])
masses = np.array([1.0, 2.0])
bowl = Formula("z1 - k*(x1**2 + y1**2)", [0], {"k": 0.5})
rod = Distance([[0, 1]])

# The second is on a surface for which there is no formula in text: a function that stays what it is at the start.
egg = Custom([1], lambda r: np.sum(r[0] ** 4) - 3.0 * r[0, 0], target=None)

motion = Motion(ConstraintSet([bowl, rod, egg], x, masses), x)
print(f"{motion.rank} independent constraints leave {motion.degrees_of_freedom} degrees of freedom")

gravity = np.array([0.0, 0.0, -1.0]) * masses[:, None]
system = System(motion, lambda x, t: gravity)
start = system.initial_state(x, motion.project_velocities(x, np.array([[0.0, 0.5, 0.0], [0.0, 0.5, 0.0]])))


def energy(state):
    return system.kinetic_energy(state.velocities) - np.sum(gravity * state.positions)


recorder = Recorder(system, HeldCoordinates(motion, {"bowl": bowl, "rod": rod, "egg": egg}, x))
print("\ntime   energy - start   force of the bowl, the rod, the egg")


def show(state):
    forces = "".join(f"{force:10.4f}" for force in recorder.series.multiplier[-1])
    print(f"{state.time:4.1f} {energy(state) - energy(start):16.1e} {forces}")


end = run(system, start, 0.01, 500, observers=[recorder, show], every=100)
off = np.abs(motion.constraint_set.value(end.positions)).max()
print(f"\noff the constraints by {off:.0e} at most")
assert off < 1e-12
