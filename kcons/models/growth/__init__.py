"""Populations that grow under constraints (notes sections 3 and 4.3).

- `model`, `mixture`, `hypercycle`: models of growth, and the thermodynamics of their species
- `rows`, `entropy`: what is held
- `constrained`: a model with what is held
- `solution`: trajectories
"""

from kcons.models.growth.constrained import ConstrainedGrowth
from kcons.models.growth.entropy import EntropyRow, NoProduction, PrescribedProduction, Relaxation
from kcons.models.growth.hypercycle import ConstrainedHypercycle, Hypercycle
from kcons.models.growth.mixture import Mixture
from kcons.models.growth.model import GrowthModel, Logistic, LotkaVolterra, Populations
from kcons.models.growth.rows import HolonomicRow, LinearRow, Row, TotalPopulation, VelocityRow
from kcons.models.growth.solution import GrowthSolution, entropy_balance, solve

__all__ = [
    "ConstrainedGrowth",
    "ConstrainedHypercycle",
    "EntropyRow",
    "GrowthModel",
    "GrowthSolution",
    "HolonomicRow",
    "Hypercycle",
    "LinearRow",
    "Logistic",
    "LotkaVolterra",
    "Mixture",
    "NoProduction",
    "Populations",
    "PrescribedProduction",
    "Relaxation",
    "Row",
    "TotalPopulation",
    "VelocityRow",
    "entropy_balance",
    "solve",
]
