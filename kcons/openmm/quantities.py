"""The boundary to OpenMM: one way in for numbers, and what a Context says of its state."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
import openmm
from numpy.typing import ArrayLike
from openmm import unit

from kcons.constraints import FixedAtoms
from kcons.constraints.arguments import has_units, quantity_text
from kcons.constraints.constraint import Constraint, IntArray
from kcons.constraints.target import FloatArray
from kcons.errors import InputError

#: Boltzmann's constant times Avogadro's number, kJ/mol/K.
GAS_CONSTANT = unit.MOLAR_GAS_CONSTANT_R.value_in_unit(unit.kilojoule_per_mole / unit.kelvin)


def plain(value: Any, of: unit.Unit, item: str) -> Any:
    """A Quantity, or nested lists of them, as numbers in a unit; numbers are in it. `InputError` for another kind."""
    if isinstance(value, list | tuple) and has_units(value):
        return [plain(part, of, item) for part in value]
    if not has_units(value):
        return value
    if not unit.is_quantity(value) or not value.unit.is_compatible(of):
        symbol = of.get_symbol()
        symbol = f"1{symbol}" if symbol.startswith("/") else symbol
        raise InputError(f"{item} is {quantity_text(value)}; give it in {symbol}", item=item)
    return value.value_in_unit(of)


def number(value: Any, of: unit.Unit, item: str) -> float:
    """The same for one number; `InputError` too for what is none."""
    found = value if isinstance(value, float | int) else plain(value, of, item)
    try:
        if isinstance(found, str | bytes):
            raise TypeError
        return float(found)
    except (TypeError, ValueError):
        raise InputError(
            f"{item} is {value!r:.60}; give a number of {of.get_symbol()}, or a Quantity", item=item
        ) from None


def relative_tolerance(value: Any) -> float:
    """A tolerance of OpenMM's solvers; `InputError` for what is no number between 0 and 1."""
    found = number(value, unit.dimensionless, "tolerance")
    if not 0 < found < 1:
        raise InputError(f"the tolerance is {value}; give a positive number, such as 1e-10", item="tolerance")
    return found


def kelvins(temperature: unit.Quantity | float) -> float:
    """A temperature in K; `InputError` for what is none, or below zero."""
    value = number(temperature, unit.kelvin, "temperature")
    if not 0 <= value < math.inf:
        raise InputError(f"temperature is {temperature}; give a number of K, not below zero", item="temperature")
    return value


def array(values: Any, of: unit.Unit, item: str) -> FloatArray:
    """The same as `plain` for an array, as a copy; `InputError` too for what is no array of numbers."""
    found = plain(values, of, item)
    try:
        return np.array(found, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{item} are no array of numbers: {error}", item=item) from None


def cell_of(vectors: Any) -> FloatArray:
    """Box vectors, of a State (a Quantity) or of a System (a list of them), nm, shape (3, 3)."""
    return array(vectors, unit.nanometer, "box")


def nanometers(positions: unit.Quantity | ArrayLike, n: int) -> FloatArray:
    """Positions as an array of shape (n, 3), nm; `InputError` for another shape or kind."""
    x = array(positions, unit.nanometer, "positions")
    if x.shape != (n, 3):
        raise InputError(f"positions must have shape ({n}, 3), not {x.shape}", item="positions")
    return x


def masses_of(system: openmm.System) -> FloatArray:
    """Masses in dalton, shape (n_particles,)."""
    return np.array([system.getParticleMass(i)._value for i in range(system.getNumParticles())])


def held_pairs(system: openmm.System) -> tuple[IntArray, FloatArray]:
    """Pairs of particles, shape (n, 2), and lengths in nm, (n,), of the constraints of a System."""
    known = [system.getConstraintParameters(k) for k in range(system.getNumConstraints())]
    pairs = np.array([pair for *pair, _ in known], dtype=np.int64).reshape(-1, 2)
    return pairs, np.array([length._value for *_, length in known], dtype=float)


def held_without_mass(system: openmm.System) -> list[int]:
    """Particles without mass that are no virtual sites: they stay where they are."""
    return [k for k in np.flatnonzero(masses_of(system) == 0).tolist() if not system.isVirtualSite(k)]


def with_massless_atoms(given: tuple[Constraint, ...], masses: FloatArray) -> tuple[Constraint, ...]:
    """The constraints, with `FixedAtoms` for particles without mass, which OpenMM does not move."""
    if not all(isinstance(item, Constraint) for item in given):
        return given  # ConstraintSet says what is wrong
    used = [item.atoms.ravel() for item in given]
    touched = np.unique(np.concatenate([*used, np.zeros(0, np.int64)]))
    still = touched[touched < len(masses)]
    still = still[masses[still] == 0]
    fixed = [item.atoms.ravel() for item in given if item.fixes_atoms]
    still = np.setdiff1d(still, np.concatenate([*fixed, np.zeros(0, np.int64)]))
    return (*given, FixedAtoms(still)) if len(still) else given


# -- the state of a Context, in nm, ps and kJ/mol ---------------------------------------------------

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
