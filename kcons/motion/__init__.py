"""The engine: what constraints do to positions, velocities, accelerations and forces.

- `motion`: `Motion`, the engine itself
- `solver_sequence`: all solvers of a plan, one after another; what helps where one of them fails, and what is said
- `certificate`: results checked by the constraints as they were given
- `report`: what is held, how well, and condition numbers of clusters
- `restoring`: positions that are off, brought onto the constraints
- `minimization`: statics
"""

from kcons.motion.minimization import Minimum, minimize
from kcons.motion.motion import Motion

__all__ = ["Minimum", "Motion", "minimize"]
