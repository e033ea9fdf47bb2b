"""Open chains of held distances, of any length; `sweeps` says how they are solved."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kcons.constraints.compilation import njit
from kcons.constraints.target import FloatArray
from kcons.solvers.addressable_solvers import Kernels
from kcons.solvers.chains.strips import SHORT, long_strip, short_strip, whole_slots
from kcons.solvers.chains.sweeps import BONDS, LENGTHS, SLOT, project
from kcons.solvers.cluster_solver import Outcome, Request, resume
from kcons.solvers.distance_clusters import PackedLanes, SimdClusterSolver, resolved
from kcons.solvers.kernels.aligned_memory import aligned, copied, in_one_array, part_of, room
from kcons.solvers.kernels.array_views import halves, integers, none_of, table_array
from kcons.solvers.kernels.eight_wide import WIDTH
from kcons.solvers.tolerances import MAX_ROUNDS


@njit(cache=True, nogil=True)
def _positions(alone, x, x_ref, v, inv_dt, wanted, lattice, kind, tables, numbers):
    """This and the next two as `kcons.solvers.addressable_solvers` says."""
    lengths = wanted if wanted.size else table_array(tables, integers(tables), LENGTHS)
    return project(None, x, x_ref, v, inv_dt, lengths, lattice, kind, none_of(tables), tables)


@njit(cache=True, nogil=True)
def _tangents(alone, x, y, wanted, lattice, kind, tables, numbers):
    none = none_of(tables)
    return project(True, y, x, none.reshape(0, 3), 0.0, wanted, lattice, kind, none, tables)


@njit(cache=True, nogil=True)
def _resolved(x, lattice, kind, tables):
    h = integers(tables)
    return resolved(x, table_array(halves(tables), h, BONDS), table_array(tables, h, LENGTHS), lattice, kind)


class Chains(SimdClusterSolver):
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
        Lengths used where a request names none.
    inv_mass : array_like of float, shape (n_path_atoms,)
        Inverse masses along the paths; 0 for a pinned atom.

    Attributes
    ----------
    slots : int
        Groups of eight lanes that a sweep goes through.
    """

    name = "Chains"
    _kernel = staticmethod(project)

    def __init__(
        self,
        rows: ArrayLike,
        offsets: ArrayLike,
        atoms: ArrayLike,
        lengths: ArrayLike,
        inv_mass: ArrayLike,
    ) -> None:
        # Slots name their rows: no lane repeats any.
        super().__init__(rows, lengths, np.size(rows))
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
        starts = np.concatenate([[0], np.cumsum([strip[0].size for strip in strips])]).astype(np.int64)
        lane_atoms, lane_rows = (3 * path[place]).astype(np.uint32), row.astype(np.uint32)
        # Numbers of one byte, which can be views of other arrays.
        full = np.asarray(owned.reshape(-1, WIDTH).all(axis=1), dtype=np.uint8)
        bonds, weights = aligned(len(place)), aligned(len(place))
        bonds[:] = present
        weights[:] = np.where(owned, inverse[place], 0.0)
        wholes = np.array([whole_slots(strip[2]) for strip in strips]) + starts[:-1]
        ends = np.column_stack((np.delete(path, bounds[1:] - 1), np.delete(path, bounds[:-1]))).astype(np.uint32)
        self._ends, self.slots = ends.ravel(), int(starts[-1]) // WIDTH
        self.tables = in_one_array(
            (
                *(starts, lane_atoms, np.asarray(owned, dtype=np.uint8), full, lane_rows, bonds, weights, wholes),
                *(self.lengths, self._ends),
                # To work in, and to undo with: the last strip is written once everything is known.
                *(room(int(np.diff(starts).max()) // WIDTH * SLOT), room(6 * int(starts[-2]))),
            )
        )

    def packed(self, numbers: NDArray[np.int64] | None = None) -> PackedLanes:
        """A copy for other kernels; `numbers` are what the atoms are called there, by what they are called here."""
        tables = copied(self.tables)
        if numbers is not None:
            atoms, ends = part_of(tables, 1, np.uint32), part_of(tables, BONDS, np.uint32)
            atoms[:], ends[:] = 3 * numbers[atoms // 3], numbers[ends]
        return PackedLanes(Kernels(_positions, _tangents, resolved=_resolved), tables)

    def positions(self, request: Request, multipliers: FloatArray | None = None) -> Outcome:
        """As `SimdClusterSolver.positions`, with a last look at the positions themselves.

        The multipliers of a long stretched chain can be so large that their rounding shows in the positions
        although the bond vectors of the iteration were exact; another round from there takes it away.
        """
        lengths = self.lengths if request.wanted is None else request.wanted[self.rows]
        outcome = super().positions(request, multipliers)
        for _ in range(MAX_ROUNDS):
            if not outcome.converged or resolved(request.changed, self._ends, lengths, self._cell, self._kind):
                break
            if not resume(super().positions, request, multipliers):
                break
        return outcome
