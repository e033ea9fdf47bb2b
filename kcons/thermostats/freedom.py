"""Which degrees of freedom a thermostat acts on: rank of the rows, and momenta that are conserved."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, OverdeterminedError, UnsupportedError
from kcons.motion.motion import Motion
from kcons.steppers import State, System

Momentum = Literal["auto", "conserved", "free"]

#: Sum of all forces (or torques) over the sum of their sizes that is taken for rounding, single precision included.
BALANCED = 1e-6
#: Share of the kinetic energy above which total momentum is not zero.
AT_REST = 1e-16
#: How far the system is shifted, relative to its size, to see whether forces depend on its place.
SHIFT = 1e-2
#: How far each atom is moved to see whether a surface is curved.
TURN = 1e-3
#: How far each atom is moved besides, so that nothing cancels by symmetry.
SHAKE = 1e-4


@dataclass(frozen=True, eq=False)
class Freedom:
    """What is thermostatted in one system.

    Attributes
    ----------
    count : int
        Independent momenta g: 3 n less the rank of the rows, less one for each direction in which total momentum is
        conserved.
    atoms : ndarray of int or None
        None for all.
    directions : ndarray, shape (k, 3)
        Orthonormal directions in which total momentum is conserved, k <= 3.
    turns : bool
        Whether the forces exert no torque, so that angular momentum is conserved too.
    """

    count: int
    atoms: IntArray | None
    directions: FloatArray
    turns: bool = False


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
        In which directions total momentum is conserved. 'auto' finds them: directions along which all rows may be
        shifted, and in which the forces add up to nothing, here and after a shift of the whole system (one force
        evaluation more, at most three). 'conserved': in all directions that the rows allow. 'free': in none.

    Raises
    ------
    InputError
        Bad atom numbers, or an unknown `momentum`.
    UnsupportedError
        A row couples the chosen atoms to others; 'conserved' with rows that hold atoms in space.
    OverdeterminedError
        No degree of freedom is left.
    """
    if momentum not in ("auto", "conserved", "free"):
        raise InputError(f"momentum is {momentum!r}; choose 'auto', 'conserved' or 'free'", item="momentum")
    chosen = None if atoms is None else atom_numbers(atoms, system.n_atoms)
    if chosen is not None and len(chosen) == system.n_atoms:
        chosen = None
    count = system.motion.degrees_of_freedom if chosen is None else _count(system, state, chosen)
    directions = np.zeros((0, 3))
    turns = False
    if momentum == "conserved":
        directions = open_directions(system.motion, state.positions, state.time)
        if not len(directions):
            raise UnsupportedError(_HELD)
    elif momentum == "auto" and chosen is None and system.n_atoms > 1:
        directions, turns = _conserved(system, state, forces)
    count -= len(directions)
    if count <= 0:
        raise OverdeterminedError(
            "no degree of freedom is left for the thermostat: hold fewer rows"
            + (f" (total momentum, conserved, takes {len(directions)})" if len(directions) else ""),
            rows=range(system.motion.constraint_set.n_rows),
        )
    return Freedom(count, chosen, directions, turns)


def _count(system: System, state: State, chosen: IntArray) -> int:
    held = system.motion.constraint_set
    count = 3 * len(chosen)
    if not held.n_rows:
        return count
    inside = np.zeros(system.n_atoms, dtype=np.int64)
    inside[chosen] = 1
    touches = held.incidence @ inside
    width = np.asarray(held.incidence.sum(axis=1)).ravel()
    crossing = np.flatnonzero((touches > 0) & (touches < width))
    if len(crossing):
        raise UnsupportedError(
            f"row {held.row_name(int(crossing[0]))} couples thermostatted atoms to others; choose atoms such that "
            "every row is wholly inside or outside"
        )
    rows = np.flatnonzero(touches > 0)
    if len(rows):
        part, numbers = held.subset(rows)
        count -= Motion(part, state.positions[numbers], time=state.time).rank
    return count


# -- total momentum ---------------------------------------------------------------------------------

_HELD = "total momentum is not conserved: the rows hold atoms in space in every direction"


def open_directions(motion: Motion, positions: FloatArray, time: float = 0.0) -> FloatArray:
    """Directions along which everything may be shifted at once without a change of any row, shape (k, 3).

    All three unless a row knows a place in space. A plane leaves two, a cylinder its axis, fixed atoms none.
    """
    held = motion.constraint_set
    placed = np.zeros(held.n_rows, dtype=bool)
    first = 0
    for item in held.constraints:
        placed[first : first + item.n_rows] = not item.translation_invariant
        first += item.n_rows
    if not placed.any():
        return np.eye(3)
    # A shift d changes a row by its gradient summed over the atoms, times d; for all places if for a few at random.
    rng = np.random.default_rng(0)
    size = float(np.ptp(positions, axis=0).max(initial=0.0)) or 1.0
    every = np.tile(np.eye(3), (motion.n_atoms, 1))
    sums = []
    for spread in (0.0, TURN * size, TURN * size):
        x = positions + spread * rng.standard_normal(positions.shape)
        with np.errstate(all="ignore"):
            rows = held.jacobian(x, time)
        if not np.isfinite(rows.data).all():
            return np.zeros((0, 3))  # a surface that is not defined nearby has a place in space
        change = np.asarray(rows @ every)[placed]
        scale = np.sqrt(np.asarray(rows.multiply(rows).sum(axis=1)).ravel())[placed]
        sums.append(change / np.where(scale > 0, scale, 1.0)[:, None])
    _, values, axes = np.linalg.svd(np.vstack(sums), full_matrices=True)
    rank = int((values > 1e-9 * max(float(values[0]), 1e-300)).sum()) if values[0] > 1e-12 else 0
    return np.ascontiguousarray(axes[rank:])


def _conserved(system: System, state: State, forces: FloatArray) -> tuple[FloatArray, bool]:
    """Directions in which the forces add up to nothing, and whether they exert no torque, wherever the atoms are."""
    directions = open_directions(system.motion, state.positions, state.time)
    if system.force is None:
        return directions, False
    rng = np.random.default_rng(0)
    size = float(np.ptp(state.positions, axis=0).max(initial=0.0)) or 1.0
    x, f = state.positions, forces
    turns = True
    for attempt in range(4):
        turns = turns and _no_torque(x, f)
        total = directions @ f.sum(axis=0)
        if np.abs(total).max(initial=0.0) <= BALANCED * np.abs(f).sum():
            # At one place they may cancel by symmetry.
            if attempt or not len(directions):
                return directions, turns and len(directions) == 3
        elif len(directions) == 1:
            break
        else:
            directions = np.linalg.svd(total[None, :])[2][1:] @ directions
        x = state.positions + SHIFT * size * rng.standard_normal(3)
        x += SHAKE * size * rng.standard_normal(x.shape)
        f = system.forces(x, state.velocities, state.time, state.step)
    return np.zeros((0, 3)), False


def _no_torque(x: FloatArray, forces: FloatArray) -> bool:
    arms = x - x.mean(axis=0)
    torque = np.abs(np.cross(arms, forces).sum(axis=0)).max()
    sizes = float((np.linalg.norm(arms, axis=1) * np.linalg.norm(forces, axis=1)).sum())
    return bool(sizes > 0 and torque <= BALANCED * sizes)


def warn_of_conserved_momenta(system: System, velocities: FloatArray, free: Freedom, stacklevel: int = 4) -> None:
    """Say so where conserved momenta keep a deterministic thermostat from sampling a temperature."""
    if momentum_share(system, velocities, free.directions) > AT_REST:
        warnings.warn(
            "total momentum is not zero, and a thermostat that scales velocities scales it too instead of forgetting "
            "it: no temperature is sampled. Take it out of the velocities first, or use Langevin",
            stacklevel=stacklevel,
        )
    elif free.turns:
        warnings.warn(
            "the forces exert no torque (a free cluster), so that angular momentum is only scaled by the thermostat "
            "and never forgotten: configurations are not canonical. Use Langevin",
            stacklevel=stacklevel,
        )


def momentum_share(system: System, velocities: FloatArray, directions: FloatArray) -> float:
    """|P|^2/(M 2K) along `directions`: the share of total momentum in the kinetic energy."""
    twice = 2 * system.kinetic_energy(velocities)
    if not len(directions) or not twice > 0:
        return 0.0
    momentum = directions @ (system.masses @ velocities)
    return float(momentum @ momentum / (system.masses.sum() * twice))


def drift_velocity(velocities: FloatArray, masses: FloatArray, directions: FloatArray) -> FloatArray:
    """Velocity of the centre of mass along `directions`, shape (3,).

    Raises
    ------
    UnsupportedError
        There are none: total momentum cannot be taken out.
    """
    if not len(directions):
        raise UnsupportedError(_HELD)
    mean = masses @ velocities / masses.sum()
    return np.asarray(directions.T @ (directions @ mean))


def atom_numbers(atoms: ArrayLike, n_atoms: int) -> IntArray:
    """Different atom numbers in order.

    Raises
    ------
    InputError
        None, or numbers out of range or not whole.
    """
    given = np.asarray(atoms)
    if given.dtype == bool and given.shape == (n_atoms,):
        given = np.flatnonzero(given)
    whole = given.dtype.kind in "iu"
    numbers = np.unique(given.ravel()).astype(np.int64) if whole else np.zeros(0, dtype=np.int64)
    if len(numbers) == 0 or numbers[0] < 0 or numbers[-1] >= n_atoms:
        raise InputError(f"atoms must be whole numbers from 0 to {n_atoms - 1}, at least one", item="atoms")
    return numbers


def refuse_friction(system: System) -> None:
    """Raise `UnsupportedError` where the system has friction of its own, which takes out heat that no noise brings."""
    if system.friction is not None:
        raise UnsupportedError(
            "a System with friction has no temperature: what it takes out, a thermostat would put back elsewhere; "
            "leave it out of the System, and give the rate to Langevin, which brings noise with it"
        )


def carried(state: State, size: int, name: str) -> bool:
    """Whether the state carries the variables of this thermostat.

    Raises
    ------
    InputError
        It carries those of another.
    """
    if state.thermostat is None:
        return False
    if getattr(state.thermostat, "shape", None) != (size,):  # np.shape takes a microsecond
        raise InputError(
            f"the state carries variables of another thermostat, not of {name}; start with "
            "dataclasses.replace(state, thermostat=None)",
            item="thermostat",
        )
    return True
