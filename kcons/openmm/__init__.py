"""OpenMM: integrators that hold constraints by projection.

Swap the integrator of a Simulation, and what the System constrains is held to order 2, 4 or 6, together with
collective variables, surfaces and the constraint objects of kcons.
"""

from kcons.openmm.carrier import CarriedConstraints
from kcons.openmm.projected import ProjectedIntegrator
from kcons.openmm.transfer import hold, take_constraints

__all__ = ["CarriedConstraints", "ProjectedIntegrator", "hold", "take_constraints"]
