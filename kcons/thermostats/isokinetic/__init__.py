"""The Gaussian isokinetic thermostat: constant kinetic energy as a velocity constraint.

- `kick`: the kick at fixed positions in closed form, and as an operation of compiled steps
- `step`: steps, and the atoms that they act on
- `isokinetic`: the thermostat
"""

from kcons.thermostats.isokinetic.isokinetic import Convention, Isokinetic

__all__ = ["Convention", "Isokinetic"]
