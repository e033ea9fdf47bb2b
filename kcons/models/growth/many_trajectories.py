"""Many trajectories of one model at once, each with time steps of its own.

The same scheme as `growth.integration`: logarithms, the Runge-Kutta method of order 8 of Dormand and Prince, a
projection on the holonomic rows after each step. All trajectories of a batch take a step together, as columns of
arrays; each accepts or rejects it for itself, and those that have arrived leave the batch.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import DOP853

from kcons.constraints.arguments import finite_number, numbers, whole_number
from kcons.errors import InputError
from kcons.models.growth.compensated_sums import two_sum
from kcons.models.growth.constrained import ACCEPTED, ConstrainedGrowth, check_lanes
from kcons.models.growth.model import FloatArray, Populations, starting_logarithms
from kcons.models.projected_steps import check_sizes

#: Trajectories that take their steps together.
BATCH = 2048
#: Steps of a trajectory at most.
MOST_STEPS = 50_000
EXPONENT = -1.0 / 8.0
LEAST_STEP = 1e-305
#: Whether a motion has settled is looked at each time so many steps were taken.
SETTLING = 4


@dataclass(frozen=True)
class EnsembleSolution:
    """Trajectories side by side.

    Attributes
    ----------
    t : ndarray, shape (k,) or (k, N)
    log_x : ndarray, shape (k, n, N)
        ln x; NaN after a trajectory failed.
    steps : ndarray of int, shape (N,)
        Steps tried.
    failed : ndarray of bool, shape (N,)
        Trajectories whose step size went to zero, or that took too many steps.
    settled_time : ndarray, shape (N,)
        When nothing but the rows was left to decide about the motion, infinite if that was not before the end.
    """

    t: FloatArray
    log_x: FloatArray = field(repr=False)
    steps: NDArray[np.int64] = field(repr=False)
    failed: NDArray[np.bool_] = field(repr=False)
    settled_time: FloatArray = field(repr=False)

    @property
    def x(self) -> FloatArray:
        """Populations, shape (k, n, N)."""
        with np.errstate(under="ignore"):
            return np.exp(self.log_x)


def solve_ensemble(
    system: ConstrainedGrowth,
    t_eval: ArrayLike,
    x0: ArrayLike | None = None,
    *,
    log_x0: ArrayLike | None = None,
    t0: float = 0.0,
    rtol: float = 1e-7,
    atol: float = 1e-9,
    batch: int = BATCH,
    threads: int = 1,
) -> EnsembleSolution:
    """Integrate N starts of a system.

    Parameters
    ----------
    system : ConstrainedGrowth
        Functions of a model of your own must be vectorized. A `Hypercycle` may have parameters of its own for each
        trajectory.
    t_eval : array_like, shape (k,) or (k, N)
        Times wanted, increasing, none before t0; perhaps others for each trajectory.
    x0, log_x0 : array_like, shape (n, N)
        Starts, on the constraints, as populations or as their logarithms.
    t0 : float
    rtol, atol : float
        Of ln x: atol is a relative error of x.
    batch, threads : int
        How many trajectories step together, and how many batches at the same time. Neither changes results but in
        round-off.

    Raises
    ------
    InputError
        Starts that are negative, zero or not finite; times that do not increase.
    ConstraintError, BudgetError, ContradictionError, SingularGeometryError
        As `solve`, if any start cannot be held.
    """
    t0, batch, threads = finite_number(t0, "t0"), whole_number(batch, "batch"), whole_number(threads, "threads")
    check_sizes({"rtol": rtol, "atol": atol}, 1)
    times = np.atleast_1d(numbers(t_eval, "t_eval"))
    if not times.size or not np.all(np.isfinite(times)) or np.any(np.diff(times, axis=0) <= 0) or np.any(times[0] < t0):
        raise InputError("t_eval holds finite times that increase, none before t0", item="t_eval")
    start = starting_logarithms(x0, log_x0)
    if start.ndim != 2 or len(start) != system.n:
        raise InputError(f"the starts have shape ({system.n}, N), not {start.shape}", item="x0")
    if system.model.vectorized is False:
        raise InputError(
            "an ensemble needs functions that are vectorized: GrowthModel(..., vectorized=True)", item="model"
        )
    n, N = start.shape
    check_lanes(system, (N,))
    if times.ndim > 2 or (times.ndim == 2 and times.shape[1] != N):
        raise InputError(f"t_eval has shape (k,) or (k, {N}), not {times.shape}", item="t_eval")
    every = np.broadcast_to(times if times.ndim == 2 else times[:, None], (len(times), N))
    log_x = np.full((len(times), n, N), np.nan)
    steps = np.zeros(N, dtype=np.int64)
    failed = np.zeros(N, dtype=bool)
    settled = np.full(N, np.inf)
    chunks = [np.arange(a, min(a + batch, N)) for a in range(0, N, batch)]

    def work(lanes: NDArray[np.intp]) -> None:
        part = system.take(lanes).bind(Populations.from_logarithms(np.full(len(lanes), t0), start[:, lanes]))
        run = _Batch(part, start[:, lanes], t0, every[:, lanes], rtol, atol)
        run.go()
        log_x[:, :, lanes], steps[lanes], failed[lanes] = run.log_x, run.steps, run.failed
        settled[lanes] = run.settled_time

    if threads == 1:
        for lanes in chunks:
            work(lanes)
    else:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(work, chunks))
    return EnsembleSolution(times, log_x, steps, failed, settled)


class _Batch:
    """Trajectories that step together."""

    def __init__(
        self, system: ConstrainedGrowth, start: FloatArray, t0: float, times: FloatArray, rtol: float, atol: float
    ) -> None:
        n, N = start.shape
        self.times, self.rtol, self.atol = times, rtol, atol
        self.log_x = np.full((len(times), n, N), np.nan)
        self.steps = np.zeros(N, dtype=np.int64)
        self.failed = np.zeros(N, dtype=bool)
        self.settled_time = np.full(N, np.inf)
        # Of those still on their way:
        self.system = system
        self.lanes: NDArray[np.intp] = np.arange(N)
        # The time is the sum of two numbers: a species that returns from ln x = -1e8 does so within less than what the
        # last digit of t can show.
        self.t = np.full(N, t0)
        self.t_rest = np.zeros(N)
        self.y, _ = system.try_project(self.t, start)
        self.f = self._slope(self.t, self.y)
        self.next = np.zeros(N, dtype=np.intp)
        self._show(np.ones(N, dtype=bool))
        with np.errstate(divide="ignore"):
            speed = np.max(np.abs(self.f) / (atol + rtol * np.abs(self.y)), axis=0)
            place = np.max(np.maximum(np.abs(self.y), 1.0) / (atol + rtol * np.abs(self.y)), axis=0)
            self.h = np.minimum(0.01 * place / np.maximum(speed, 1e-300), np.maximum(times[-1] - t0, 1e-300))
        self.was_rejected = np.zeros(N, dtype=bool)
        self.rounds = 0

    def _slope(self, t: FloatArray, y: FloatArray) -> FloatArray:
        return self.system.logarithmic_velocity(Populations.from_logarithms(t, y))

    def _show(self, moved: NDArray[np.bool_]) -> None:
        """Write down those that have just come to a time wanted."""
        for _ in range(2):  # t0 may be the first of them
            open_ = np.flatnonzero(moved & (self.next < len(self.times)))
            here = open_[self.t[open_] == self.times[self.next[open_], self.lanes[open_]]]
            here = here[self.t_rest[here] == 0.0]
            self.log_x[self.next[here], :, self.lanes[here]] = self.y[:, here].T
            self.next[here] += 1

    def go(self) -> None:
        while True:
            done = self.next >= len(self.times)
            if np.any(done):
                self._keep(~done)
            if len(self.lanes) == 0:
                return
            self._step()

    def _keep(self, stay: NDArray[np.bool_]) -> None:
        index = np.flatnonzero(stay)
        self.system = self.system.take(index)
        self.lanes, self.t, self.h, self.next = self.lanes[index], self.t[index], self.h[index], self.next[index]
        self.t_rest = self.t_rest[index]
        self.y, self.f, self.was_rejected = self.y[:, index], self.f[:, index], self.was_rejected[index]

    def _step(self) -> None:
        goal = self.times[self.next, self.lanes]
        ahead = (goal - self.t) - self.t_rest
        h = np.minimum(self.h, ahead)
        # Not so short a last step that it could hardly be taken.
        clipped = h >= ahead * (1 - 1e-12)
        with np.errstate(all="ignore"):
            K = np.empty((DOP853.n_stages, *self.y.shape))
            K[0] = self.f
            for s in range(1, DOP853.n_stages):
                change = np.tensordot(DOP853.A[s, :s], K[:s], axes=1)
                K[s] = self._slope(self.t + DOP853.C[s] * h, self.y + h * change)
            y_new = self.y + h * np.tensordot(DOP853.B, K, axes=1)
            scale = self.atol + self.rtol * np.maximum(np.abs(self.y), np.abs(y_new))
            # The last entries of E5 and E3, of the slope at the end, are zero.
            fifth = np.sum((h * np.tensordot(DOP853.E5[:-1], K, axes=1) / scale) ** 2, axis=0)
            third = np.sum((h * np.tensordot(DOP853.E3[:-1], K, axes=1) / scale) ** 2, axis=0)
            error = np.where(fifth == 0, 0.0, fifth / np.sqrt((fifth + 0.01 * third) * len(self.y)))
            good = error < 1.0
            t_new, rest_new = two_sum(self.t, self.t_rest + h)
            t_new, rest_new = np.where(clipped, goal, t_new), np.where(clipped, 0.0, rest_new)
            y_new = np.where(good, y_new, self.y)
            y_new, left = self.system.try_project(np.where(good, t_new, self.t), y_new)
            good &= (left <= ACCEPTED) & np.all(np.isfinite(y_new), axis=0)
            factor = np.where(error == 0, 10.0, 0.9 * error**EXPONENT)
        grown = np.clip(factor, 0.2, np.where(self.was_rejected, 1.0, 10.0))
        shrunk = np.clip(np.where(np.isfinite(factor), factor, 0.2), 0.2, 0.5)
        # A step cut short by an output time says nothing against the longer one.
        self.h = np.where(good, np.where(clipped & (grown * h < self.h), self.h, grown * h), shrunk * h)
        self.was_rejected = ~good
        self.steps[self.lanes] += 1
        self.t, self.t_rest = np.where(good, t_new, self.t), np.where(good, rest_new, self.t_rest)
        self.y = np.where(good, y_new, self.y)
        self.y = self.system.past_instants(self.t, self.y)
        self.f = np.where(good, self._slope(self.t, self.y), self.f)
        self._show(good)
        self.rounds += 1
        if self.rounds % SETTLING == 0:
            self._settle(good)
        stuck = (self.h < LEAST_STEP) | (self.steps[self.lanes] >= MOST_STEPS)
        stuck &= self.next < len(self.times)
        if np.any(stuck):
            self.failed[self.lanes[stuck]] = True
            self.next[stuck] = len(self.times)

    def _settle(self, moved: NDArray[np.bool_]) -> None:
        """Finish those of which nothing is left to integrate."""
        here = moved & (self.next < len(self.times))
        arrived = here & self.system.arrived_lanes(self.t, self.y)
        if np.any(arrived):
            self._finish(np.flatnonzero(arrived), at_rest=True)
        settled = here & ~arrived & self.system.settled_lanes(self.t, self.y, self.rtol + self.atol)
        if np.any(settled):
            self._finish(np.flatnonzero(settled), at_rest=False)

    def _finish(self, index: NDArray[np.intp], *, at_rest: bool) -> None:
        part = self.system.take(index)
        for k, times in enumerate(self.times):
            late = np.flatnonzero(self.next[index] <= k)
            if len(late):
                which = index[late]
                lanes, system = self.lanes[which], part.take(late)
                wanted = times[lanes]
                found = (
                    system.rest_state(self.t[which], self.y[:, which], wanted) if at_rest else system.slow_state(wanted)
                )
                self.log_x[k, :, lanes] = found.T
        self.settled_time[self.lanes[index]] = self.t[index]
        self.next[index] = len(self.times)
