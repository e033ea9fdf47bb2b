"""Populations that grow under constraints (notes sections 3 and 4.3)."""

from kcons.growth.constrained import ConstrainedGrowth
from kcons.growth.ensemble import EnsembleSolution, solve_ensemble
from kcons.growth.entropy import EntropyRow, NoProduction, PrescribedProduction, Relaxation, entropy_balance
from kcons.growth.hypercycle import ConstrainedHypercycle, Hypercycle
from kcons.growth.integration import GrowthSolution, solve
from kcons.growth.mixture import Mixture
from kcons.growth.model import GrowthModel, Populations
from kcons.growth.models import Logistic, LotkaVolterra
from kcons.growth.rows import HolonomicRow, LinearRow, Row, TotalPopulation, VelocityRow

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
