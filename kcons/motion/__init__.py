"""The engine: what constraints do to positions, velocities, accelerations and forces.

- `motion`: `Motion`, the engine itself
- `solver_sequence`: all solvers of a plan, one after another, and what helps where one of them fails
- `certificate`: results checked by the constraints as they were given
- `failures`: what to tell the user where a solve failed
- `report`: what is held, how well, and condition numbers of clusters
- `restoring`: positions that are off, brought onto the constraints
- `minimization`: statics
"""

from kcons.motion.minimization import Minimum, minimize
from kcons.motion.motion import Motion

__all__ = ["Minimum", "Motion", "minimize"]
