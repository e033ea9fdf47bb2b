"""Massless sites that are placed by three atoms, such as M of TIP4P and the lone pairs of TIP5P."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import as_float_array
from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.errors import InputError


@dataclass(frozen=True, eq=False)
class VirtualSites:
    """Sites at r_0 + a (r_1 - r_0) + b (r_2 - r_0) + c (r_1 - r_0) x (r_2 - r_0).

    They have no mass and no degrees of freedom, so that nothing holds them: they are placed after every move of
    their parents, and their forces act on the parents.

    Attributes
    ----------
    sites : ndarray of int, shape (n,)
    parents : ndarray of int, shape (n, 3)
        Atoms 0, 1, 2; for water the oxygen and the hydrogens.
    coefficients : ndarray, shape (n, 3)
        a, b, and c in 1/length.
    """

    sites: IntArray
    parents: IntArray
    coefficients: FloatArray

    def __len__(self) -> int:
        return len(self.sites)

    def _arms(self, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        origin = x[self.parents[:, 0]]
        return origin, x[self.parents[:, 1]] - origin, x[self.parents[:, 2]] - origin

    def place(self, positions: ArrayLike) -> FloatArray:
        """Positions with the sites where they belong, shape (n_atoms, 3); molecules must be whole."""
        x = np.array(as_float_array(positions, "positions"))
        origin, u, w = self._arms(x)
        a, b, c = self.coefficients.T[:, :, None]
        x[self.sites] = origin + a * u + b * w + c * np.cross(u, w)
        return x

    def spread_forces(self, positions: ArrayLike, forces: ArrayLike) -> FloatArray:
        """Forces with those on the sites handed to the parents, shape (n_atoms, 3).

        The work along any motion of the parents, total force and torque stay the same.
        """
        x = as_float_array(positions, "positions")
        f = np.array(as_float_array(forces, "forces"))
        if f.shape != x.shape:
            raise InputError(f"forces have shape {f.shape}, positions {x.shape}", item="forces")
        _, u, w = self._arms(x)
        a, b, c = self.coefficients.T[:, :, None]
        acting = f[self.sites].copy()
        first = a * acting + c * np.cross(w, acting)
        second = b * acting + c * np.cross(acting, u)
        f[self.sites] = 0.0
        np.add.at(f, self.parents[:, 0], acting - first - second)
        np.add.at(f, self.parents[:, 1], first)
        np.add.at(f, self.parents[:, 2], second)
        return f

    def in_unit(self, factor: float) -> VirtualSites:
        """The same where lengths are given by numbers larger by `factor`."""
        return VirtualSites(self.sites, self.parents, np.asarray(self.coefficients / np.array([1.0, 1.0, factor])))


def fitted(sites: IntArray, parents: IntArray, r_site: FloatArray, r_parents: FloatArray) -> VirtualSites:
    """Sites with the coefficients that they have in given positions, each by itself.

    Parameters
    ----------
    r_site, r_parents : ndarray, shape (n, 3) and (n, 3, 3)
        Whole molecules.
    """
    u, w = r_parents[:, 1] - r_parents[:, 0], r_parents[:, 2] - r_parents[:, 0]
    frame = np.stack([u, w, np.cross(u, w)], axis=-1)
    coefficients = np.linalg.solve(frame, (r_site - r_parents[:, 0])[..., None])[..., 0]
    return VirtualSites(sites, parents, np.asarray(coefficients, dtype=np.float64))
