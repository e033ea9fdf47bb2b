"""Dynamical systems as flows (notes sections 1 to 3).

- `flow`: a flow and its phase-space volume
- `equilibria`: where it rests
- `spectrum`, `imaginary_axis`, `jordan`: eigenvalues as far as they can be told
- `stability`: the classification of equilibria
- `linear_flow`: linear flows
- `hamiltonian`, `isokinetic_flow`, `variation`: mechanics as flows
- `known_flows`: flows with known solutions
"""

from kcons.models.flows.equilibria import Equilibrium, equilibrium_at, find_equilibria
from kcons.models.flows.flow import Flow, PhaseVolume, jacobian_by_differences, phase_volume
from kcons.models.flows.hamiltonian import HamiltonianFlow, SymplecticTrajectory
from kcons.models.flows.isokinetic_flow import Compression, Thermostat
from kcons.models.flows.jordan import (
    JordanBlocks,
    JordanForm,
    jordan_block,
    jordan_block_propagator,
    jordan_blocks,
    jordan_form,
)
from kcons.models.flows.known_flows import DampedOscillator, HarmonicOscillator, ParticleOnSphere, Pendulum
from kcons.models.flows.linear_flow import LinearFlow
from kcons.models.flows.stability import Classification, Kind, Stability, classify
from kcons.models.flows.variation import action, hamiltonian, lagrange_residual, momentum, velocity_of_momentum

__all__ = [
    "Classification",
    "Compression",
    "DampedOscillator",
    "Equilibrium",
    "Flow",
    "HamiltonianFlow",
    "HarmonicOscillator",
    "JordanBlocks",
    "JordanForm",
    "Kind",
    "LinearFlow",
    "ParticleOnSphere",
    "Pendulum",
    "PhaseVolume",
    "Stability",
    "SymplecticTrajectory",
    "Thermostat",
    "action",
    "classify",
    "equilibrium_at",
    "find_equilibria",
    "hamiltonian",
    "jacobian_by_differences",
    "jordan_block",
    "jordan_block_propagator",
    "jordan_blocks",
    "jordan_form",
    "lagrange_residual",
    "momentum",
    "phase_volume",
    "velocity_of_momentum",
]
