"""The Gaussian isokinetic thermostat: constant kinetic energy as a velocity constraint.

- `kick`: the kick at fixed positions in closed form, and as an operation of compiled steps
- `isokinetic`: the thermostat, its steps, and the atoms that they act on
"""

from kcons.thermostats.isokinetic.isokinetic import Convention, Isokinetic

__all__ = ["Convention", "Isokinetic"]
