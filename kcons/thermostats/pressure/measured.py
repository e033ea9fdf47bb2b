"""The pressure of a state: by pieces as points, by all atoms, or from energies alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from kcons.constraints.arguments import checked, positive, refuse_other
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, NonFiniteError
from kcons.motion.motion import Motion
from kcons.steppers import State
from kcons.thermostats.pressure.barostat import energy_by_strain
from kcons.thermostats.pressure.cell_system import CellSystem
from kcons.thermostats.pressure.pieces import BarostatBodies, find_pieces, lattice_of

#: Change of all lengths from which the derivative of the energy is taken.
STRAIN = 1e-4

Virial = Literal["molecular", "atomic", "difference"]


def constraint_virial(motion: Motion, x: FloatArray, v: FloatArray, f: FloatArray, time: float = 0.0) -> FloatArray:
    """sum_i r_i (x) z_i over the rows that hold the system together, symmetric, shape (3, 3).

    z is the instantaneous constraint force, the velocity-dependent part of b included. Rows that depend on
    differences of positions only enter with these differences, so that the origin does not matter. Rows
    with a place in space (fixed atoms, surfaces, centers of mass) are external forces, like walls, and
    have no share.

    References
    ----------
    Notes, eqs. 101-104. Atomic virial with constraints: Ciccotti and Ryckaert, Comput. Phys. Rep. 4, 345 (1986).
    """
    held = motion.constraint_set
    lam = motion.multipliers(x, v, f, time)
    virial = np.zeros((3, 3))
    for item, start in zip(held.constraints, held.starts, strict=False):
        if not (item.holonomic and item.translation_invariant and item.n_rows):
            continue
        r = held.gather(item, x)
        push = lam[start : start + item.n_rows, None, None] * item.gradient(r, time)
        virial += np.einsum("kai,kaj->ij", r - r[:, :1], push)
    return 0.5 * (virial + virial.T)


@checked
def refuse_virial(virial: Virial, thermal_energy: float | None) -> None:
    """Raise `InputError` for a virial that is unknown, and for kT with the momenta of atoms."""
    if virial == "atomic" and thermal_energy is not None:
        # the virial of constraint forces has the present velocities as well, and only both together are right
        raise InputError(
            "a temperature takes the place of the momenta of pieces, not of those of atoms, as virial='atomic' takes "
            "them; leave it out, or take virial='molecular'",
            item="thermal_energy",
        )


def instantaneous_pressure(
    system: CellSystem,
    state: State,
    virial: Virial = "molecular",
    *,
    pieces: BarostatBodies | None = None,
    thermal_energy: float | None = None,
) -> FloatArray:
    """The instantaneous pressure tensor, shape (3, 3); the mean of its diagonal is the pressure.

    Beside a barostat that leaves an axis alone it is that of the others.

    Parameters
    ----------
    system : CellSystem
    state : State
    virial : {'molecular', 'atomic', 'difference'}
        Of pieces as points, in which constraint forces have no part; of all atoms, with the constraint forces; or of
        pieces, from energies in a cell a little larger and smaller (along the axes that pieces of a barostat follow),
        which needs no stress and gives the same in all directions. The means are the same; that of pieces has the least
        noise.
    pieces : BarostatBodies, optional
        As `find_pieces` gives them; by default what constraints tie.
    thermal_energy : float, optional
        kT for the momenta of pieces, N kT/V instead of their present kinetic energy: the same mean, with less noise,
        also where total momentum is zero.

    Raises
    ------
    InputError
        `thermal_energy` with 'atomic'; a cell without a volume; pieces of another system.
    UnsupportedError
        There is no stress, or a piece is held in space.
    NonFiniteError
        An energy or a stress is not finite.
    """
    refuse_virial(virial, thermal_energy)
    refuse_other(system, CellSystem, "system", "a CellSystem, which knows its cell")
    if pieces is not None:
        refuse_other(pieces, BarostatBodies, "pieces", "what find_pieces or barostat.pieces gives")
        if len(pieces.label) != system.n_atoms:
            raise InputError(
                f"pieces are those of {len(pieces.label)} atoms, and the system has {system.n_atoms}; find its own",
                item="pieces",
            )
    x, v, _ = system.kernel_arrays(state)
    cell = system.cell
    volume = system.volume
    if virial == "atomic":
        masses = np.where(system.inverse_masses > 0, system.masses[:, None], 0.0)
        stress = system.stress(x, state.time)
        f = system.with_forces(state).forces
        assert f is not None
        return ((masses * v).T @ v + constraint_virial(system.motion, x, v, f, state.time)) / volume - stress
    if pieces is None:
        pieces = find_pieces(system, x, np.ones(3, dtype=bool), time=state.time)
    if thermal_energy is None:
        u = pieces.centers(v) * pieces.open
        kinetic = (pieces.mass[:, None] * u).T @ u
    else:
        kinetic = positive(thermal_energy, "thermal_energy") * np.diag(pieces.moving).astype(float)
    if virial == "difference":
        return kinetic / volume - np.eye(3) * _slope(system, state, pieces, cell) / (pieces.axes.sum() * volume)
    stress, forces = system.stress(x, state.time), system.with_forces(state).forces
    assert forces is not None
    rise = energy_by_strain(system, pieces, x, forces, stress)
    return (kinetic - 0.5 * (rise + rise.T)) / volume


def _slope(system: CellSystem, state: State, pieces: BarostatBodies, cell: FloatArray) -> float:
    """dU/d ln(length) where the cell is scaled along the axes it changes along, and pieces move by their centers."""
    lattice, energies = lattice_of(system), []
    try:
        for h in (STRAIN, -STRAIN):
            change = h * np.diag(pieces.axes.astype(float))
            system.set_cell(cell, state.positions)
            y = state.positions + pieces.moved(state.positions, change, lattice)
            system.set_cell(cell @ (np.eye(3) + change), y)
            energies.append(system.energy(y, state.time, state.step))
    finally:
        system.set_cell(cell, state.positions)
    if not np.isfinite(energies).all():
        raise NonFiniteError(
            f"energies of a cell a little larger and smaller are {energies[0]} and {energies[1]}, which have no "
            "difference: atoms overlap, or the force field returns what is no energy"
        )
    return (energies[0] - energies[1]) / (2 * STRAIN)


def mean_pressure(values: Sequence[FloatArray], axes: NDArray[np.bool_]) -> float:
    """Of tensors, along the axes along which a cell changes."""
    return float(np.mean([np.diagonal(value)[axes] for value in values]))
