"""A model of the Hessian of a molecule from its geometry alone, and the internal coordinates it is made of.

E = sum of k_i (q_i - q_i0)^2/2 over distances, angles and dihedrals q_i of neighbors, with constants k_i that fall off
with the distances of the atoms. No bonds need to be known, and weak contacts have weak constants.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from ase import units

from kcons.constraints import Angle, Constraint, Dihedral, Distance
from kcons.constraints.constraint import IntArray
from kcons.constraints.periodic.one_piece import lined_up, minimum_image
from kcons.constraints.target import FloatArray
from kcons.constraints.vectors import cross, dot, norm

#: Constants of the model in hartree and bohr: of distances, angles and dihedrals.
STRETCH, BEND, TURN = 0.45, 0.15, 0.005
#: Exponents and lengths for atoms of the first, second and later rows of the periodic table, in bohr.
_EXPONENT = np.array([[1.0, 0.3949, 0.3949], [0.3949, 0.28, 0.28], [0.3949, 0.28, 0.28]])
_LENGTH = np.array([[1.35, 2.1, 2.53], [2.1, 2.87, 3.4], [2.53, 3.4, 3.4]])
#: Closeness below which a term is left out: atoms that are bonded have about 1.
LEAST_PAIR, LEAST = 1e-3, 1e-2
#: Sine of an angle below which it counts as straight.
STRAIGHT = 0.2


class Internals:
    """Internal coordinates with the constants of the model, chosen from positions in angstrom.

    R. Lindh, A. Bernhardsson, G. Karlström and P.-Å. Malmqvist, Chem. Phys. Lett. 241, 423 (1995).
    """

    def __init__(self, numbers: Sequence[int] | IntArray, x: FloatArray, lattice: FloatArray | None = None) -> None:
        self.lattice, self.n_atoms = lattice, len(x)
        row = np.searchsorted([2, 10], np.asarray(numbers))
        apart = norm(minimum_image(x[None] - x[:, None], lattice)) / units.Bohr
        close = np.exp(_EXPONENT[row[:, None], row] * (_LENGTH[row[:, None], row] ** 2 - apart**2))
        np.fill_diagonal(close, 0.0)
        near = close >= LEAST
        pairs = np.argwhere(np.triu(close >= LEAST_PAIR))
        triples = [
            (i, j, k)
            for j in range(self.n_atoms)
            for i in np.flatnonzero(near[j])
            for k in np.flatnonzero(near[j])
            if i < k and close[i, j] * close[j, k] >= LEAST
        ]
        table = np.array(triples, dtype=np.int64).reshape(-1, 3)
        sine = self._sines(x, table)
        bent = table[sine >= STRAIGHT]
        quads = [
            (i, j, k, l)
            for i, j, k in (tuple(t) for half in (bent, bent[:, ::-1]) for t in half.tolist())
            for l in np.flatnonzero(near[k])
            if l not in (i, j) and i < l and close[i, j] * close[j, k] * close[k, l] >= LEAST
        ]
        turns = np.array(quads, dtype=np.int64).reshape(-1, 4)
        turns = turns[self._sines(x, turns[:, 1:]) >= STRAIGHT]
        self._straight = table[sine < STRAIGHT]
        self._families: list[Constraint] = [Distance(pairs), Angle(bent), Dihedral(turns)]
        # From now on each term keeps its images: in a small cell, others may come as near.
        tables = [*(item.atoms for item in self._families), self._straight]
        self._images = [lined_up(x[atoms], lattice) - x[atoms] for atoms in tables]
        self._frames = self._sideways(x)
        energy = units.Hartree
        stretch = STRETCH * close[*pairs.T] * energy / units.Bohr**2
        bend = BEND * close[*bent[:, :2].T] * close[*bent[:, 1:].T] * energy
        turn = TURN * close[*turns[:, :2].T] * close[*turns[:, 1:3].T] * close[*turns[:, 2:].T] * energy
        flat = BEND * close[*self._straight[:, :2].T] * close[*self._straight[:, 1:].T] * energy
        #: In eV and angstrom or radian; and the atoms of each.
        self.constants: FloatArray = np.concatenate([stretch, bend, turn, flat, flat])
        self.terms = [tuple(row) for item in self._families for row in item.atoms.tolist()]
        # The two directions across a straight angle are those of this structure alone.
        self.terms += [(*row, -1, side) for side in (0, 1) for row in self._straight.tolist()]

    def remapped(self, data: FloatArray, terms: Sequence[tuple[int, ...]]) -> FloatArray:
        """Data for other terms, shape (..., m), as data for these; zero for terms that were not among them."""
        place = {term: n for n, term in enumerate(terms) if -1 not in term}
        mine = [(n, place[term]) for n, term in enumerate(self.terms) if term in place]
        result = np.zeros((*data.shape[:-1], len(self.terms)))
        if mine:
            here, there = np.array(mine).T
            result[..., here] = data[..., there]
        return result

    def _gathered(self, x: FloatArray) -> list[FloatArray]:
        """The atoms of each distance, angle, dihedral and straight angle, in the images next to each other."""
        tables = [*(item.atoms for item in self._families), self._straight]
        return [x[atoms] + images for atoms, images in zip(tables, self._images, strict=True)]

    def _sines(self, x: FloatArray, triples: IntArray) -> FloatArray:
        r = lined_up(x[triples], self.lattice)
        u, w = r[:, 0] - r[:, 1], r[:, 2] - r[:, 1]
        return norm(cross(u, w)) / (norm(u) * norm(w))

    def _sideways(self, x: FloatArray) -> FloatArray:
        """Two directions across each straight angle, shape (2, n, 3)."""
        r = self._gathered(x)[-1]
        axis = (r[:, 2] - r[:, 0]) / norm(r[:, 2] - r[:, 0])[:, None]
        first = cross(axis, np.eye(3)[np.argmin(np.abs(axis), axis=1)])
        first /= norm(first)[:, None]
        return np.stack([first, cross(axis, first)])

    def values(self, x: FloatArray) -> FloatArray:
        """Angstrom and radian, shape (n,)."""
        *gathered, r = self._gathered(x)
        found = [item.measure(part, 0.0) for item, part in zip(self._families, gathered, strict=True)]
        u, w = r[:, 0] - r[:, 1], r[:, 2] - r[:, 1]
        bow = u / norm(u)[:, None] + w / norm(w)[:, None]
        return np.concatenate([*found, *np.einsum("sni,ni->sn", self._frames, bow)])

    def change(self, after: FloatArray, before: FloatArray) -> FloatArray:
        """Difference of two sets of values, dihedrals by the shorter way."""
        d = after - before
        first = self._families[0].n_rows + self._families[1].n_rows
        turns = slice(first, first + self._families[2].n_rows)
        d[turns] -= 2 * np.pi * np.round(d[turns] / (2 * np.pi))
        return d

    def jacobian(self, x: FloatArray) -> FloatArray:
        """dq/dx, shape (n, 3 n_atoms)."""
        table = np.zeros((len(self.constants), self.n_atoms, 3))
        *gathered, r = self._gathered(x)
        rows = iter(np.split(np.arange(len(table)), np.cumsum([*(c.n_rows for c in self._families), len(r)])))
        for item, part in zip(self._families, gathered, strict=True):
            table[next(rows)[:, None], item.atoms] = item.gradient(part, 0.0)
        for side, mine in zip(self._frames, rows, strict=True):
            for end in (0, 2):
                arm = r[:, end] - r[:, 1]
                slope = side / norm(arm)[:, None] - arm * (dot(side, arm) / norm(arm) ** 3)[:, None]
                table[mine, self._straight[:, end]] += slope
                table[mine, self._straight[:, 1]] -= slope
        return table.reshape(len(table), 3 * self.n_atoms)

    def hessian(self, x: FloatArray) -> FloatArray:
        """Of the model with its minimum at `x`, in eV/angstrom^2, shape (3 n_atoms, 3 n_atoms)."""
        table = self.jacobian(x)
        return np.asarray(table.T @ (self.constants[:, None] * table))
