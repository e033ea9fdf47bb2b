"""OpenMM: integrators that hold constraints by projection.

Swap the integrator of a Simulation, and what the System constrains is held to order 2, 4 or 6, together with
collective variables, surfaces and the constraint objects of kcons.

- `quantities`: numbers with units, and what a Context says of its state
- `topology`: constraints by name
- `integrator`: the integrators and the programs they run
- `ensembles`: Langevin, isokinetic, Nosé-Hoover
- `collective`: collective variables
- `callback_rows`: constraint objects of kcons
- `surface_integrator`: particles on surfaces
- `device`: steps as kernels of a plugin
"""

from kcons.errors import with_extra

try:
    from kcons.openmm import ensembles
    from kcons.openmm.callback_rows import CarriedConstraints, hold, move_constraints
    from kcons.openmm.collective.collective_rows import CollectiveRows
    from kcons.openmm.collective.coordinates import Row
    from kcons.openmm.device.device_integrator import DeviceIntegrator
    from kcons.openmm.ensembles import *
    from kcons.openmm.integrator.guard import worst_length
    from kcons.openmm.integrator.part import Precision
    from kcons.openmm.integrator.program import SCHEMES
    from kcons.openmm.integrator.projected import ProjectedIntegrator
    from kcons.openmm.quantities import masses_of, positions_of, velocities_of
    from kcons.openmm.surface_integrator import SurfaceIntegrator
    from kcons.openmm.topology import constraints_of
except ModuleNotFoundError as error:
    raise with_extra(error, "kcons.openmm") from error

__all__ = [
    "SCHEMES",
    "CarriedConstraints",
    "CollectiveRows",
    "DeviceIntegrator",
    "Precision",
    "ProjectedIntegrator",
    "Row",
    "SurfaceIntegrator",
    "constraints_of",
    "hold",
    "masses_of",
    "move_constraints",
    "positions_of",
    "velocities_of",
    "worst_length",
]
__all__ += ensembles.__all__
