"""Dynamical systems as flows (notes sections 1 to 3).

- `flow`: a flow and its phase-space volume
- `linear`: linear flows: eigenvalues as far as they can be told, Jordan form, stability; where a flow rests
- `mechanics`: from a Lagrangian to Hamilton's equations
- `known_flows`: flows with known solutions
"""

from kcons.models.flows.flow import Flow, PhaseVolume, phase_volume
from kcons.models.flows.known_flows import (
    Compression,
    DampedOscillator,
    HarmonicOscillator,
    ParticleOnSphere,
    Pendulum,
    Thermostat,
)
from kcons.models.flows.linear import (
    Classification,
    Equilibrium,
    JordanBlocks,
    JordanForm,
    Kind,
    LinearFlow,
    Stability,
    classify,
    equilibrium_at,
    find_equilibria,
    jordan_block,
    jordan_block_propagator,
    jordan_form,
)
from kcons.models.flows.mechanics import (
    HamiltonianFlow,
    action,
    hamiltonian,
    lagrange_residual,
    momentum,
    velocity_of_momentum,
)
from kcons.models.integration import jacobian_by_differences

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
    "Thermostat",
    "action",
    "classify",
    "equilibrium_at",
    "find_equilibria",
    "hamiltonian",
    "jacobian_by_differences",
    "jordan_block",
    "jordan_block_propagator",
    "jordan_form",
    "lagrange_residual",
    "momentum",
    "phase_volume",
    "velocity_of_momentum",
]
