"""Torsions turned as rigid groups: a second estimate of the mean force, without the noise of bonds and angles."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from kcons.constraints.constraint import Constraint, IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.periodic.one_piece import minimum_image
from kcons.constraints.target import FloatArray, nearest_image
from kcons.constraints.vectors import cross, dot, norm

#: A trial turn in radian, what it may change of other rows, and by which factor a bond may change before it is broken.
_TRIAL, _SAME, _BROKEN = 0.3, 1e-8, 1.5


class RigidTurn(NamedTuple):
    """All atoms beyond the middle bond of a torsion, turned about it.

    Such a turn changes no bond and no angle, and has no divergence, so that dF/dphi is the weighted mean of the torque
    against it (Ciccotti, Lelievre and Vanden-Eijnden, Commun. Pure Appl. Math. 61, 371, 2008, for any such field).
    """

    #: Two atoms: a turn about the line from the first to the second by a positive angle makes the torsion larger.
    axis: IntArray
    #: The atoms that move.
    group: IntArray
    #: Those of the group, to the axis and of the axis, shape (b, 2), and their lengths.
    bonds: IntArray
    lengths: FloatArray

    def turned(self, x: FloatArray, angle: float) -> FloatArray:
        """Positions with the group turned, shape (n_atoms, 3)."""
        e = self._direction(x)
        r = x[self.group] - x[self.axis[1]]
        result = x.copy()
        result[self.group] += np.sin(angle) * cross(e, r) + (1 - np.cos(angle)) * (np.outer(r @ e, e) - r)
        return result

    def force(self, x: FloatArray, f: FloatArray) -> FloatArray:
        """dU/dphi of the turn, of one or several configurations; NaN where a bond of the group is broken, by a box for
        example."""
        i, j = self.bonds.T
        broken = (((x[..., i, :] - x[..., j, :]) ** 2).sum(axis=-1) > (_BROKEN * self.lengths) ** 2).any(axis=-1)
        arms = x[..., self.group, :] - x[..., self.axis[1:], :]
        torque = cross(arms, f[..., self.group, :]).sum(axis=-2)
        return np.where(broken, np.nan, -dot(self._direction(x), torque))

    def _direction(self, x: FloatArray) -> FloatArray:
        e: FloatArray = x[..., self.axis[1], :] - x[..., self.axis[0], :]
        return e / norm(e)[..., None]


def warn_of_gaps(coordinates: Mapping[str, Constraint], bonds: IntArray) -> None:
    """Warn of torsions over atoms that are not bonded: most often the atoms are in another order than the chain.

    Not of improper torsions, where one atom is bonded to the three others, nor of atoms without any bond.
    """
    joined, bonded = {frozenset(pair) for pair in bonds.tolist()}, set(bonds.ravel().tolist())
    for name, item in coordinates.items():
        for four in item.atoms.tolist() if item.family == "Dihedral" else ():
            if any(all({hub, other} in joined for other in four if other != hub) for hub in four):
                continue
            gaps = [pair for pair in pairwise(four) if {*pair} not in joined and bonded.issuperset(pair)]
            if gaps:
                said = ", ".join(f"{a}-{b}" for a, b in gaps) + (" are no bonds" if len(gaps) > 1 else " is no bond")
                warnings.warn(
                    f"{name} is a torsion over the atoms {', '.join(map(str, four))}, counted from 0, and {said}; give "
                    "the atoms in the order in which they are bonded, unless this is what you mean",
                    UserWarning,
                    stacklevel=4,
                )


def rigid_turn(
    coordinate: Constraint, bonds: IntArray, x: FloatArray, lattice: FloatArray | None = None
) -> RigidTurn | None:
    """The smaller group of one torsion; None of another coordinate, or where the middle bond is missing or in a ring.

    Bonds have their lengths in the lattice, also where a box has cut them.
    """
    if coordinate.family != "Dihedral":
        return None
    i, j, k, m = coordinate.atoms[0].tolist()
    middle = ((bonds == [j, k]) | (bonds == [k, j])).all(axis=1)
    if not middle.any():
        return None
    a, b = bonds[~middle].T
    part = connected_components(coo_array((np.ones(len(a)), (a, b)), shape=(len(x), len(x))), directed=False)[1]
    if part[j] == part[k] or part[i] != part[j] or part[m] != part[k]:
        return None
    beyond = [(np.flatnonzero(part == part[near]), far, near) for near, far in ((k, j), (j, k))]
    atoms, far, near = min(beyond, key=lambda side: len(side[0]))
    own = bonds[middle | (part[bonds[:, 0]] == part[near])]
    lengths = np.linalg.norm(minimum_image(x[own[:, 0]] - x[own[:, 1]], lattice), axis=1)
    return RigidTurn(np.array([far, near]), atoms[atoms != near], own, lengths)


def leaves_the_rest(
    turn: RigidTurn, row: int, everything: ConstraintSet, others: IntArray, x: FloatArray, time: float = 0.0
) -> bool:
    """Whether a turn changes its coordinate by its angle, no other row of the set, and not det(A M^-1 A^T) of `others`.

    `row` is that of the coordinate in the set, `others` the other rows of the clusters of the coordinates.
    """
    there = turn.turned(x, _TRIAL)
    change = everything.measure(there, time) - everything.measure(x, time)
    change[row] -= _TRIAL
    periods = np.concatenate([np.full(c.n_rows, c.period or 0.0) for c in everything.constraints])
    if not np.abs(nearest_image(change, periods)).max() < _SAME:
        return False
    part, atoms = everything.subset(others)
    before, after = (_volume(part, place[atoms]) for place in (x, there))
    return bool(np.isfinite(before) and abs(after - before) < _SAME)


def _volume(rows: ConstraintSet, x: FloatArray) -> float:
    """ln det(A M^-1 A^T); minus infinity where rows depend on each other."""
    if not rows.n_rows:
        return 0.0
    a = rows.jacobian(x).toarray() / np.sqrt(np.repeat(rows.masses, 3))
    return float(np.linalg.slogdet(a @ a.T)[1])
