"""Open chains of held distances, of any length; `sweeps` says how they are solved."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kcons.solvers.chains.strips import SHORT, long_strip, short_strip, whole_slots
from kcons.solvers.chains.sweeps import SLOT, project
from kcons.solvers.cluster_solver import Outcome
from kcons.solvers.kernels.aligned_memory import aligned
from kcons.solvers.kernels.eight_wide import WIDTH
from kcons.solvers.kernels.groups_of_eight import NO_NUMBERS, NO_POINTS, lattice_kind


class Chains:
    """Open paths of held distances, one after another.

    Parameters
    ----------
    rows : array_like of int, shape (n_rows,)
        Global row numbers, chain by chain, in the order of the path.
    offsets : array_like of int, shape (n_chains + 1,)
        Where each chain begins in `atoms`; the last entry is their number.
    atoms : array_like of int, shape (n_path_atoms,)
        Atoms of the paths, at least two each.
    lengths : array_like of float, shape (n_rows,)
        Lengths used where a call passes none.
    inv_mass : array_like of float, shape (n_path_atoms,)
        Inverse masses along the paths; 0 for a pinned atom.
    """

    name = "chain"

    def __init__(
        self,
        rows: ArrayLike,
        offsets: ArrayLike,
        atoms: ArrayLike,
        lengths: ArrayLike,
        inv_mass: ArrayLike,
    ) -> None:
        self.rows: NDArray[np.int64] = np.array(rows, dtype=np.int64).reshape(-1)
        self.lengths = np.array(lengths, dtype=np.float64).reshape(-1)
        bounds = np.array(offsets, dtype=np.int64)
        path = np.array(atoms, dtype=np.int64)
        inverse = np.array(inv_mass, dtype=np.float64)
        sizes = np.diff(bounds)
        if (sizes < 2).any():
            raise ValueError("a chain has at least two atoms")
        strips = [long_strip(bounds[c], sizes[c], c) for c in np.flatnonzero(sizes > SHORT).tolist()]
        short = np.flatnonzero(sizes <= SHORT)
        # Chains of similar length share a strip.
        short = short[np.argsort(-sizes[short], kind="stable")]
        strips += [short_strip(bounds, sizes, short[k : k + WIDTH]) for k in range(0, len(short), WIDTH)]
        place, owned, present, row = (np.concatenate([strip[k].reshape(-1) for strip in strips]) for k in range(4))
        lanes = [strip[0].size for strip in strips]
        self._starts = np.concatenate([[0], np.cumsum(lanes)]).astype(np.int64)
        self._atoms = (3 * path[place]).astype(np.uint32)
        # Numbers of one byte, which can be views of other arrays.
        self._owned = owned.astype(np.uint8)
        self._full = owned.reshape(-1, WIDTH).all(axis=1).astype(np.uint8)
        self._bonds = np.column_stack((np.delete(path, bounds[1:] - 1), np.delete(path, bounds[:-1]))).astype(np.uint32)
        self._rows = row.astype(np.uint32)
        self._present, self._weights = aligned(len(place)), aligned(len(place))
        self._present[:] = present
        self._weights[:] = np.where(owned, inverse[place], 0.0)
        self._wholes = np.array([whole_slots(strip[2]) for strip in strips]) + self._starts[:-1]
        self._longest = max(lanes) // WIDTH
        self._work = NO_NUMBERS
        self._undo = NO_NUMBERS

    @property
    def slots(self) -> int:
        """Groups of eight lanes that a sweep goes through."""
        return int(self._starts[-1]) // WIDTH

    def tables(self, numbers: NDArray[np.int64] | None = None) -> tuple[NDArray[Any], ...]:
        """What kernels that call `sweeps.project` need.

        Parameters
        ----------
        numbers : ndarray of int, optional
            What the atoms are called there, by what they are called here.

        Returns
        -------
        tuple of ndarray
            What `project` is given of the rows, flat, from `starts` to `wholes`; lengths; atoms of each row, flat;
            the rooms `work` and `undo`, of which only the sizes count.
        """
        atoms, bonds = self._atoms, self._bonds.ravel()
        if numbers is not None:
            atoms, bonds = (3 * numbers[atoms // 3]).astype(np.uint32), numbers[bonds].astype(np.uint32)
        return (
            self._starts, atoms, self._owned, self._full, self._rows, self._present, self._weights, self._wholes,
            self.lengths, bonds, *(np.broadcast_to(0.0, n) for n in self._rooms()),
        )  # fmt: skip

    def _rooms(self) -> tuple[int, int]:
        """Numbers to work with, and to undo with: the last strip is written once everything is known."""
        return self._longest * SLOT, 6 * int(self._starts[-2])

    def _run(
        self,
        points: NDArray[np.float64],
        references: NDArray[np.float64],
        velocities: NDArray[np.float64] | None,
        inv_dt: float,
        tangent: bool | None,
        given: NDArray[np.float64],
        lattice: NDArray[np.float64] | None,
        multipliers: NDArray[np.float64] | None,
    ) -> Outcome:
        if not len(self._work):
            self._work, self._undo = (aligned(n) for n in self._rooms())
        cell, kind = lattice_kind(lattice)
        return Outcome(
            *project(
                points,
                references,
                NO_POINTS if velocities is None else velocities,
                inv_dt,
                tangent,
                self._starts,
                self._atoms,
                self._owned,
                self._full,
                self._rows,
                self._present,
                self._weights,
                self._wholes,
                given,
                cell,
                kind,
                NO_NUMBERS if multipliers is None else multipliers,
                self._work,
                self._undo,
            )
        )

    def positions(
        self,
        x_new: NDArray[np.float64],
        x_ref: NDArray[np.float64],
        lengths: NDArray[np.float64] | None = None,
        lattice: NDArray[np.float64] | None = None,
        velocities: NDArray[np.float64] | None = None,
        inv_dt: float = 0.0,
        multipliers: NDArray[np.float64] | None = None,
    ) -> Outcome:
        """Move `x_new` along the gradients at `x_ref` onto the held lengths.

        Parameters
        ----------
        x_new, x_ref : ndarray, shape (n_atoms, 3)
            Positions to correct in place, and positions on the constraints.
        lengths : ndarray, shape (n_rows,), optional
            Held lengths now.
        lattice : ndarray, shape (2, 3, 3), optional
            Cell and its inverse; None without periodicity.
        velocities : ndarray, shape (n_atoms, 3), optional
            Receives the displacement times `inv_dt`.
        multipliers : ndarray, shape (n_rows,), optional
            Receives the multipliers of unit gradients.

        Returns
        -------
        Outcome
            Nothing has changed where it is not converged.
        """
        given = self.lengths if lengths is None else lengths
        return self._run(x_new, x_ref, velocities, inv_dt, None, given, lattice, multipliers)

    def tangents(
        self,
        x: NDArray[np.float64],
        y: NDArray[np.float64],
        rates: NDArray[np.float64] | None = None,
        lattice: NDArray[np.float64] | None = None,
        multipliers: NDArray[np.float64] | None = None,
    ) -> Outcome:
        """Project `y` (velocities, or forces per mass) so that lengths change at `rates`.

        Parameters
        ----------
        x, y : ndarray, shape (n_atoms, 3)
            Positions, and the vectors to project in place.
        rates : ndarray, shape (n_rows,), optional
            Wanted ``u·(y_i - y_j)``; zero where None or empty.
        lattice, multipliers
            As in `positions`.
        """
        given = NO_NUMBERS if rates is None else rates
        return self._run(y, x, None, 0.0, True, given, lattice, multipliers)
