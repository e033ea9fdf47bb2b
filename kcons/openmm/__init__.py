"""OpenMM: integrators that hold constraints by projection.

Swap the integrator of a Simulation, and what the System constrains is held to order 2, 4 or 6, together with
collective variables, surfaces and the constraint objects of kcons.
"""

from kcons.openmm.carrier import CarriedConstraints
from kcons.openmm.collective import CollectiveRows
from kcons.openmm.compiled import RattleIntegrator
from kcons.openmm.implicit_rows import ExpressionSurface
from kcons.openmm.isokinetic import Isokinetic
from kcons.openmm.langevin import Langevin
from kcons.openmm.projected import ProjectedIntegrator
from kcons.openmm.row_forces import Row, each_term
from kcons.openmm.surface import SurfaceIntegrator, surface_parts
from kcons.openmm.topology import constraints_of
from kcons.openmm.transfer import hold, take_constraints

__all__ = [
    "CarriedConstraints",
    "CollectiveRows",
    "ExpressionSurface",
    "Isokinetic",
    "Langevin",
    "ProjectedIntegrator",
    "RattleIntegrator",
    "Row",
    "SurfaceIntegrator",
    "constraints_of",
    "each_term",
    "hold",
    "surface_parts",
    "take_constraints",
]
