"""Any rows whatever: damped Newton with rank-revealing dense algebra, batches of equal clusters at once.

The sure solver. It serves clusters with interpreted rows (collective variables, user functions, surfaces
that have no kernel) and rescues small clusters on which a fast solver did not converge. Rows may depend
on each other: singular directions are cut, multipliers come out with least norm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.solvers.cluster_solver import Outcome, Request
from kcons.solvers.rank_revealing import independent, least_norm, rank
from kcons.solvers.tolerances import (
    DENSE_SPEED_TOLERANCE,
    EPS,
    FLAT,
    MANY_ITERATIONS,
    MAX_HALVINGS,
    MAX_ITERATIONS,
    ROUNDING,
    ROUNDINGS,
)


@dataclass(frozen=True)
class _Batch:
    """Clusters with the same numbers of rows and columns."""

    rows: IntArray  # (n, K) within the subset
    columns: IntArray  # (n, C) Cartesian columns of the subset
    entries: IntArray  # where the subset's Jacobian data stand ...
    places: IntArray  # ... and where they go in the flat (n, K, C) array

    def gradients(self, data: FloatArray) -> FloatArray:
        """A of each cluster, shape (n, K, C), from the data of the subset's Jacobian."""
        found = np.zeros((*self.rows.shape, self.columns.shape[1]))
        found.reshape(-1)[self.places] = data[self.entries]
        return found


@dataclass(frozen=True)
class _Flight:
    """Where and when rows of velocities hold, and at what, as `Request` says."""

    subset: ConstraintSet
    start: FloatArray
    time: float
    wanted: FloatArray

    @property
    def entries(self) -> NDArray[np.bool_]:
        """Which of the Jacobian's data are those of rows of velocities."""
        return np.repeat(~self.subset.holonomic, 3 * np.diff(self.subset.incidence.indptr))

    @classmethod
    def of(cls, request: Request, subset: ConstraintSet, atoms: IntArray, rows: IntArray) -> _Flight | None:
        """For some atoms and rows; None where rows of velocities do not count."""
        if not request.flight or request.wanted is None:
            return None
        middle = 0.5 * (request.reference_time + request.time)
        return cls(subset, request.reference[atoms], middle, request.wanted[rows])

    def jacobian(self, end: FloatArray) -> csr_array:
        return self.subset.jacobian(0.5 * (self.start + end), self.time)

    def slips(self, end: FloatArray) -> FloatArray:
        """By how much rows of velocities are off at `end`; 0 for the others, as these have 0 for sigma."""
        found: FloatArray = self.jacobian(end) @ (end - self.start).ravel() - self.wanted
        return np.where(self.subset.holonomic, 0.0, found)


class GeneralClusters:
    """Solver for the clusters that `rows` form.

    Parameters
    ----------
    constraint_set : ConstraintSet
        The full set.
    rows : ndarray of int
        Global row numbers, sorted; whole clusters only.
    labels : ndarray of int, shape (len(rows),)
        Cluster number of each row.
    inverse_masses : ndarray, shape (n_atoms,)
        0 for atoms of infinite mass.
    """

    name = "GeneralClusters"

    def __init__(
        self, constraint_set: ConstraintSet, rows: IntArray, labels: IntArray, inverse_masses: FloatArray
    ) -> None:
        self.rows = rows
        self.subset, self.atoms = constraint_set.subset(rows)
        self._root_w = np.repeat(np.sqrt(inverse_masses[self.atoms]), 3)
        self._scale = self.subset.scale
        self._held = self.subset.holonomic
        #: Whether rows close through the boundary of the cell, so that whole positions alone do not tell their images.
        self.winds = any(item.cell_offsets is not None for item in self.subset.constraints)
        self._batches = self._make_batches(labels)

    def _make_batches(self, labels: IntArray) -> list[_Batch]:
        indptr, indices = self.subset.incidence.indptr, self.subset.incidence.indices
        order = np.argsort(labels, kind="stable")
        starts = np.flatnonzero(np.diff(labels[order], prepend=-1))
        members = [np.sort(m) for m in np.split(order, starts[1:])] if len(order) else []
        groups: dict[tuple[int, int], list[tuple[IntArray, IntArray]]] = {}
        for rows in members:
            atoms = np.unique(np.concatenate([indices[indptr[r] : indptr[r + 1]] for r in rows]))
            groups.setdefault((len(rows), len(atoms)), []).append((rows, atoms.astype(np.int64)))
        return [self._batch(group) for group in groups.values()]

    def _batch(self, group: list[tuple[IntArray, IntArray]]) -> _Batch:
        indptr, indices = self.subset.incidence.indptr, self.subset.incidence.indices
        rows = np.array([r for r, _ in group])
        atoms = np.array([a for _, a in group])
        n, k = rows.shape
        c = 3 * atoms.shape[1]
        place = np.zeros(self.subset.n_atoms, dtype=np.int64)
        entries, places = [], []
        for i in range(n):
            place[atoms[i]] = np.arange(atoms.shape[1])
            for j, row in enumerate(rows[i]):
                slots = np.arange(indptr[row], indptr[row + 1])
                entries.append((3 * slots[:, None] + np.arange(3)).ravel())
                local = 3 * place[indices[slots]][:, None] + np.arange(3)
                places.append(((i * k + j) * c + local).ravel())
        columns = (3 * atoms[:, :, None] + np.arange(3)).reshape(n, c)
        return _Batch(rows, columns, np.concatenate(entries), np.concatenate(places))

    # -- pieces ---------------------------------------------------------------------------------

    def _weighted(self, batch: _Batch, data: FloatArray) -> FloatArray:
        return batch.gradients(data) * self._root_w[batch.columns][:, None, :]

    def _rounding(self, batch: _Batch, data: FloatArray, state: FloatArray) -> FloatArray:
        """Relative residual that rounding allows: max(1e-14, 2 eps sum |dq/dx_i| |x_i| / scale), (n, K)."""
        sizes = np.linalg.norm(state.reshape(-1)[batch.columns].reshape(len(batch.rows), -1, 3), axis=2)
        norms = np.linalg.norm(batch.gradients(data).reshape(*batch.rows.shape, -1, 3), axis=3)
        reach = np.einsum("nka,na->nk", norms, sizes)
        return np.maximum(ROUNDING, 2 * EPS * reach / self._scale[batch.rows])

    def _sigma(self, batch: _Batch, state: FloatArray, time: float, flight: _Flight | None = None) -> FloatArray:
        return (self.subset.value(state, time) + (0.0 if flight is None else flight.slips(state)))[batch.rows]

    def _data(self, state: FloatArray, time: float, flight: _Flight | None = None) -> FloatArray:
        data = self.subset.jacobian(state, time).data
        return data if flight is None else np.where(flight.entries, flight.jacobian(state).data, data)

    def _place(self, request: Request) -> None:
        self.subset.lattice = request.lattice
        self.subset.moved = None if request.moved is None else request.moved[self.atoms]

    # -- positions ------------------------------------------------------------------------------

    def positions(self, request: Request, multipliers: FloatArray | None = None) -> Outcome:
        """Solve sigma(x_new + M^-1 A(x_ref)^T Lambda, time) = 0 in place; see `Motion.project_positions`."""
        self._place(request)
        state = request.changed[self.atoms]
        flight = None if self._held.all() else _Flight.of(request, self.subset, self.atoms, self.rows)
        with np.errstate(all="ignore"):
            reference = self._data(request.reference[self.atoms], request.reference_time)
            total = np.zeros(len(self.rows))
            moves = np.zeros_like(state)
            worst = Outcome(True, 0.0, 0, -1)
            for batch in self._batches:
                along = self._weighted(batch, reference)
                outcome = self._newton(batch, state, moves, along, request.time, total, flight)
                if not outcome.converged:
                    return outcome
                worst = _worse(worst, outcome)
        request.changed[self.atoms] = state
        if request.velocities is not None:
            request.velocities[self.atoms] += request.inv_dt * moves
        if multipliers is not None:
            multipliers[:] = total
        return worst

    def _newton(
        self,
        batch: _Batch,
        state: FloatArray,
        moves: FloatArray,
        b0: FloatArray,
        time: float,
        total: FloatArray,
        flight: _Flight | None,
    ) -> Outcome:
        """Damped Newton along fixed directions, all clusters of a batch side by side, in place."""
        held = self._held[batch.rows] | (flight is not None)
        size0 = np.linalg.norm(b0, axis=2)
        bad = held & ~(np.isfinite(size0) & (size0 > 0))
        if bad.any():
            return _failed(batch, bad, 0)
        unit0 = np.where(held[..., None], b0 / size0[..., None], 0.0)
        # Unknowns are the parts along an orthonormal basis of the reference rows: the matrix then has the
        # condition of the rows and not its square, and dependent rows are out of it from the start.
        u0, s0, v0t = np.linalg.svd(unit0, full_matrices=False)
        kept = independent(s0)
        basis = v0t * kept[..., None]
        scale = self._scale[batch.rows]
        root_w = self._root_w[batch.columns]
        flat, flat_moves = state.reshape(-1), moves.reshape(-1)
        along = np.zeros(kept.shape)
        sigma = self._sigma(batch, state, time, flight) * held
        error = _rms(sigma / scale)
        done = np.zeros(len(batch.rows), dtype=bool)
        polished = np.zeros(len(batch.rows), dtype=bool)
        taken = np.zeros(len(batch.rows))
        for iteration in range(1, MAX_ITERATIONS + 1):
            data = self._data(state, time, flight)
            b = self._weighted(batch, data)
            relative = np.abs(sigma) / scale
            rounding = self._rounding(batch, data, state)
            settled = _each(relative <= rounding)
            done |= settled & (polished | (error == 0.0))
            taken += ~done
            if done.all():
                least = np.where(taken < MANY_ITERATIONS, 0.0, FLAT)[:, None] * size0**2
                turned = held & ~(np.einsum("nkc,nkc->nk", b, b0) > least)
                if turned.any():
                    return _failed(batch, turned, iteration)
                unit_lam = np.einsum("nkr,nr->nk", u0, np.where(kept, along / np.where(kept, s0, 1.0), 0.0))
                total[batch.rows] = np.where(held, unit_lam / np.where(held, size0, 1.0), 0.0)
                where = np.unravel_index(int(np.argmax(relative)), relative.shape)
                return Outcome(True, float(relative[where]), iteration, int(batch.rows[where]))
            size = np.linalg.norm(b, axis=2)
            bad = held & ~(np.isfinite(size) & (size > 0) & np.isfinite(sigma))
            if bad.any():
                return _failed(batch, bad, iteration)
            safe = np.where(held, size, 1.0)
            rows = np.where(held[..., None], b / safe[..., None], 0.0)
            step = -least_norm(np.einsum("nkc,nrc->nkr", rows, basis), sigma / safe)
            shift = root_w * np.einsum("nrc,nr->nc", basis, step)
            here = flat[batch.columns]
            factor = np.where(done, 0.0, 1.0)
            for _ in range(MAX_HALVINGS):
                flat[batch.columns] = here + factor[:, None] * shift
                trial = self._sigma(batch, state, time, flight) * held
                trial_error = _rms(trial / scale)
                # Clusters at the rounding error take one more step only if it gains.
                worse = ~(trial_error < error) & (factor > 0)
                if not worse.any():
                    break
                polished |= worse & settled
                factor = np.where(worse, np.where(settled, 0.0, 0.5 * factor), factor)
            else:
                flat[batch.columns] = here
                if not (relative <= ROUNDINGS * np.sqrt(relative.shape[1]) * rounding)[worse].all():
                    return _failed(batch, held & worse[:, None], iteration, relative)
                done |= worse
                continue
            polished |= settled
            along += factor[:, None] * step
            flat_moves[batch.columns] += factor[:, None] * shift
            sigma, error = trial, trial_error
        return _failed(batch, held & ~done[:, None], MAX_ITERATIONS, np.abs(sigma) / scale)

    # -- tangents -------------------------------------------------------------------------------

    def tangents(self, request: Request, multipliers: FloatArray | None = None) -> Outcome:
        """y <- y - M^-1 A^T mu with A y = rates, in place; see `Motion.project_velocities`."""
        rates, y = request.wanted, request.changed
        self._place(request)
        with np.errstate(all="ignore"):
            data = self._data(request.reference[self.atoms], request.time)
            local = y[self.atoms]
            flat = local.reshape(-1)
            mu = np.zeros(len(self.rows))
            worst = Outcome(True, 0.0, 1, -1)
            for batch in self._batches:
                b = self._weighted(batch, data)
                size = np.linalg.norm(b, axis=2)
                speeds = flat[batch.columns]
                bad = ~(np.isfinite(size) & (size > 0)) | ~_each(np.isfinite(speeds))[:, None]
                if bad.any():
                    return _failed(batch, bad, 0)
                unit = b / size[..., None]
                root_w = self._root_w[batch.columns]
                free = root_w > 0
                wanted = np.zeros(size.shape) if rates is None else rates[self.rows[batch.rows]] / size
                if not free.all():
                    # Atoms of infinite mass move as prescribed; their part of A v is known.
                    gradient = np.zeros(b.shape)
                    gradient.reshape(-1)[batch.places] = data[batch.entries]
                    wanted = wanted - np.einsum("nkc,nc->nk", gradient, np.where(free, 0.0, speeds)) / size
                scaled = np.where(free, speeds / np.where(free, root_w, 1.0), 0.0)
                reach = np.maximum(np.linalg.norm(scaled, axis=1), np.linalg.norm(wanted, axis=1))
                u, s, _ = np.linalg.svd(unit, full_matrices=False)
                inverse = np.where(independent(s), 1 / s**2, 0.0)
                total = np.zeros(size.shape)
                for _ in range(3):
                    miss = np.einsum("nkc,nc->nk", unit, scaled) - wanted
                    step = np.einsum("nkr,nr->nk", u, inverse * np.einsum("nkr,nk->nr", u, miss))
                    scaled = scaled - np.einsum("nkc,nk->nc", unit, step)
                    total += step
                miss = np.abs(np.einsum("nkc,nc->nk", unit, scaled) - wanted)
                bad = ~(miss <= DENSE_SPEED_TOLERANCE * reach[:, None])
                if bad.any():
                    return _failed(batch, bad, 3, miss)
                flat[batch.columns] = np.where(free, root_w * scaled, speeds)
                mu[batch.rows] = total / size
                natural = miss * size
                where = np.unravel_index(int(np.argmax(natural)), natural.shape)
                if natural[where] >= worst.residual:
                    worst = Outcome(True, float(natural[where]), 1, int(batch.rows[where]))
        y[self.atoms] = local
        if multipliers is not None:
            multipliers[:] = mu
        return worst

    def rank(self, x: FloatArray, time: float, moved: FloatArray | None = None) -> int:
        """Independent rows at `x`, by singular values; `moved` as in `Request`."""
        self.subset.moved = None if moved is None else moved[self.atoms]
        data = self._data(x[self.atoms], time)
        return sum(rank(self._weighted(batch, data)) for batch in self._batches)


def _worse(one: Outcome, other: Outcome) -> Outcome:
    """The outcome with the larger residual, with the larger number of iterations of the two."""
    chosen = other if other.residual >= one.residual else one
    return chosen._replace(iterations=max(one.iterations, other.iterations))


def _failed(batch: _Batch, bad: NDArray[np.bool_], iterations: int, residual: FloatArray | None = None) -> Outcome:
    """Outcome that names the worst of the bad rows."""
    size = np.where(bad, np.inf if residual is None else np.nan_to_num(residual, nan=np.inf), -1.0)
    where = np.unravel_index(int(np.argmax(size)), size.shape)
    return Outcome(False, float(size[where]), iterations, int(batch.rows[where]))


def _each(test: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """For each cluster, whether all of its rows pass."""
    return np.asarray(np.all(test, axis=1), dtype=np.bool_)


def _rms(values: FloatArray) -> FloatArray:
    return np.sqrt(np.mean(values**2, axis=1))
