"""Several time steps on constraints: cheap forces often, expensive ones seldom.

- `force_groups`: forces in groups, and those of each group on the way through a step
- `nesting`: the operations of a step
- `respa`: Langevin dynamics with several time steps
- `sphere_kernels`: what happens on spheres, compiled
- `spheres`: stochastic isokinetic baths, and which velocities share a sphere
"""

from kcons.thermostats.multistep.force_groups import ForceGroups
from kcons.thermostats.multistep.respa import LangevinRespa
from kcons.thermostats.multistep.spheres import IsokineticSpheres

__all__ = ["ForceGroups", "IsokineticSpheres", "LangevinRespa"]
