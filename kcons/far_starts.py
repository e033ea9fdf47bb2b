"""Positions that are far off the constraints: the way onto them, for starts and not for time steps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from kcons import diagnosis
from kcons.constraint_set import ConstraintSet
from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, InputError, SingularGeometryError
from kcons.plan import Plan

#: Largest cluster, in rows, that dense damped Newton rescues.
RESCUE_ROWS = 400
#: Rounds of the search for the nearest point on the constraints.
NEAREST_ROUNDS = 200
#: Halvings of one step of it.
MAX_HALVINGS = 30


class FarStart:
    """Search for a point on the constraints, with the projections of a `Motion` as its tools.

    Parameters
    ----------
    local : ConstraintSet
    plan : Plan
    numbers : ndarray of int or None
        Global numbers of the local atoms, for messages.
    positions, tangents : callable
        The position and velocity projections of the plan, in place on local arrays.
    """

    def __init__(
        self,
        local: ConstraintSet,
        plan: Plan,
        numbers: IntArray | None,
        positions: Callable[..., Any],
        tangents: Callable[..., Any],
    ) -> None:
        self._local, self._plan, self._numbers = local, plan, numbers
        self._positions, self._tangents = positions, tangents

    def _nearest(self, x: FloatArray, time: float) -> bool:
        """x <- x0 + M^-1 A(x)^T Lambda by fixed-point iteration with the fast solvers.

        Its fixed point is the foot of the mass-weighted perpendicular from x0. Where the iteration does not
        settle, its first point is kept, which lies on the surface along the gradients at x0. False if there
        is not even that.
        """
        first = x.copy()
        try:
            self._positions(first, x, time, time, None, 0.0, None)
        except ConvergenceError:
            return False
        here, last = first, np.inf
        for _ in range(NEAREST_ROUNDS):
            ahead = x.copy()
            try:
                self._positions(ahead, here, time, time, None, 0.0, None)
            except ConvergenceError:
                here = first
                break
            move = float(np.max(np.abs(ahead - here), initial=0.0))
            here = ahead
            if move == 0.0 or (move > 0.5 * last and move < 1e-12):
                break
            if move > 2 * last:
                here = first
                break
            last = move
        np.copyto(x, here)
        return True

    def restore(self, x: FloatArray, time: float) -> None:
        """Bring `x` onto the constraints in place, or raise `InfeasibleError`."""
        if self._nearest(x, time):
            return
        start = x.copy()
        error = diagnosis.not_finite(self._local, self._numbers, {"positions": start})
        if error is not None:
            raise error
        if not self._gauss_newton(x, time):
            np.copyto(x, start)
            general = self._plan.general_for_all(RESCUE_ROWS)
            outcome = general.restore(x, time=time)
            if not outcome.converged:
                raise diagnosis.restore_failed(self._local, self._numbers, x, start, outcome, general, time)
        foot = start.copy()
        try:
            self._positions(foot, x, time, time, None, 0.0, None)
        except ConvergenceError:
            return
        np.copyto(x, foot)

    def _gauss_newton(self, x: FloatArray, time: float) -> bool:
        """x <- x - f M^-1 A^T (A M^-1 A^T)^+ sigma in place, f halved cluster by cluster while |sigma| grows."""
        local, plan = self._local, self._plan
        member = plan.labels >= 0
        labels = plan.labels[member]
        atom_label = np.full(local.n_atoms, -1, dtype=np.int64)
        entry_label = np.repeat(plan.labels, np.diff(local.incidence.indptr))
        atom_label[local.incidence.indices[entry_label >= 0]] = entry_label[entry_label >= 0]
        weight = 1.0 / local.scale[member] ** 2

        def misfit(sigma: FloatArray) -> FloatArray:
            return np.bincount(labels, weights=weight * sigma[member] ** 2).astype(np.float64)

        with np.errstate(all="ignore"):
            sigma = local.value(x, time)
            error = misfit(sigma)
            for _ in range(NEAREST_ROUNDS):
                if np.all(np.abs(sigma[member]) <= local.tolerance(x, time)[member]):
                    return True
                step = np.zeros_like(x)
                try:
                    self._tangents(x, step, np.where(member, -sigma, 0.0), time, None, "position")
                except (ConvergenceError, SingularGeometryError, InputError):
                    return False
                factor = np.ones(len(error))
                for _ in range(MAX_HALVINGS):
                    trial = x + np.where(atom_label >= 0, factor[atom_label], 0.0)[:, None] * step
                    trial_sigma = local.value(trial, time)
                    trial_error = misfit(trial_sigma)
                    worse = ~(trial_error < error) & (error > 1e-26)
                    if not worse.any():
                        break
                    factor[worse] *= 0.5
                else:
                    return False
                np.copyto(x, trial)
                sigma, error = trial_sigma, trial_error
        return False
