"""Populations that grow under constraints (notes sections 3 and 4.3).

- `model`, `simple_models`, `hypercycle`, `mixture`: models of growth
- `rows`, `orthogonal_rows`, `entropy`: what is held
- `constrained`: a model with what is held
- `compensated_sums`, `integration`, `many_trajectories`: one trajectory, and many
"""

from kcons.models.growth.constrained import ConstrainedGrowth
from kcons.models.growth.entropy import EntropyRow, NoProduction, PrescribedProduction, Relaxation, entropy_balance
from kcons.models.growth.hypercycle import ConstrainedHypercycle, Hypercycle
from kcons.models.growth.integration import GrowthSolution, solve
from kcons.models.growth.many_trajectories import EnsembleSolution, solve_ensemble
from kcons.models.growth.mixture import Mixture
from kcons.models.growth.model import GrowthModel, Populations
from kcons.models.growth.rows import HolonomicRow, LinearRow, Row, TotalPopulation, VelocityRow
from kcons.models.growth.simple_models import Logistic, LotkaVolterra

__all__ = [
    "ConstrainedGrowth",
    "ConstrainedHypercycle",
    "EnsembleSolution",
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
    "solve_ensemble",
]
