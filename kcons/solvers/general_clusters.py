"""Any rows whatever: damped Newton with rank-revealing dense algebra, batches of equal clusters at once.

The sure solver. It serves clusters with interpreted rows (collective variables, user functions, surfaces
that have no kernel) and rescues small clusters on which a fast solver did not converge. Rows may depend
on each other: singular directions are cut, multipliers come out with least norm.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.solvers.cluster_solver import Outcome, Request
from kcons.solvers.rank_revealing import Stack, independent, least_norm, rank, stacks
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

#: What is to vanish at given positions, by row, or the numbers of its Jacobian.
_Measured = Callable[[FloatArray], FloatArray]


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
        incidence = self.subset.incidence
        columns = (3 * incidence.indices[:, None] + np.arange(3)).ravel()
        shape = len(rows), 3 * self.subset.n_atoms
        pattern = sp.csr_array((np.ones(len(columns)), columns, 3 * incidence.indptr), shape=shape)
        self._batches = list(stacks(pattern, labels)) if len(rows) else []

    # -- pieces ---------------------------------------------------------------------------------

    def _weighted(self, batch: Stack, data: FloatArray) -> FloatArray:
        return batch.dense(data) * self._root_w[batch.columns][:, None, :]

    def _rounding(self, batch: Stack, data: FloatArray, state: FloatArray) -> FloatArray:
        """Relative residual that rounding allows: max(1e-14, 2 eps sum |dq/dx_i| |x_i| / scale), (n, K)."""
        sizes = np.linalg.norm(state.reshape(-1)[batch.columns].reshape(len(batch.rows), -1, 3), axis=2)
        norms = np.linalg.norm(batch.dense(data).reshape(*batch.rows.shape, -1, 3), axis=3)
        reach = np.einsum("nka,na->nk", norms, sizes)
        return np.maximum(ROUNDING, 2 * EPS * reach / self._scale[batch.rows])

    def _measures(self, request: Request) -> tuple[_Measured, _Measured, bool]:
        """sigma and the data of the Jacobian by positions, and whether rows of velocities count in them.

        These have 0 for sigma without a flight; at its end they are off by what the way does along them in its middle.
        """
        subset, held = self.subset, self._held

        def sigma(state: FloatArray) -> FloatArray:
            return subset.value(state, request.time)

        def data(state: FloatArray) -> FloatArray:
            return np.asarray(subset.jacobian(state, request.time).data)

        if held.all() or not request.flight or request.wanted is None:
            return sigma, data, False
        start, wanted = request.reference[self.atoms], request.wanted[self.rows]
        middle = 0.5 * (request.reference_time + request.time)
        rolls = np.repeat(~held, 3 * np.diff(subset.incidence.indptr))

        def along(state: FloatArray) -> sp.csr_array:
            return subset.jacobian(0.5 * (start + state), middle)

        def slips(state: FloatArray) -> FloatArray:
            return np.where(held, sigma(state), along(state) @ (state - start).ravel() - wanted)

        return slips, lambda state: np.where(rolls, along(state).data, data(state)), True

    def _place(self, request: Request) -> None:
        self.subset.lattice = request.lattice
        self.subset.moved = None if request.moved is None else request.moved[self.atoms]

    # -- positions ------------------------------------------------------------------------------

    def positions(self, request: Request, multipliers: FloatArray | None = None) -> Outcome:
        """Solve sigma(x_new + M^-1 A(x_ref)^T Lambda, time) = 0 in place; see `Motion.project_positions`."""
        self._place(request)
        state = request.changed[self.atoms]
        measures = self._measures(request)
        with np.errstate(all="ignore"):
            reference = self.subset.jacobian(request.reference[self.atoms], request.reference_time).data
            total = np.zeros(len(self.rows))
            moves = np.zeros_like(state)
            worst = Outcome(True, 0.0, 0, -1)
            for batch in self._batches:
                along = self._weighted(batch, reference)
                outcome = self._newton(batch, state, moves, along, total, *measures)
                if not outcome.converged:
                    return outcome
                iterations = max(worst.iterations, outcome.iterations)
                worst = max(outcome, worst, key=lambda each: each.residual)._replace(iterations=iterations)
        request.changed[self.atoms] = state
        if request.velocities is not None:
            request.velocities[self.atoms] += request.inv_dt * moves
        if multipliers is not None:
            multipliers[:] = total
        return worst

    def _newton(
        self,
        batch: Stack,
        state: FloatArray,
        moves: FloatArray,
        b0: FloatArray,
        total: FloatArray,
        measured: _Measured,
        gradients: _Measured,
        rolling: bool,
    ) -> Outcome:
        """Damped Newton along fixed directions, all clusters of a batch side by side, in place."""
        held = self._held[batch.rows] | rolling
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
        sigma = measured(state)[batch.rows] * held
        error = _rms(sigma / scale)
        done = np.zeros(len(batch.rows), dtype=bool)
        polished = np.zeros(len(batch.rows), dtype=bool)
        taken = np.zeros(len(batch.rows))
        for iteration in range(1, MAX_ITERATIONS + 1):
            data = gradients(state)
            b = self._weighted(batch, data)
            relative = np.abs(sigma) / scale
            rounding = self._rounding(batch, data, state)
            settled = np.all(relative <= rounding, axis=1)
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
                trial = measured(state)[batch.rows] * held
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
            data = self.subset.jacobian(request.reference[self.atoms], request.time).data
            local = y[self.atoms]
            flat = local.reshape(-1)
            mu = np.zeros(len(self.rows))
            worst = Outcome(True, 0.0, 1, -1)
            for batch in self._batches:
                b = self._weighted(batch, data)
                size = np.linalg.norm(b, axis=2)
                speeds = flat[batch.columns]
                bad = ~(np.isfinite(size) & (size > 0)) | ~np.isfinite(speeds).all(axis=1, keepdims=True)
                if bad.any():
                    return _failed(batch, bad, 0)
                unit = b / size[..., None]
                root_w = self._root_w[batch.columns]
                free = root_w > 0
                wanted = np.zeros(size.shape) if rates is None else rates[self.rows[batch.rows]] / size
                if not free.all():
                    # Atoms of infinite mass move as prescribed; their part of A v is known.
                    gradient = batch.dense(data)
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

    def rank(self, here: Request) -> int:
        """Independent rows at `here.reference`, by singular values."""
        self.subset.moved = None if here.moved is None else here.moved[self.atoms]
        data = self.subset.jacobian(here.reference[self.atoms], here.time).data
        return sum(rank(self._weighted(batch, data)) for batch in self._batches)


def _failed(batch: Stack, bad: NDArray[np.bool_], iterations: int, residual: FloatArray | None = None) -> Outcome:
    """Outcome that names the worst of the bad rows."""
    size = np.where(bad, np.inf if residual is None else np.nan_to_num(residual, nan=np.inf), -1.0)
    where = np.unravel_index(int(np.argmax(size)), size.shape)
    return Outcome(False, float(size[where]), iterations, int(batch.rows[where]))


def _rms(values: FloatArray) -> FloatArray:
    return np.sqrt(np.mean(values**2, axis=1))
