"""Several time steps on constraints: cheap forces often, expensive ones seldom.

- `respa`: forces in groups, the operations of a step, and Langevin dynamics with several time steps
- `sphere_kernels`: what happens on spheres, compiled
- `spheres`: stochastic isokinetic baths, and which velocities share a sphere
"""

from kcons.thermostats.multistep.respa import ForceGroups, LangevinRespa
from kcons.thermostats.multistep.spheres import IsokineticSpheres

__all__ = ["ForceGroups", "IsokineticSpheres", "LangevinRespa"]
