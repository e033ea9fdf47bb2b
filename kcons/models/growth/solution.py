"""Trajectories of a constrained growth model, in the manner of SciPy's ``solve_ivp``.

The unknown is y = ln x: dy/dt = phi + z + Psi exp(-y). x = exp(y) is positive whatever the step, for Psi = 0 and
Psi > 0 alike; nothing is ever clipped. Any of SciPy's Runge-Kutta methods, or Radau or BDF, takes the steps; after
each the state is put back on the holonomic rows to round-off, by y + A^T mu with Newton's iteration, and the next step
starts from there. Values between the steps come from the method's own interpolant, projected in the same way.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp
from scipy.optimize import OptimizeResult

from kcons.constraints.arguments import FloatArray, check_call, numbers
from kcons.errors import InputError, NonFiniteError
from kcons.models.growth.constrained import ConstrainedGrowth
from kcons.models.growth.entropy import EntropyRow
from kcons.models.growth.model import Populations
from kcons.models.integration import check_run, projecting

Event = Callable[[float, FloatArray], float]


class GrowthInterpolant:
    """x at any time of a solution; on the constraints everywhere."""

    def __init__(self, logarithms: Callable[[ArrayLike], FloatArray]) -> None:
        #: ln x, shape (n,) for one time, (n, k) for k.
        self.logarithms = logarithms

    def __call__(self, t: ArrayLike) -> FloatArray:
        """x, shape (n,) for one time, (n, k) for k."""
        with np.errstate(under="ignore"):
            return np.exp(self.logarithms(t))


class GrowthSolution(OptimizeResult):
    """What `solve` returns: all that SciPy's ``solve_ivp`` returns, and more.

    Attributes
    ----------
    y, log_y : ndarray, shape (n, k)
        Populations x, 0 where they are below the smallest number of the machine, and ln x, always finite.
    sol : GrowthInterpolant or None
    settled_time : float or None
        When nothing but the rows was left to decide about the motion (equilibrium, for a hypercycle that produces
        entropy); from there on the solution comes from the rows alone.
    system : ConstrainedGrowth
        The system with the targets that the start gave.
    """

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
    ConstraintError, BudgetError
        A start off the constraints, or a prescription that cannot be met from it.
    ContradictionError, SingularGeometryError
        Rows that contradict each other, at the start or where their rank is lost on the way.
    NonFiniteError
        Rates, sources or rows that are not finite where the run has come to.
    """
    options = {"rtol": 1e-9, "atol": 1e-11} | {name: value for name, value in options.items() if value is not None}
    solver, span, times = check_run(t_span, t_eval, method, options, system.n)
    options |= {name: numbers(options[name], name) for name in ("rtol", "atol")}
    tolerance = max(float(np.min(options["rtol"] + options["atol"])), 1e-13)
    p0 = Populations.start(span[0], system.n, x0, log_x0)
    bound = system.bind(p0)
    start, seen = p0.log_x, {"end": p0}

    def slope(t: float, y: FloatArray) -> FloatArray:
        p = Populations.from_logarithms(t, y)
        found = bound.logarithmic_velocity(p)
        if not np.all(np.isfinite(found)) and np.all(np.isfinite(y)):
            seen["not finite"] = p  # a trial step may go too far, and is then rejected; told if the run ends here
        return found

    def placed(t: float, y: FloatArray) -> FloatArray:
        p = Populations.from_logarithms(t, bound.past_instant(t, bound.project(t, y)))
        if abs(t - span[0]) >= abs(seen["end"].time - span[0]):
            seen["end"] = p
        return p.log_x

    def settled(t: float, y: FloatArray) -> Callable[[float], FloatArray] | None:
        motion = bound.settled(t, y, tolerance)
        if motion is not None:
            seen["settled"] = Populations.from_logarithms(t, y)
        return motion

    if project:
        start, solver = placed(span[0], start), projecting(solver, placed, settled)
    with np.errstate(all="ignore"):  # ln x may be -1e300, and trial steps go too far
        found = solve_ivp(slope, span, start, solver, times, dense_output, _of_logarithms(events), **options)
        if found.status < 0 and "not finite" in seen:
            _refuse_rates(bound, seen["not finite"])
        for row in bound.rows:  # derivatives of what depends on time may be wrong later only
            row.check_derivatives(seen["end"])
        log_y = np.reshape(found.y, (system.n, -1))  # a list where the run ended before the first time wanted
        more = {
            "t": np.asarray(found.t),
            "y": np.exp(log_y),
            "log_y": log_y,
            "sol": None if found.sol is None else GrowthInterpolant(found.sol),
            "y_events": None if found.y_events is None else [np.exp(y) for y in found.y_events],
            "settled_time": seen["settled"].time if "settled" in seen else None,
            "system": bound,
        }
    return GrowthSolution(dict(found) | more)


def _refuse_rates(system: ConstrainedGrowth, p: Populations) -> None:
    """Raise if it is the model, or a row, that is not finite at a finite state."""
    if not np.all(np.isfinite(p.x)):
        return
    bad = system.model.not_finite(p)
    if bad is not None:
        raise NonFiniteError(
            f"the {bad[0]} of species {bad[1]} is not finite at t = {p.time:.8g}, "
            f"x = {np.array2string(p.x, precision=4)}; end the run before (an event), or mend the function",
            item=f"{bad[0]}s",
        )
    system.held(p)


def _of_logarithms(events: Event | Sequence[Event] | None) -> list[Event] | None:
    """The events as functions of ln x, their attributes kept."""
    if events is None:
        return None
    wrapped: list[Event] = []
    for event in list(events) if isinstance(events, Iterable) else [events]:
        check_call("event", event, ("t", "x"))

        def of_logarithms(t: float, y: FloatArray, event: Event = event) -> float:
            value = numbers(event(t, np.exp(y)), "event")
            if value.size != 1:
                raise InputError(f"an event returned shape {value.shape}; it must return a number", item="event")
            return float(value.item())

        for name in ("terminal", "direction"):
            if hasattr(event, name):
                setattr(of_logarithms, name, getattr(event, name))
        wrapped.append(of_logarithms)
    return wrapped


class EntropyBalance(NamedTuple):
    """Three ways to the entropy, times T, that a solution has produced, and where it went (notes eq. 145).

    `reactions` and `exchanged` are the parts of `integrated`: of what the model does by itself, Psi + G phi, and what
    the constraints add to it, G z. In an open system (eq. 150) these are the entropy produced inside and the one
    exchanged with the outside; in a closed one (eq. 149) nothing is exchanged, and their sum is produced inside.
    """

    #: g(x_0) - g(x(t)), from the two ends alone.
    lost: float
    #: The integral of -sum mu dx/dt along the solution.
    integrated: float
    #: What the law says.
    prescribed: float
    reactions: float
    exchanged: float


def entropy_balance(solution: GrowthSolution, nodes: int = 8) -> EntropyBalance:
    """Whether the entropy produced is the integral of its prescribed rate.

    Parameters
    ----------
    solution : GrowthSolution
        Of a system with an `EntropyRow`, with dense_output=True.
    nodes : int
        Gauss points between two times of the solution.
    """
    system = solution.system
    row = next((r for r in system.rows if isinstance(r, EntropyRow)), None)
    if row is None:
        raise InputError("the system of this solution has no row of entropy production", item="solution")
    if solution.sol is None:
        raise InputError(
            "the integral needs the solution between its times: solve(..., dense_output=True)", item="solution"
        )
    points, weights = np.polynomial.legendre.leggauss(nodes)
    integrated = reactions = 0.0
    for a, b in pairwise(solution.t):
        times = 0.5 * (a + b) + 0.5 * (b - a) * points
        for t, weight, log_x in zip(times, weights, solution.sol.logarithms(times).T, strict=True):
            p = Populations.from_logarithms(float(t), log_x)
            fall = -0.5 * (b - a) * weight * row.mixture.potentials(p)
            integrated += float(np.sum(fall * p.x * system.logarithmic_velocity(p)))
            reactions += float(np.sum(fall * system.model.drift(p)))
    ends = [Populations.from_logarithms(float(solution.t[k]), solution.log_y[:, k]) for k in (0, -1)]
    lost = float(row.mixture.excess(ends[0], row.total) - row.mixture.excess(ends[1], row.total))
    prescribed = row.excess0 - row.law_excess(float(solution.t[-1]))
    return EntropyBalance(lost, integrated, prescribed, reactions, integrated - reactions)
