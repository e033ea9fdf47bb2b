"""What moves as one when the cell changes: clusters tied by constraints, molecules, free atoms."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kcons.constraints.arguments import check_pairs
from kcons.constraints.constraint import IntArray
from kcons.constraints.periodic.one_piece import connected, follow_parents, spanning_tree
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError
from kcons.motion.motion import Motion
from kcons.thermostats.freedom import UNCHANGED, placed_rows, row_changes, rows_where, shifts
from kcons.thermostats.pressure.cell_system import CellSystem

Held = Literal["refuse", "stay"]

#: Sine squared of the angle between an axis and what is periodic, below which it lies therein.
FLAT = 1e-12


@dataclass(frozen=True, eq=False)
class BarostatBodies:
    """What moves as one when the cell changes.

    Attributes
    ----------
    label : ndarray of int, shape (n_atoms,)
        The piece of each atom.
    weight : ndarray, shape (n_atoms,)
        Share of each atom in the mass of its piece.
    mass : ndarray, shape (n_pieces,)
    open : ndarray of bool, shape (n_pieces, 3)
        The axes along which a piece follows the cell.
    tree : tuple of ndarray of int
        Atoms and the parents next to which they are, for pieces cut by the faces of the cell.
    axes : ndarray of bool, shape (3,)
        Those along which the cell changes.
    """

    label: IntArray
    weight: FloatArray
    mass: FloatArray
    open: NDArray[np.bool_]
    tree: tuple[IntArray, IntArray]
    axes: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.mass)

    @property
    def moving(self) -> IntArray:
        """How many pieces follow the cell along each axis, shape (3,)."""
        return self.open.sum(axis=0)

    def whole(self, x: FloatArray, lattice: FloatArray) -> FloatArray:
        """Positions with each piece in one piece."""
        y = x.copy()
        follow_parents(y, *self.tree, lattice)
        return y

    def sums(self, values: FloatArray) -> FloatArray:
        """Of an array over atoms, shape (n_atoms, 3), for each piece."""
        n = len(self)
        return np.stack([np.bincount(self.label, values[:, k], n) for k in range(3)], axis=1)

    def centers(self, y: FloatArray) -> FloatArray:
        """Centers of mass of positions in one piece (or their velocities), shape (n_pieces, 3)."""
        return self.sums(self.weight[:, None] * y)

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

    def work_of_shapes(self, x: FloatArray, forces: FloatArray, lattice: FloatArray) -> FloatArray:
        """Sum of (r_i - R) (x) f_i over atoms, R the center of their piece or zero where it stays, shape (3, 3)."""
        y = self.whole(x, lattice)
        carried = (self.centers(y)[:, :, None] * self.open[:, None, :])[self.label]
        return np.asarray(np.einsum("ijk,ik->jk", y[:, :, None] - carried, forces))


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
    if not n_atoms:
        raise UnsupportedError("no piece of the system could follow the cell: it has no atoms")
    constraint_set = motion.constraint_set
    links = [c.linked.reshape(-1, 2) for c in constraint_set.constraints if c.n_rows and c.width > 1]
    nearest = [(c.linked if c.whole is None else c.linked[~c.whole]).reshape(-1, 2) for c in constraint_set.constraints]
    if constraint_set.images is not None:
        tree = constraint_set.images
        nearest.append(np.stack([tree.parents, tree.atoms], axis=1))
    if molecules is not None:
        bonds = check_pairs(molecules, n_atoms)
        links.append(bonds)
        nearest.append(bonds)
    around = any(c.cell_offsets is not None and c.cell_offsets.any() for c in constraint_set.constraints)
    label = connected(_joined(links), n_atoms)[0]
    rows = rows_open(motion, positions, time)
    opened = np.ones((int(label.max()) + 1, 3), dtype=bool)
    placed = np.zeros(n_atoms, dtype=bool)
    first = 0
    for item in constraint_set.constraints:
        here = rows[first : first + item.n_rows]
        first += item.n_rows
        closed = ~here.all(axis=1)
        placed[item.atoms[closed].ravel()] = True
        for axis in range(3):
            opened[label[item.atoms[~here[:, axis]].ravel()], axis] = False
    shut = ~opened & axes
    if shut.any() and held == "refuse":
        piece = int(np.argmax(shut.any(axis=1)))
        atom = int(np.flatnonzero((label == piece) & placed)[0])
        touching = constraint_set.incidence[:, [atom]].toarray().ravel() != 0
        row = int(np.argmax(touching & ~(rows | ~axes).all(axis=1)))
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
    near = _joined(nearest)
    pieces = BarostatBodies(label, masses / total[label], total, opened, spanning_tree(near, n_atoms, order), axes)
    lattice = lattice_of(system)
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


def _joined(links: Iterable[IntArray]) -> IntArray:
    return np.concatenate([np.zeros((0, 2), np.int64), *links])


def lattice_of(system: CellSystem) -> FloatArray:
    """The cell and its inverse, shape (2, 3, 3)."""
    lattice = system.motion.lattice
    assert lattice is not None  # a CellSystem has one
    return lattice


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
