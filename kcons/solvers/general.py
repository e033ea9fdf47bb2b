"""Any rows whatever: damped Newton with rank-revealing dense algebra, one cluster at a time.

The slow, sure solver. It serves small clusters with interpreted rows (collective variables, user
functions) and rescues clusters on which a fast solver did not converge. Rows may depend on each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kcons.constraint_set import ConstraintSet
from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.solvers.outcome import Outcome

#: Singular values of the row-normalised, mass-weighted matrix below this part of the largest are redundant.
RANK_TOLERANCE = 1e-8
MAX_ITERATIONS = 50
_HALVINGS = 30


@dataclass(frozen=True)
class _Cluster:
    rows: IntArray  # within the subset
    columns: IntArray  # Cartesian columns of the subset's Jacobian


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

    name = "general"

    def __init__(
        self, constraint_set: ConstraintSet, rows: IntArray, labels: IntArray, inverse_masses: FloatArray
    ) -> None:
        self.rows = rows
        self.subset, self.atoms = constraint_set.subset(rows)
        self._root_w = np.repeat(np.sqrt(inverse_masses[self.atoms]), 3)
        self._scale = self.subset.scale
        self._holonomic = self.subset.holonomic
        incidence = self.subset.incidence
        self._clusters: list[_Cluster] = []
        order = np.argsort(labels, kind="stable")
        cuts = np.flatnonzero(np.diff(labels[order])) + 1
        for members in np.split(order, cuts):
            if len(members) == 0:
                continue
            touched = np.unique(incidence[members].indices)
            columns = (3 * touched[:, None] + np.arange(3)).ravel()
            self._clusters.append(_Cluster(np.sort(members), columns))

    # -- positions ------------------------------------------------------------------------------

    def positions(
        self,
        x_new: FloatArray,
        x_ref: FloatArray,
        targets: FloatArray | None,
        lattice: FloatArray | None,
        velocities: FloatArray | None,
        inv_dt: float,
        multipliers: FloatArray | None,
        time: float,
        reference_time: float,
    ) -> Outcome:
        """Solve sigma(x_new + M^-1 A(x_ref)^T Lambda, time) = 0 in place; see `Motion.project_positions`."""
        start = x_new[self.atoms]
        directions = self._weighted(x_ref[self.atoms], reference_time)
        state = start.copy()
        total = np.zeros(len(self.rows))
        worst, worst_row, most = 0.0, -1, 0
        for cluster in self._clusters:
            done, residual, row, iterations = self._newton(cluster, start, state, directions, time, total)
            most = max(most, iterations)
            if not done:
                return Outcome(False, residual, iterations, row)
            if residual > worst:
                worst, worst_row = residual, row
        change = state - start
        x_new[self.atoms] = state
        if velocities is not None:
            velocities[self.atoms] += inv_dt * change
        if multipliers is not None:
            multipliers[:] = total
        return Outcome(True, worst, most, worst_row)

    def _newton(
        self,
        cluster: _Cluster,
        start: FloatArray,
        state: FloatArray,
        directions: FloatArray,
        time: float,
        total: FloatArray,
    ) -> tuple[bool, float, int, int]:
        """Damped Newton for one cluster along fixed directions; changes `state` and `total` in place."""
        rows, columns = cluster.rows, cluster.columns
        held = self._holonomic[rows]
        rows = rows[held]
        if len(rows) == 0:
            return True, 0.0, -1, 0
        b0 = directions[rows][:, columns]
        size0 = _row_norms(b0)
        if not np.all(size0 > 0):
            return False, np.inf, int(rows[np.argmin(size0)]), 0
        b0 = b0 / size0[:, None]
        root_w = self._root_w[columns]
        scale = self._scale[rows]
        flat, flat_start = state.reshape(-1), start.reshape(-1)
        lam = np.zeros(len(rows))  # multiplies the normalised rows of b0

        def sigma_at(trial: FloatArray) -> FloatArray:
            flat[columns] = flat_start[columns] + root_w * (b0.T @ trial)
            return self.subset.value(state, time)[rows]

        sigma = sigma_at(lam)
        error = _norm(sigma / scale)
        previous = np.inf
        for iteration in range(1, MAX_ITERATIONS + 1):
            b = self._weighted(state, time)[rows][:, columns]
            floor = self._floor(b, columns, rows, state, scale)
            relative = np.abs(sigma) / scale
            converged = bool(np.all(relative <= floor))
            if converged and (error == 0.0 or error > 0.25 * previous):
                flipped = np.einsum("ij,ij->i", b, b0) <= 0
                if flipped.any():
                    return False, np.inf, int(rows[np.argmax(flipped)]), iteration
                total[rows] = lam / size0
                k = int(np.argmax(relative))
                return True, float(relative[k]), int(rows[k]), iteration
            if not np.all(np.isfinite(b)):
                return False, np.inf, int(rows[np.argmin(np.isfinite(b).all(axis=1))]), iteration
            size = _row_norms(b)
            if not np.all(size > 0):
                return False, np.inf, int(rows[np.argmin(size)]), iteration
            step = -_pseudo_solve((b @ b0.T) / size[:, None], sigma / size)
            previous = error
            factor = 1.0
            for _ in range(_HALVINGS):
                trial_sigma = sigma_at(lam + factor * step)
                trial_error = _norm(trial_sigma / scale)
                if trial_error < error or (converged and factor == 1.0):
                    break
                factor *= 0.5
            else:
                if converged:
                    previous = 0.0
                    sigma = sigma_at(lam)
                    continue
                sigma_at(lam)
                k = int(np.argmax(relative))
                return False, float(relative[k]), int(rows[k]), iteration
            if converged and not trial_error < error:
                sigma, previous = sigma_at(lam), 0.0  # at the floor: keep the better point
                continue
            lam, sigma, error = lam + factor * step, trial_sigma, trial_error
        relative = np.abs(sigma) / scale
        k = int(np.nanargmax(relative)) if np.isfinite(relative).any() else 0
        return False, float(relative[k]), int(rows[k]), MAX_ITERATIONS

    def _floor(
        self, b: FloatArray, columns: IntArray, rows: IntArray, state: FloatArray, scale: FloatArray
    ) -> FloatArray:
        """Relative residual that double precision allows: max(1e-14, 2 eps sum |dq/dx_i| |x_i| / scale)."""
        w = self._root_w[columns]
        gradient = np.divide(b, w, out=np.zeros_like(b), where=w > 0)
        n = len(columns) // 3
        sizes = np.linalg.norm(state.reshape(-1)[columns].reshape(n, 3), axis=1)
        reach = np.linalg.norm(gradient.reshape(len(rows), n, 3), axis=2) @ sizes
        return np.maximum(1e-14, 2 * np.finfo(float).eps * reach / scale)

    def restore(self, x: FloatArray, *, time: float) -> Outcome:
        """Bring far-off positions onto the surface in place: the nearest point in the mass metric.

        First damped Gauss-Newton with the gradients at the current point, then the fixed-point iteration
        x <- x0 + M^-1 A(x)^T lambda, which settles on the foot of the mass-weighted perpendicular.
        """
        start = x[self.atoms]
        state = start.copy()
        worst, worst_row, most = 0.0, -1, 0
        for cluster in self._clusters:
            rows = cluster.rows[self._holonomic[cluster.rows]]
            if len(rows) == 0:
                continue
            outcome = self._gauss_newton(rows, cluster.columns, state, time)
            if not outcome.converged:
                return outcome
            self._nearest(rows, cluster.columns, start, state, time)
            outcome = self._gauss_newton(rows, cluster.columns, state, time)
            if not outcome.converged:
                return outcome
            most = max(most, outcome.iterations)
            if outcome.residual > worst:
                worst, worst_row = outcome.residual, outcome.worst_row
        x[self.atoms] = state
        return Outcome(True, worst, most, worst_row)

    def _gauss_newton(self, rows: IntArray, columns: IntArray, state: FloatArray, time: float) -> Outcome:
        root_w = self._root_w[columns]
        scale = self._scale[rows]
        flat = state.reshape(-1)
        sigma = self.subset.value(state, time)[rows]
        error = _norm(sigma / scale)
        for iteration in range(1, 201):
            b = self._weighted(state, time)[rows][:, columns]
            relative = np.abs(sigma) / scale
            k = int(np.argmax(relative))
            converged = bool(np.all(relative <= self._floor(b, columns, rows, state, scale)))
            if converged and relative[k] == 0.0:
                return Outcome(True, 0.0, iteration, int(rows[k]))
            if not np.all(np.isfinite(b)):
                return Outcome(False, np.inf, iteration, int(rows[np.argmin(np.isfinite(b).all(axis=1))]))
            size = _row_norms(b)
            if not np.all(size > 0):
                return Outcome(False, np.inf, iteration, int(rows[np.argmin(size)]))
            b = b / size[:, None]
            step = -root_w * _pseudo_solve(b, sigma / size)
            here = flat[columns].copy()
            factor = 1.0
            for _ in range(_HALVINGS):
                flat[columns] = here + factor * step
                trial = self.subset.value(state, time)[rows]
                trial_error = _norm(trial / scale)
                # A mere rounding-sized gain is a stall, not progress.
                if trial_error < error * (1 - 1e-3 * factor):
                    break
                factor *= 0.5
            else:
                flat[columns] = here
                return Outcome(converged, float(relative[k]), iteration, int(rows[k]))
            sigma, error = trial, trial_error
        relative = np.abs(sigma) / scale
        k = int(np.argmax(relative))
        return Outcome(False, float(relative[k]), 200, int(rows[k]))

    def _nearest(
        self, rows: IntArray, columns: IntArray, start: FloatArray, state: FloatArray, time: float
    ) -> None:
        """Fixed-point iteration towards the nearest point; leaves `state` as it was if that fails."""
        root_w = self._root_w[columns]
        flat, origin = state.reshape(-1), start.reshape(-1)[columns]
        kept = flat[columns].copy()
        move = np.inf
        for _ in range(100):
            b = self._weighted(state, time)[rows][:, columns]
            size = _row_norms(b)
            if not (np.all(np.isfinite(b)) and np.all(size > 0)):
                break
            b = b / size[:, None]
            here = flat[columns]
            away = np.divide(here - origin, root_w, out=np.zeros_like(here), where=root_w > 0)
            target = b @ away - self.subset.value(state, time)[rows] / size
            flat[columns] = origin + root_w * _pseudo_solve(b, target)
            last, move = move, _norm(flat[columns] - here)
            if not move < 4 * max(last, 1e-300) or not np.isfinite(move):
                break
            if move <= 1e-15 * max(1.0, _norm(here)):
                return
            if move >= last and move < 1e-12 * max(1.0, _norm(here)):
                return
        if not np.isfinite(move) or move > 1e-9:
            flat[columns] = kept

    # -- tangents -------------------------------------------------------------------------------

    def tangents(
        self,
        x: FloatArray,
        y: FloatArray,
        rates: FloatArray | None,
        lattice: FloatArray | None,
        multipliers: FloatArray | None,
        time: float,
    ) -> Outcome:
        """y <- y - M^-1 A^T mu with A y = rates, in place; see `Motion.project_velocities`."""
        b = self._weighted(x[self.atoms], time)
        local = y[self.atoms]
        flat = local.reshape(-1)
        mu = np.zeros(len(self.rows))
        worst, worst_row = 0.0, -1
        for cluster in self._clusters:
            rows, columns = cluster.rows, cluster.columns
            part = b[rows][:, columns]
            size = _row_norms(part)
            if not (np.all(np.isfinite(part)) and np.all(size > 0)):
                bad = ~(np.isfinite(part).all(axis=1) & (size > 0))
                return Outcome(False, np.inf, 0, int(rows[np.argmax(bad)]))
            unit = part / size[:, None]
            root_w = self._root_w[columns]
            wanted = np.zeros(len(rows)) if rates is None else rates[self.rows[rows]] / size
            scaled = np.divide(flat[columns], root_w, out=np.zeros(len(columns)), where=root_w > 0)
            pinned = root_w == 0
            gram = _Gram(unit)
            # Pinned atoms move as prescribed; their part of A v is known.
            if pinned.any():
                jacobian = self.subset.jacobian(x[self.atoms], time)[rows][:, columns].toarray()
                wanted = wanted - (jacobian[:, pinned] @ flat[columns][pinned]) / size
            sum_mu = np.zeros(len(rows))
            before = _norm(scaled)
            for _ in range(3):
                miss = unit @ scaled - wanted
                step = gram.solve(miss)
                scaled = scaled - unit.T @ step
                sum_mu += step
            miss = np.abs(unit @ scaled - wanted)
            speed = max(before, _norm(scaled), _norm(wanted), np.finfo(float).tiny)
            k = int(np.argmax(miss))
            if not miss[k] <= 1e-11 * speed:
                return Outcome(False, float(miss[k] / speed), 3, int(rows[k]))
            flat[columns] = np.where(pinned, flat[columns], root_w * scaled)
            mu[rows] = gram.least_norm(sum_mu / size, size)
            if miss[k] * size[k] > worst:
                worst, worst_row = float(miss[k] * size[k]), int(rows[k])
        y[self.atoms] = local
        if multipliers is not None:
            multipliers[:] = mu
        return Outcome(True, worst, 1, worst_row)

    # -- pieces ---------------------------------------------------------------------------------

    def _weighted(self, local: FloatArray, time: float) -> FloatArray:
        """A M^-1/2 of the subset, dense by cluster use only, shape (rows, 3 atoms)."""
        return self.subset.jacobian(local, time).multiply(self._root_w[None, :]).toarray()

    def singular_values(self, x: FloatArray, time: float = 0.0) -> list[tuple[IntArray, FloatArray]]:
        """Per cluster: its rows and the singular values of the row-normalised mass-weighted matrix."""
        b = self._weighted(x[self.atoms], time)
        result = []
        for cluster in self._clusters:
            part = b[cluster.rows][:, cluster.columns]
            size = _row_norms(part)
            unit = np.divide(part, size[:, None], out=np.zeros_like(part), where=size[:, None] > 0)
            result.append((self.rows[cluster.rows], np.linalg.svd(unit, compute_uv=False)))
        return result


def _norm(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0


def _row_norms(matrix: FloatArray) -> FloatArray:
    return np.sqrt(np.einsum("ij,ij->i", matrix, matrix))


def _pseudo_solve(b: FloatArray, right: FloatArray) -> FloatArray:
    """Least-norm, least-squares solution by SVD with the rank cut."""
    u, s, vt = np.linalg.svd(b, full_matrices=False)
    keep = s > RANK_TOLERANCE * s[0]
    return vt[keep].T @ ((u[:, keep].T @ right) / s[keep])


class _Gram:
    """(B B^T)^+ through the SVD of B, factored once."""

    def __init__(self, b: FloatArray) -> None:
        u, s, _ = np.linalg.svd(b, full_matrices=True)
        rank = int(np.sum(s > RANK_TOLERANCE * s[0]))
        self._u, self._s2, self._null = u[:, :rank], s[:rank] ** 2, u[:, rank:]

    def solve(self, right: FloatArray) -> FloatArray:
        return self._u @ ((self._u.T @ right) / self._s2)

    def least_norm(self, mu: FloatArray, size: FloatArray) -> FloatArray:
        """Remove from natural multipliers what does not act: the null space of A^T in natural rows."""
        if self._null.shape[1] == 0:
            return mu
        q, _ = np.linalg.qr(self._null / size[:, None])
        return mu - q @ (q.T @ mu)
