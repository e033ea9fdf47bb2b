"""Which degrees of freedom a thermostat acts on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, OverdeterminedError, UnsupportedError
from kcons.motion import Motion
from kcons.steppers import State, System

Momentum = Literal["auto", "conserved", "free"]

#: Total force over the sum of all forces below which total momentum is taken as conserved.
BALANCED = 1e-9
#: Total momentum over its thermal size above which it is not zero.
AT_REST = 1e-8


@dataclass(frozen=True, eq=False)
class Freedom:
    """What is thermostatted in one system.

    Attributes
    ----------
    count : int
        Independent momenta g: 3 n less the rank of the rows, less 3 where total momentum is conserved.
    atoms : ndarray of int or None
        None for all.
    momentum_conserved : bool
    """

    count: int
    atoms: IntArray | None
    momentum_conserved: bool


def freedom(
    system: System, state: State, forces: FloatArray, atoms: ArrayLike | None = None, momentum: Momentum = "auto"
) -> Freedom:
    """Count the degrees of freedom of all atoms or of some.

    Parameters
    ----------
    system : System
    state : State
    forces : ndarray, shape (n_atoms, 3)
        Applied forces at the state.
    atoms : array_like of int, optional
        A part of the system that no row couples to the rest.
    momentum : {'auto', 'conserved', 'free'}
        Whether total momentum is conserved: 'auto' says so where no row knows a place in space and the forces at
        `state` add up to nothing.

    Raises
    ------
    InputError
        Bad atom numbers, or an unknown `momentum`.
    UnsupportedError
        A row couples the chosen atoms to others.
    OverdeterminedError
        No degree of freedom is left.
    """
    if momentum not in ("auto", "conserved", "free"):
        raise InputError(f"momentum is {momentum!r}; choose 'auto', 'conserved' or 'free'", item="momentum")
    motion = system.motion
    held = motion.constraint_set
    chosen = None if atoms is None else _atom_numbers(atoms, system.n_atoms)
    if chosen is None or len(chosen) == system.n_atoms:
        chosen = None
        count = motion.degrees_of_freedom
    else:
        inside = np.zeros(system.n_atoms, dtype=bool)
        inside[chosen] = True
        count = 3 * len(chosen)
        if held.n_rows:
            touches = held.incidence @ inside.astype(np.int64)
            width = np.asarray(held.incidence.sum(axis=1)).ravel()
            crossing = np.flatnonzero((touches > 0) & (touches < width))
            if len(crossing):
                row = int(crossing[0])
                raise UnsupportedError(
                    f"row {held.row_name(row)} couples thermostatted atoms to others; choose atoms such that every "
                    "row is wholly inside or outside"
                )
            rows = np.flatnonzero(touches > 0)
            if len(rows):
                part, numbers = held.subset(rows)
                count -= Motion(part, state.positions[numbers], time=state.time).rank
    conserved = momentum == "conserved"
    if momentum == "auto":
        conserved = chosen is None and _momentum_is_conserved(system, forces)
    if conserved:
        count -= 3
    if count <= 0:
        raise OverdeterminedError(
            "no degree of freedom is left for the thermostat: hold fewer rows"
            + (" (total momentum, conserved, takes three)" if conserved else ""),
            rows=range(held.n_rows),
        )
    return Freedom(count, chosen, conserved)


def _momentum_is_conserved(system: System, forces: FloatArray) -> bool:
    if not all(c.translation_invariant for c in system.motion.constraint_set.constraints):
        return False
    if system.n_atoms == 1 and system.force is not None:
        return False  # one atom in a field that happens to vanish here
    total = np.abs(forces.sum(axis=0)).max(initial=0.0)
    return bool(total <= BALANCED * np.abs(forces).sum())


def total_momentum_share(system: System, velocities: FloatArray) -> float:
    """|P|^2/(M 2K): the share of total momentum in the kinetic energy."""
    masses = system.masses
    twice = 2 * system.kinetic_energy(velocities)
    momentum = masses @ velocities
    return float(momentum @ momentum / (masses.sum() * twice)) if twice > 0 else 0.0


def _atom_numbers(atoms: ArrayLike, n_atoms: int) -> IntArray:
    numbers = np.unique(np.asarray(atoms, dtype=np.int64).ravel())
    if len(numbers) == 0 or numbers[0] < 0 or numbers[-1] >= n_atoms:
        raise InputError(f"atoms must be numbers from 0 to {n_atoms - 1}, at least one", item="atoms")
    return numbers
