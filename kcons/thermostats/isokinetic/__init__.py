"""The Gaussian isokinetic thermostat: constant kinetic energy as a velocity constraint.

- `kick`: the kick at fixed positions in closed form
- `step`: one step, and the atoms it acts on
- `fused_step`: the two halves of a step in one compiled call each
- `isokinetic`: the thermostat
"""

from kcons.thermostats.isokinetic.isokinetic import Convention, Isokinetic

__all__ = ["Convention", "Isokinetic"]
