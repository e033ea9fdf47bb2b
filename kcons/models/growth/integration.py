"""Trajectories of a constrained growth model, in the manner of SciPy's ``solve_ivp``.

Scheme. The unknown is y = ln x: dy/dt = phi + z + Psi exp(-y). x = exp(y) is positive whatever the step, for Psi = 0
and Psi > 0 alike; nothing is ever clipped. Any of SciPy's Runge-Kutta methods, or Radau or BDF, takes the steps; after
each the state is put back on the holonomic rows to round-off, by y + A^T mu with Newton's iteration, and the next step
starts from there. Values between the steps come from the method's own interpolant, projected in the same way.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp

from kcons.constraints.arguments import check_call, numbers
from kcons.errors import InputError, NonFiniteError
from kcons.models.growth.constrained import ACCEPTED, ConstrainedGrowth
from kcons.models.growth.model import FloatArray, Populations, starting_logarithms
from kcons.models.projected_steps import check_sizes, projecting, solver_of, span_of, times_of

Event = Callable[[float, FloatArray], float]


class GrowthInterpolant:
    """x at any time of a solution; on the constraints everywhere."""

    def __init__(
        self,
        system: ConstrainedGrowth,
        interpolant: Callable[[FloatArray], FloatArray] | None,
        settled_from: float,
        slow: Callable[[FloatArray], FloatArray] | None,
        forward: bool,
    ) -> None:
        self._system = system
        self._interpolant = interpolant
        self._settled_from = settled_from
        self._slow = slow
        self._forward = forward

    def logarithms(self, t: ArrayLike) -> FloatArray:
        """ln x, shape (n,) for one time, (n, k) for k."""
        times = np.asarray(t, dtype=np.float64)
        flat = np.atleast_1d(times)
        late = (flat > self._settled_from) if self._forward else (flat < self._settled_from)
        y = np.empty((self._system.n, len(flat)))
        if np.any(~late):
            assert self._interpolant is not None
            y[:, ~late] = _each(self._system, flat[~late], np.asarray(self._interpolant(flat[~late])))
        if np.any(late):
            assert self._slow is not None
            y[:, late] = self._slow(flat[late])
        return y[:, 0] if times.ndim == 0 else y

    def __call__(self, t: ArrayLike) -> FloatArray:
        """x, shape (n,) for one time, (n, k) for k."""
        with np.errstate(under="ignore"):
            return np.exp(self.logarithms(t))


@dataclass(frozen=True)
class GrowthSolution:
    """What `solve` returns; the names are those of SciPy's ``solve_ivp``.

    Attributes
    ----------
    t : ndarray, shape (k,)
    y : ndarray, shape (n, k)
        Populations x; 0 where they are below the smallest number of the machine.
    log_y : ndarray, shape (n, k)
        ln x, always finite.
    sol : GrowthInterpolant or None
    t_events, y_events : list of ndarray, or None
    nfev, njev, nlu : int
    status : int
        -1 the integration failed, 0 it reached the end, 1 an event ended it.
    message : str
    success : bool
    settled_time : float or None
        When nothing but the rows was left to decide about the motion (equilibrium, for a hypercycle that produces
        entropy); from there on the solution comes from the rows alone.
    system : ConstrainedGrowth
        The system with the targets that the start gave.
    """

    t: FloatArray
    y: FloatArray
    log_y: FloatArray
    sol: GrowthInterpolant | None
    t_events: list[FloatArray] | None
    y_events: list[FloatArray] | None
    nfev: int
    njev: int
    nlu: int
    status: int
    message: str
    success: bool
    settled_time: float | None
    system: ConstrainedGrowth = field(repr=False)

    @property
    def x(self) -> FloatArray:
        """Populations, shape (n, k); the same as `y`."""
        return self.y

    @property
    def log_x(self) -> FloatArray:
        """ln x, shape (n, k); the same as `log_y`."""
        return self.log_y

    def residuals(self) -> FloatArray:
        """sigma - sigma0 of the holonomic rows at all times, shape (m_h, k)."""
        states = [Populations.from_logarithms(float(t), y) for t, y in zip(self.t, self.log_y.T, strict=True)]
        return np.array([self.system.residuals(p) for p in states]).T


def solve(
    system: ConstrainedGrowth,
    t_span: Sequence[float],
    x0: ArrayLike | None = None,
    method: str = "DOP853",
    t_eval: ArrayLike | None = None,
    dense_output: bool = False,
    events: Event | Sequence[Event] | None = None,
    *,
    log_x0: ArrayLike | None = None,
    project: bool = True,
    **options: Any,
) -> GrowthSolution:
    """Integrate a constrained growth model; arguments as in SciPy's ``solve_ivp``.

    Parameters
    ----------
    system : ConstrainedGrowth
    t_span : pair of float
    x0 : array_like, shape (n,)
        Start, on the constraints.
    method : str
        'RK23', 'RK45', 'DOP853', 'Radau' or 'BDF'.
    t_eval, dense_output, events
        As in ``solve_ivp``; events are functions (t, x), with attributes `terminal` and `direction`.
    log_x0 : array_like, shape (n,), optional
        Start as logarithms, in place of x0.
    project : bool
        Whether the state is put back on the rows; False shows what that is good for.
    options
        rtol (by default 1e-9) and atol (1e-11) of ln x, so that atol is a relative error of x; max_step, first_step,
        jac and what else the method takes.

    Raises
    ------
    InputError
        Populations that are negative, zero or not finite; a method that is not known.
    ConstraintError, BudgetError
        A start off the constraints, or a prescription that cannot be met from it.
    ContradictionError, SingularGeometryError
        Rows that contradict each other, at the start or where their rank is lost on the way.
    NonFiniteError
        Rates, sources or rows that are not finite where the run has come to.
    """
    solver = solver_of(method)
    t0, t1 = span_of(t_span)
    log_start = starting_logarithms(x0, log_x0)
    if log_start.shape != (system.n,):
        raise InputError(f"the start has shape {log_start.shape}, not ({system.n},)", item="x0")
    p0 = Populations.from_logarithms(t0, log_start)
    bound = system.bind(p0)
    log_start = bound.project(t0, log_start) if project else log_start
    options = {"rtol": 1e-9, "atol": 1e-11} | {name: value for name, value in options.items() if value is not None}
    check_sizes(options, system.n)
    options |= {name: numbers(options[name], name) for name in ("rtol", "atol")}
    tolerance = max(float(np.min(options["rtol"] + options["atol"])), 1e-13)
    holder: dict[str, Any] = {}

    def slope(t: float, y: FloatArray) -> FloatArray:
        if y.ndim == 2:
            return np.stack([bound.logarithmic_velocity(Populations.from_logarithms(t, c)) for c in y.T], axis=-1)
        found = bound.logarithmic_velocity(Populations.from_logarithms(t, y))
        if not np.all(np.isfinite(found)) and np.all(np.isfinite(y)):
            # A trial step may go too far, and is then rejected; what is left is told if the run ends here.
            holder["not finite"] = t, y
        return found

    def placed(t: float, y: FloatArray) -> FloatArray:
        return bound.past_instants(t, bound.project(t, y))

    def settled(t: float, y: FloatArray) -> bool:
        slow = bound.settled(t, y, tolerance)
        if slow is not None:
            holder.update(slow=slow, time=t)
        return slow is not None

    stepper = projecting(solver, placed, settled) if project else solver
    slow = bound.settled(t0, log_start, tolerance) if project else None
    wanted = None if t_eval is None else times_of(t_eval, t0, t1)
    if slow is not None:
        holder.update(slow=slow, time=t0)
        ode: Any = None
    else:
        ode = solve_ivp(
            slope,
            (t0, t1),
            log_start,
            method=stepper,
            t_eval=None,
            dense_output=dense_output or wanted is not None,
            events=_event_list(events),
            **options,
        )
        if ode.status == 1:
            holder.clear()
        elif ode.status < 0 and "not finite" in holder:
            _refuse_rates(bound, *holder["not finite"])
        _check_end(bound, Populations.from_logarithms(float(ode.t[-1]), ode.y[:, -1]))
    return _assemble(bound, ode, holder, (t0, t1), wanted, dense_output, events, log_start, project)


def _check_end(system: ConstrainedGrowth, p: Populations) -> None:
    """Refuse derivatives that are wrong where a run has ended: what depends on time may do so later only."""
    with np.errstate(all="ignore"):
        for row in system.rows:
            row.check_derivatives(p)


def _refuse_rates(system: ConstrainedGrowth, t: float, y: FloatArray) -> None:
    """Raise if it is the model, or a row, that is not finite at a finite state."""
    p = Populations.from_logarithms(t, y)
    if not np.all(np.isfinite(p.x)):
        return
    bad = system.model.not_finite(p)
    if bad is not None:
        what, species = bad
        raise NonFiniteError(
            f"the {what} of species {species} is not finite at t = {t:.8g}, "
            f"x = {np.array2string(p.x, precision=4)}; end the run before (an event), or mend the function",
            item=f"{what}s",
        )
    system._held(p)


# -- the result --------------------------------------------------------------------------------------


def _assemble(
    system: ConstrainedGrowth,
    ode: Any,
    holder: dict[str, Any],
    span: tuple[float, float],
    wanted: FloatArray | None,
    dense_output: bool,
    events: Event | Sequence[Event] | None,
    log_start: FloatArray,
    project: bool,
) -> GrowthSolution:
    t0, t1 = span
    forward = t1 >= t0
    slow, settled_time = holder.get("slow"), holder.get("time")
    end = t1 if slow is not None or ode.status == 0 else float(ode.t[-1])
    interpolant = None if ode is None else ode.sol
    times = np.array([t0]) if ode is None else ode.t
    log_y = log_start[:, None] if ode is None else ode.y
    status = 0 if ode is None else ode.status
    message = "The solver successfully reached the end of the integration interval." if ode is None else ode.message
    turn = np.inf if forward else -np.inf
    inside = GrowthInterpolant(
        system if project else ConstrainedGrowth(system.model),
        interpolant if interpolant is not None else (lambda t: np.repeat(log_start[:, None], len(t), axis=1)),
        turn if slow is None else settled_time if settled_time is not None else t0,
        slow,
        forward,
    )
    event_list = _event_list(events)
    t_events = y_events = None
    if event_list is not None:
        t_events = [np.empty(0)] * len(event_list) if ode is None else list(ode.t_events)
        logs = [np.empty((0, system.n))] * len(event_list) if ode is None else list(ode.y_events)
        y_events = [
            np.exp(_each(system, t, y.T).T) if project and len(t) else np.exp(y)
            for t, y in zip(t_events, logs, strict=True)
        ]
    if slow is not None:
        assert settled_time is not None
        tail = _tail(settled_time, t1)
        if event_list is not None:
            assert t_events is not None and y_events is not None
            grid = np.append(settled_time, tail)
            end, status, message = _late_events(event_list, inside, grid, t_events, y_events, end, message)
            tail = tail[tail <= end] if forward else tail[tail >= end]
            tail = np.append(tail, end) if len(tail) == 0 or tail[-1] != end else tail
        times = np.append(times, tail)
        log_y = np.concatenate([log_y, slow(tail)], axis=1)
    if wanted is not None:
        times = wanted[wanted <= end] if forward else wanted[wanted >= end]
        log_y = inside.logarithms(times) if len(times) else np.empty((system.n, 0))
    with np.errstate(under="ignore"):
        y = np.exp(log_y)
    return GrowthSolution(
        t=times,
        y=y,
        log_y=log_y,
        sol=inside if dense_output else None,
        t_events=t_events,
        y_events=y_events,
        nfev=0 if ode is None else ode.nfev,
        njev=0 if ode is None else ode.njev,
        nlu=0 if ode is None else ode.nlu,
        status=status,
        message=message,
        success=status >= 0,
        settled_time=settled_time if slow is not None else None,
        system=system,
    )


def _tail(start: float, end: float) -> FloatArray:
    """Times shown of a settled motion."""
    return np.linspace(start, end, 101)[1:] if start != end else np.empty(0)


def _late_events(
    events: Sequence[Event],
    solution: GrowthInterpolant,
    grid: FloatArray,
    t_events: list[FloatArray],
    y_events: list[FloatArray],
    end: float,
    message: str,
) -> tuple[float, int, str]:
    """Zeros of the events on the settled part, sought between the times of a grid; new end, status and message."""
    from scipy.optimize import brentq

    status = 0
    found: list[tuple[float, int]] = []
    for number, event in enumerate(events):

        def at(t: float, event: Event = event) -> float:
            return float(event(t, np.asarray(solution.logarithms(t))))

        values = [at(float(t)) for t in grid]
        direction = getattr(event, "direction", 0)
        for a, b, u, v in zip(grid, grid[1:], values, values[1:], strict=False):
            # A zero at a time of the grid belongs to the interval before it.
            if (u < 0 <= v or u > 0 >= v) and direction * (v - u) >= 0:
                found.append((float(brentq(at, a, b, xtol=1e-12)), number))
    forward = grid[-1] >= grid[0]
    for t, number in sorted(found, reverse=not forward):
        t_events[number] = np.append(t_events[number], t)
        y_events[number] = np.vstack([y_events[number].reshape(-1, solution._system.n), solution(t)])
        most = getattr(events[number], "terminal", False)
        if most and len(t_events[number]) >= most:
            return t, 1, "A termination event occurred."
    return end, status, message


def _each(system: ConstrainedGrowth, times: FloatArray, log_y: FloatArray) -> FloatArray:
    """Project states at several times, shape (n, k)."""
    if not any(row.holonomic for row in system.rows):
        return log_y
    projected, left = system.try_project(times, log_y)
    for k in np.flatnonzero(~(left <= ACCEPTED)):
        projected[:, k] = system.project(float(times[k]), log_y[:, k])
    return projected


# -- input -------------------------------------------------------------------------------------------


def _event_list(events: Event | Sequence[Event] | None) -> list[Event] | None:
    """The events as functions of ln x, their attributes kept."""
    if events is None:
        return None
    wrapped: list[Event] = []
    for event in list(events) if isinstance(events, Iterable) else [events]:
        check_call("event", event, ("t", "x"))

        def of_logarithms(t: float, y: FloatArray, event: Event = event) -> float:
            with np.errstate(under="ignore"):
                value = numbers(event(t, np.exp(y)), "event")
            if value.size != 1:
                raise InputError(f"an event returned shape {value.shape}; it must return a number", item="event")
            return float(value.item())

        for name in ("terminal", "direction"):
            if hasattr(event, name):
                setattr(of_logarithms, name, getattr(event, name))
        wrapped.append(of_logarithms)
    return wrapped
