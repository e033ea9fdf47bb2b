"""Several time steps on constraints: cheap forces often, expensive ones seldom.

- `force_groups`: forces in groups, and how often each was asked for
- `nesting`: the operations of a step
- `grouped_forces`: the forces of each group on the way through a step
- `respa`: Langevin dynamics with several time steps
- `sphere_layout`: which velocities share a sphere
- `sphere_kernels`: what happens on spheres, compiled
- `spheres`: stochastic isokinetic baths
"""

from kcons.thermostats.multistep.force_groups import ForceGroups
from kcons.thermostats.multistep.respa import LangevinRespa
from kcons.thermostats.multistep.spheres import IsokineticSpheres

__all__ = ["ForceGroups", "IsokineticSpheres", "LangevinRespa"]
