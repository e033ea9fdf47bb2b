"""What a Context says of its state, in nm, ps and kJ/mol."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import openmm

from kcons.constraints.target import FloatArray

# A State is in nm and ps whatever else is in use: _value spares the conversion, which takes longer than small Systems.


def positions_of(context: openmm.Context) -> FloatArray:
    return np.asarray(context.getState(positions=True).getPositions(asNumpy=True)._value)


def velocities_of(context: openmm.Context) -> FloatArray:
    return np.asarray(context.getState(velocities=True).getVelocities(asNumpy=True)._value)


def motion_of(context: openmm.Context) -> tuple[FloatArray, FloatArray]:
    """Positions and velocities, as they are (not wrapped), shape (n_particles, 3) each."""
    state = context.getState(positions=True, velocities=True)
    return np.array(state.getPositions(asNumpy=True)._value), np.array(state.getVelocities(asNumpy=True)._value)


def forces_at(context: openmm.Context, groups: int | Iterable[int]) -> FloatArray:
    """Forces of some force groups, a bit mask or numbers, in kJ/mol/nm, shape (n_particles, 3)."""
    state = context.getState(forces=True, groups=groups if isinstance(groups, int) else set(groups))
    return np.array(state.getForces(asNumpy=True)._value)


def energy_of(context: openmm.Context, groups: int | Iterable[int]) -> float:
    """Potential energy of some force groups, a bit mask or numbers, in kJ/mol."""
    state = context.getState(energy=True, groups=groups if isinstance(groups, int) else set(groups))
    return float(state.getPotentialEnergy()._value)


def box_of(context: openmm.Context) -> Any:
    """Periodic box vectors in nm, as OpenMM has them."""
    return context.getState().getPeriodicBoxVectors()._value


def width_of(context: openmm.Context) -> float:
    """Largest coordinate in the periodic box, nm."""
    return float(np.abs(np.array(box_of(context))).sum(axis=0).max())
