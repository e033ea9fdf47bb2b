"""Systems whose cell can change: what moves as one when it does, and the pressure of a state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kcons.constraints.arguments import as_array, check_call, check_pairs, checked, positive, read_only, refuse_other
from kcons.constraints.constraint import IntArray
from kcons.constraints.periodic.one_piece import connected, spanning_tree
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, NonFiniteError, UnsupportedError
from kcons.motion.motion import Motion
from kcons.steppers import State, System
from kcons.thermostats.freedom import UNCHANGED, Bodies, placed_rows, row_changes, rows_where, shifts

Held = Literal["refuse", "stay"]
Virial = Literal["molecular", "atomic", "difference"]
#: A function of positions, time and cell (vectors as rows, shape (3, 3)).
InCellFunction = Callable[[FloatArray, float, FloatArray], ArrayLike]

#: Sine squared of the angle between an axis and what is periodic, below which it lies therein.
FLAT = 1e-12
#: Change of all lengths from which the derivative of the energy is taken.
STRAIN = 1e-4


class CellSystem(System):
    """Constraints, masses and forces in a periodic cell that a barostat changes.

    Parameters
    ----------
    motion : Motion
        Of a `ConstraintSet` made with a cell.
    force, potential : callable, optional
        Forces, shape (n_atoms, 3), and potential energy as functions of positions, time and cell. Both or neither.
    stress : callable, optional
        The derivative of the potential by a strain of all atoms and the cell, over the volume, shape (3, 3): positive
        where the system pulls its walls together. For `CellRescaling`.
    far : float
        As for `System`.

    Attributes
    ----------
    cell : ndarray, shape (3, 3)
        Vectors as rows; a unit vector normal to the others where it is not periodic, so that a pressure is an energy
        over an area there. That of the last state that a step began or ended with, or whose energy was asked for.
    periodic : ndarray of bool, shape (3,)

    Raises
    ------
    InputError
        The constraint set has no cell; a force without a potential.
    """

    def __init__(
        self,
        motion: Motion,
        force: InCellFunction | None = None,
        potential: Callable[[FloatArray, float, FloatArray], float] | None = None,
        stress: InCellFunction | None = None,
        *,
        far: float = 8.0,
    ) -> None:
        if motion.lattice is None:
            raise InputError("the constraint set has no cell: give ConstraintSet(..., cell=) one", item="cell")
        if (force is None) != (potential is None):
            raise InputError(
                "give force and potential, or neither: a change of the cell is judged by the energy", item="potential"
            )
        for name, function in (("force", force), ("potential", potential), ("stress", stress)):
            check_call(name, function, ("x", "t", "cell"))
        self._matrix = read_only(motion.lattice[0].copy())
        self.periodic: NDArray[np.bool_] = motion.lattice[1].any(axis=0)
        self._pbc: bool | list[bool] = True if self.periodic.all() else self.periodic.tolist()
        self.stress_of = stress
        super().__init__(
            motion,
            None if force is None else (lambda x, t: force(x, t, self.cell)),
            potential=None if potential is None else (lambda x, t: potential(x, t, self.cell)),
            far=far,
        )

    @property
    def cell(self) -> FloatArray:
        return self._matrix

    @property
    def lattice(self) -> FloatArray:
        """The cell and its inverse, shape (2, 3, 3)."""
        found = self.motion.lattice
        assert found is not None  # some direction is periodic
        return found

    @property
    def volume(self) -> float:
        """What the pressure acts on; `InputError` where a vector of the cell is zero."""
        found = float(abs(np.linalg.det(self.cell)))
        if not found > 0:
            raise InputError(
                "the cell has no volume for a pressure to act on: give its vector along which it is not periodic a "
                "length",
                item="cell",
            )
        return found

    def set_cell(self, cell: FloatArray, positions: FloatArray) -> None:
        """Change the cell; `positions` are those in it.

        Forces and energies that states carry are of the cell that was, which steps take again: go on with
        `dataclasses.replace(state, positions=positions, forces=None, barostat=None)`.

        Raises
        ------
        InputError, ImageError
            As `Motion.set_cell`; nothing was changed.
        """
        self.motion.set_cell(cell, self._pbc, positions)
        self._matrix = read_only(self.lattice[0].copy())

    def initial_state(
        self,
        positions: ArrayLike,
        velocities: ArrayLike | None = None,
        *,
        time: float = 0.0,
        project: bool = False,
    ) -> State:
        """As `System.initial_state`; the state knows the present cell."""
        state = super().initial_state(positions, velocities, time=time, project=project)
        return replace(state, barostat=self.cell.flatten())

    def enter(self, state: State) -> None:
        """Take the cell of a state that knows one; errors as of `set_cell`."""
        cell = state.cell
        if cell is not None and not (cell == self.cell)[self.periodic].all():
            self.set_cell(cell.copy(), state.positions.copy())  # arrays of a state that is shown cannot be written to

    def kernel_arrays(self, state: State) -> tuple[FloatArray, FloatArray, FloatArray | None]:
        """As `System.kernel_arrays`, in the cell of the state."""
        self.enter(state)
        return super().kernel_arrays(state)

    def total_energy(self, state: State) -> float:
        """As `System.total_energy`, in the cell of the state."""
        self.enter(state)
        return super().total_energy(state)

    def energy(self, x: FloatArray, time: float, step: int) -> float:
        """The potential energy, infinite where atoms overlap; `NonFiniteError` if it is NaN, or minus infinity."""
        found = self.potential_energy(x, time)
        if not found > -np.inf:
            raise NonFiniteError(
                f"the potential energy is {found} at step {step}, by which no trial cell can be judged: look at what "
                "the force field returned",
                step=step,
            )
        return found

    def stress(self, x: FloatArray, time: float) -> FloatArray:
        """Shape (3, 3), symmetric; `UnsupportedError` where nobody knows it, `NonFiniteError` if it is not finite."""
        if self.stress_of is None:
            if self.force is None:
                return np.zeros((3, 3))
            raise UnsupportedError(
                "this System has no stress; give stress=, or use MonteCarloBarostat, which needs none"
            )
        found = as_array(self.stress_of(x, time, self.cell), (3, 3), "stress")
        if not np.isfinite(found).all():
            raise NonFiniteError("the stress is not finite: look at what the force field returned")
        return 0.5 * (found + found.T)


# -- what moves as one --------------------------------------------------------------------------------


@dataclass(eq=False)
class BarostatBodies(Bodies):
    """What moves as one when the cell changes, and how."""

    open: NDArray[np.bool_]  # the axes along which each follows the cell, shape (n_bodies, 3)
    axes: NDArray[np.bool_]  # those along which the cell changes, shape (3,)

    @property
    def moving(self) -> IntArray:
        """How many pieces follow the cell along each axis, shape (3,)."""
        return self.open.sum(axis=0)

    def moved(self, x: FloatArray, change: FloatArray, lattice: FloatArray) -> FloatArray:
        """Displacements for a cell that becomes cell (1 + `change`), each atom in the image that it is stored in.

        `UnsupportedError` where what stays in its place is stored across a face of the cell that moves.
        """
        y = self.whole(x, lattice)
        images = np.rint((y - x) @ lattice[1]) @ (lattice[0] @ change)
        torn = (images != 0.0) & ~self.open[self.label]
        if torn.any():
            raise UnsupportedError(
                f"atom {np.argmax(torn.any(axis=1))} is held in its place across a face of the cell that the barostat "
                "moves: the constraint would mean another place. Store what is held with its neighbors on the same side"
            )
        return (self.open * (self.centers(y) @ change))[self.label] - images


def find_pieces(
    system: CellSystem,
    positions: FloatArray,
    axes: NDArray[np.bool_],
    molecules: ArrayLike | None = None,
    held: Held = "refuse",
    time: float = 0.0,
) -> BarostatBodies:
    """Pieces of a system by its constraints, and by bonds if they are given.

    Parameters
    ----------
    system : CellSystem
    positions : ndarray, shape (n_atoms, 3)
    axes : ndarray of bool, shape (3,)
        The axes along which the cell changes.
    molecules, held
        As for `Barostat`.

    Raises
    ------
    UnsupportedError
        Pieces held in space; a row that closes upon itself through the cell; nothing could follow the cell.
    InputError
        Bonds of unknown atoms.
    """
    motion, n_atoms = system.motion, system.n_atoms
    constraint_set = motion.constraint_set
    rows_of = constraint_set.constraints
    if not n_atoms:
        raise UnsupportedError("no piece of the system could follow the cell: it has no atoms")
    none = np.zeros((0, 2), np.int64)
    links = [none, *(c.linked.reshape(-1, 2) for c in rows_of if c.n_rows and c.width > 1)]
    nearest = [none]
    nearest += [
        (c.linked if c.whole is None else c.linked[~c.whole]).reshape(-1, 2) for c in constraint_set.constraints
    ]
    if constraint_set.images is not None:
        tree = constraint_set.images
        nearest.append(np.stack([tree.parents, tree.atoms], axis=1))
    if molecules is not None:
        bonds = check_pairs(molecules, n_atoms, "molecules")
        links.append(bonds)
        nearest.append(bonds)
    around = any(c.cell_offsets is not None and c.cell_offsets.any() for c in rows_of)
    label = connected(np.concatenate(links), n_atoms)[0]
    rows = rows_open(motion, positions, time)
    held_atoms = constraint_set.incidence.T @ ~rows > 0
    placed = held_atoms.any(axis=1)
    opened = np.ones((int(label.max()) + 1, 3), dtype=bool)
    np.logical_and.at(opened, label, ~held_atoms)
    shut = ~opened & axes
    if shut.any() and held == "refuse":
        piece = int(np.argmax(shut.any(axis=1)))
        atom = int(np.flatnonzero((label == piece) & placed)[0])
        touching = constraint_set.incidence[:, [atom]].toarray().ravel() != 0
        row = int(np.argmax(touching & (~rows & axes).any(axis=1)))
        axis_name = "xyz"[int(np.argmax(shut[piece]))]
        raise UnsupportedError(
            f"row {constraint_set.row_name(row)} holds atom {atom} in space along {axis_name}, and the barostat moves "
            "everything along with the cell. Use a kind that leaves this axis alone, or held='stay': what is held then "
            "stays as a wall from outside, and the pressure is that of the rest. Where only a pressure is asked for, "
            "virial='atomic' tells it"
        )
    if not opened[:, axes].any():
        raise UnsupportedError("no piece of the system could follow the cell: all are held in space")
    masses = np.where(system.inverse_masses[:, 0] > 0, system.masses, 0.0)
    masses[~np.isin(label, label[masses > 0])] = 1.0  # fixed atoms alone
    total = np.bincount(label, masses).astype(float)
    order = np.argsort(~placed, kind="stable")
    near = np.concatenate(nearest)
    pieces = BarostatBodies(label, masses / total[label], total, spanning_tree(near, n_atoms, order), opened, axes)
    lattice = system.lattice
    y = pieces.whole(positions, lattice)
    closing = np.flatnonzero(np.round((y[near[:, 1]] - y[near[:, 0]]) @ lattice[1]).any(axis=1))
    if around or len(closing):
        pair = f" between atoms {near[closing[0], 0]} and {near[closing[0], 1]}" if len(closing) else ""
        raise UnsupportedError(
            f"what is tied together closes upon itself through the cell{pair}: it fixes the cell. Keep the volume "
            "constant, or hold only what does not close"
        )
    return pieces


def rows_open(motion: Motion, positions: FloatArray, time: float = 0.0) -> NDArray[np.bool_]:
    """Whether all atoms of a row may be shifted along an axis without a change of it, shape (n_rows, 3)."""
    held = motion.constraint_set
    placed = placed_rows(held)
    opened = np.repeat(~placed[:, None], 3, axis=1)
    if placed.any():
        opened[placed & rows_where(held, [item.holonomic for item in held.constraints])] = True
        for change in row_changes(motion, positions, shifts, time):
            opened &= ~placed[:, None] | (np.abs(change) <= UNCHANGED)  # NaN: a surface not defined nearby has a place
    return opened


def require_periodic(system: CellSystem, axes: NDArray[np.bool_], kind: str) -> None:
    """Raise `InputError` where the cell has no volume, or is not periodic along an axis that is to change."""
    assert system.volume
    # Axes are those of space, and need not be those of the cell vectors.
    own, _ = np.linalg.qr(system.cell[system.periodic].T)
    wrong = axes & (1 - (own**2).sum(axis=1) > FLAT)
    if wrong.any():
        slab = "" if kind == "lateral" else "for a slab in the xy plane use kind='lateral', else "
        raise InputError(
            f"kind={kind!r} changes the cell along {'xyz'[int(np.argmax(wrong))]}, in which it is not periodic; "
            f"{slab}make the cell periodic there",
            item="kind",
        )


# -- the pressure of a state ---------------------------------------------------------------------------


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


def energy_by_strain(system: CellSystem, pieces: BarostatBodies, state: State) -> tuple[FloatArray, FloatArray]:
    """dU/d strain, shape (3, 3), where the cell is strained and pieces move by their centers, and the forces.

    The stress is that of all atoms moving along; what they would move relative to the center of their piece does work
    against the forces, and is taken out again.
    """
    x = state.positions
    stress = system.stress(x, state.time)  # first: most calculators find all else on the way
    forces = system.with_forces(state).forces
    assert forces is not None
    y = pieces.whole(x, system.lattice)
    carried = (pieces.centers(y)[:, :, None] * pieces.open[:, None, :])[pieces.label]
    return system.volume * stress + np.einsum("ijk,ik->jk", y[:, :, None] - carried, forces), forces


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
        return kinetic / volume - np.eye(3) * _slope(system, state, pieces) / (pieces.axes.sum() * volume)
    rise, _ = energy_by_strain(system, pieces, state)
    return (kinetic - 0.5 * (rise + rise.T)) / volume


def _slope(system: CellSystem, state: State, pieces: BarostatBodies) -> float:
    """dU/d ln(length) where the cell is scaled along the axes it changes along, and pieces move by their centers."""
    cell, lattice, energies = system.cell, system.lattice, []
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
