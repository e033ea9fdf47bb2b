"""Molecules as rigid pieces: what turns about a bond, or shifts along it, as a whole."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kcons.constraints.constraint import IntArray
from kcons.constraints.periodic.one_piece import connected, make_whole, neighbor_lists, spanning_tree
from kcons.constraints.target import FloatArray
from kcons.constraints.vectors import cross
from kcons.plan.independent_blocks import edge_blocks
from kcons.topology.topology import sorted_pairs

#: Origin and unit axis of a motion at given positions; None where they are undefined.
Frame = Callable[[FloatArray], tuple[FloatArray, FloatArray] | None]


class MoleculeGraph:
    """The bonds of the molecules to which some atoms belong, and what is left where one of them is cut.

    Parameters
    ----------
    n_atoms : int
    bonds : ndarray of int, shape (n, 2)
    atoms : ndarray of int
        Molecules with none of these are left out.

    Attributes
    ----------
    bonds : ndarray of int, shape (n, 2)
        Those of the molecules that are kept; i < j, sorted.
    atoms : ndarray of int
        All atoms of these molecules, molecule by molecule; what lies beyond a bond stands together.
    molecules : list of ndarray of int
    """

    def __init__(self, n_atoms: int, bonds: IntArray, atoms: IntArray) -> None:
        pairs = sorted_pairs(bonds)
        label, _ = connected(pairs, n_atoms)
        chosen = np.zeros(n_atoms, dtype=bool)
        chosen[atoms] = True
        kept = np.zeros(n_atoms, dtype=bool)
        kept[np.isin(label, label[atoms])] = True
        self.bonds = pairs[kept[pairs].all(axis=1)] if len(pairs) else pairs
        self._starts, self._ends = neighbor_lists(self.bonds, n_atoms)
        order, parents = spanning_tree(self.bonds, n_atoms)
        self._lay_out(order[kept[order]], parents[kept[order]], n_atoms)

    def neighbors(self, atom: int) -> IntArray:
        """Atoms bonded to one."""
        return self._ends[self._starts[atom] : self._starts[atom + 1]]

    def _lay_out(self, order: IntArray, parents: IntArray, n_atoms: int) -> None:
        """Put what hangs from an atom behind it, and find the bridges: bonds that are blocks of their own."""
        parent, size = np.arange(n_atoms), np.ones(n_atoms, dtype=np.int64)
        parent[order] = parents
        tree = list(zip(order.tolist(), parents.tolist(), strict=True))
        for atom, above in reversed(tree):
            if atom != above:
                size[above] += size[atom]
        begin, free, used = np.zeros(n_atoms, dtype=np.int64), np.zeros(n_atoms, dtype=np.int64), 0
        for atom, above in tree:
            if atom == above:
                begin[atom], used = used, used + size[atom]
            else:
                begin[atom] = free[above]
                free[above] += size[atom]
            free[atom] = begin[atom] + 1
        self.atoms = order[np.argsort(begin[order])]
        self._parent, self._begin, self._end = parent, begin, begin + size
        self.molecules = [self._hanging(root) for root in self.atoms.tolist() if parent[root] == root]
        i, j = self.bonds.T
        block = edge_blocks(i, j, n_atoms) if len(self.bonds) else i
        self._bridge = np.zeros(n_atoms, dtype=bool)  # by the far atom of each
        self._bridge[np.where(parent[j] == i, j, i)[np.bincount(block)[block] == 1]] = True

    def _hanging(self, atom: int) -> IntArray:
        """An atom and all that hang from it."""
        return self.atoms[self._begin[atom] : self._end[atom]]

    def molecule(self, atom: int) -> IntArray:
        """All atoms of the molecule of one of `atoms`."""
        while self._parent[atom] != atom:
            atom = int(self._parent[atom])
        return self._hanging(atom)

    def bonded(self, j: int, k: int) -> bool:
        """Whether two atoms are."""
        return bool(np.any(self.neighbors(j) == k))

    def beyond(self, j: int, k: int) -> IntArray | None:
        """Atoms on the side of k when the bond j-k is cut; None if there is no bond, or one in a ring."""
        if self._parent[k] == j and self._bridge[k]:
            return self._hanging(k)
        if self._parent[j] == k and self._bridge[j]:
            return np.setdiff1d(self.molecule(j), self._hanging(j), assume_unique=True)
        return None

    def whole(self, x: FloatArray, lattice: FloatArray | None) -> FloatArray:
        """Positions with every molecule in one piece: each atom in the image next to the one it was reached from."""
        return make_whole(x, self.atoms, self._parent[self.atoms], lattice)


@dataclass(frozen=True)
class Move:
    """A rigid motion of some atoms with one parameter.

    Attributes
    ----------
    atoms : ndarray of int
        What moves.
    frame : callable
        Origin and unit axis at given positions.
    turns : bool
        Whether it turns about the axis (right-handed), or shifts along it.
    share : ndarray, shape (len(atoms), 1), or float
        How far each atom shifts, in units of the parameter.
    """

    atoms: IntArray
    frame: Frame
    turns: bool
    share: FloatArray | float = 1.0

    def make(self, x: FloatArray, amount: float) -> bool:
        """Move the atoms in place; False if there is no axis here."""
        placed = self.frame(x)
        if placed is None:
            return False
        origin, axis = placed
        if not self.turns:
            x[self.atoms] += amount * (self.share * axis)
            return True
        arm = x[self.atoms] - origin
        along = (arm @ axis)[:, None] * axis
        across = arm - along
        # In this form small turns lose nothing: 1 - cos is taken from the half angle.
        x[self.atoms] += np.sin(amount) * cross(axis, arm) - 2 * np.sin(amount / 2) ** 2 * across
        return True


def torsion(atoms: IntArray, j: int, k: int) -> Move:
    """Turn about the line from j to k: with the last atom of a dihedral among `atoms`, it grows by the amount."""

    def frame(x: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        return _line(x[j], x[k])

    return Move(atoms, frame, True)


def bend(atoms: IntArray, i: int, j: int, k: int) -> Move:
    """Turn about j in the plane of i, j, k: with k among `atoms`, the angle i-j-k grows by the amount."""

    def frame(x: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        u, w = x[i] - x[j], x[k] - x[j]
        normal = cross(u, w)
        size = float(np.linalg.norm(normal))
        if size > 1e-9 * float(np.linalg.norm(u) * np.linalg.norm(w)):
            return x[j], normal / size
        # Straight: any plane does.
        normal = cross(u, np.eye(3)[int(np.argmin(np.abs(u)))])
        size = float(np.linalg.norm(normal))
        return (x[j], normal / size) if size > 0 else None

    return Move(atoms, frame, True)


def stretch(atoms: IntArray, others: IntArray, masses: FloatArray, axis: Callable[[FloatArray], FloatArray]) -> Move:
    """Shift one piece along an axis and the other against it, their common center at rest.

    Parameters
    ----------
    atoms, others : ndarray of int
        The pieces; one without atoms means that the other one moves alone.
    masses : ndarray, shape (n_atoms,)
    axis : callable
        Points from `others` to `atoms`, any length.
    """
    a, b = float(masses[atoms].sum()), float(masses[others].sum())
    part = (b / (a + b) if a + b > 0 else 0.5) if len(atoms) and len(others) else float(len(atoms) > 0)
    share = np.concatenate([np.full(len(atoms), part), np.full(len(others), part - 1.0)])[:, None]

    def frame(x: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        return _line(np.zeros(3), axis(x))

    return Move(np.concatenate([atoms, others]), frame, False, share)


def _line(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    size = float(np.linalg.norm(b - a))
    return (a, (b - a) / size) if size > 0 else None
