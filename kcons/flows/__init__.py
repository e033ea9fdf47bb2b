"""Dynamical systems as flows (notes sections 1 to 3)."""

from kcons.flows.equilibria import Equilibrium, equilibrium_at, find_equilibria
from kcons.flows.flow import Flow, PhaseVolume, jacobian_by_differences, phase_volume
from kcons.flows.hamiltonian import HamiltonianFlow, SymplecticTrajectory
from kcons.flows.isokinetic import Compression, Thermostat
from kcons.flows.jordan import (
    JordanBlocks,
    JordanForm,
    jordan_block,
    jordan_block_propagator,
    jordan_blocks,
    jordan_form,
)
from kcons.flows.linear import LinearFlow
from kcons.flows.models import DampedOscillator, HarmonicOscillator, ParticleOnSphere, Pendulum
from kcons.flows.stability import Classification, Kind, Stability, classify
from kcons.flows.variation import action, hamiltonian, lagrange_residual, momentum, velocity_of_momentum

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
