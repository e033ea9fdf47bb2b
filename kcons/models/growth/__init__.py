"""Populations that grow under constraints (notes sections 3 and 4.3).

- `model`: models of growth, and the thermodynamics of their species
- `rows`: what is held, a production of entropy among it
- `constrained`: a model with what is held, and its trajectories
- `hypercycle`: the hypercycle of Eigen and Schuster
"""

from kcons.models.growth.constrained import ConstrainedGrowth, GrowthSolution, entropy_balance, solve
from kcons.models.growth.hypercycle import ConstrainedHypercycle, Hypercycle
from kcons.models.growth.model import GrowthModel, Logistic, LotkaVolterra, Mixture, Populations
from kcons.models.growth.rows import EntropyRow, HolonomicRow, LinearRow, Row, TotalPopulation, VelocityRow

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
    "Populations",
    "Row",
    "TotalPopulation",
    "VelocityRow",
    "entropy_balance",
    "solve",
]
