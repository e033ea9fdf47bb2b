"""SciPy's integrators with a projection after each step, and what they are given."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import BDF, DOP853, RK23, RK45, OdeSolver, Radau

from kcons.constraints.arguments import FloatArray, numbers
from kcons.errors import InputError, UnsupportedError

METHODS: dict[str, type[OdeSolver]] = {"RK23": RK23, "RK45": RK45, "DOP853": DOP853, "Radau": Radau, "BDF": BDF}
#: What SciPy takes where less is asked for.
LEAST_RTOL = 100 * float(np.finfo(float).eps)


def projecting(
    solver: type[OdeSolver],
    project: Callable[[float, FloatArray], FloatArray],
    settled: Callable[[float, FloatArray], bool] = lambda t, y: False,
) -> type[OdeSolver]:
    """The solver, with a projection after each step; ended early once the motion has settled.

    Parameters
    ----------
    solver : type
        One of `METHODS`.
    project : callable (t, y) -> y
        Puts the end of a step where the next one starts.
    settled : callable (t, y) -> bool, optional
    """

    class Projecting(solver):  # type: ignore[misc, valid-type]
        t: float
        y: FloatArray
        status: str

        def step(self) -> str | None:
            message: str | None = super().step()
            if self.status == "failed":
                return message
            y = project(self.t, self.y)
            if isinstance(self, BDF):
                self.D[0] += y - self.y
            else:
                self.f = self.fun(self.t, y)
            self.y = y
            if self.status == "running" and settled(self.t, y):
                self.status = "finished"
            return message

    Projecting.__name__ = solver.__name__
    return Projecting


def solver_of(method: str) -> type[OdeSolver]:
    """The integrator of this name.

    Raises
    ------
    InputError
        An unknown name.
    UnsupportedError
        LSODA.
    """
    if method == "LSODA":
        raise UnsupportedError(
            "LSODA keeps its own copy of the state, which cannot be put back on the constraints; "
            "use 'Radau' or 'BDF' for stiff systems"
        )
    if not isinstance(method, str) or method not in METHODS:
        raise InputError(f"there is no method {method!r}; choose from {', '.join(METHODS)}", item="method")
    return METHODS[method]


def span_of(t_span: Sequence[float]) -> tuple[float, float]:
    """Start and end.

    Raises
    ------
    InputError
        If it is no pair of finite numbers.
    """
    try:
        t0, t1 = (float(t) for t in t_span)
    except (TypeError, ValueError):
        raise InputError(f"t_span is a pair of times, not {t_span!r}", item="t_span") from None
    if not (np.isfinite(t0) and np.isfinite(t1)):
        raise InputError("t_span is not finite", item="t_span")
    return t0, t1


def check_sizes(options: Mapping[str, Any], n: int) -> None:
    """Refuse tolerances and sizes of steps with which SciPy goes on for ever, or otherwise than was asked for.

    Raises
    ------
    InputError
        rtol below rounding; atol that is negative or not for `n` numbers; steps that are not positive; NaN.
    """
    for name, least in (("rtol", LEAST_RTOL), ("atol", 0.0), ("max_step", 0.0), ("first_step", 0.0)):
        if options.get(name) is None:
            continue
        given = numbers(options[name], name)
        shapes = [(), (n,)] if name.endswith("tol") else [()]
        if given.shape not in shapes or not np.all(given >= least) or ("step" in name and not given > 0):
            raise InputError(
                f"{name} is {options[name]!r:.60}; give a "
                + ("positive number" if "step" in name else f"number of {least:g} or more, or {n} of them"),
                item=name,
            )


def times_of(t_eval: ArrayLike, t0: float, t1: float) -> FloatArray:
    """Times at which a solution is wanted, shape (k,).

    Raises
    ------
    InputError
        If they are not sorted from the start to the end, or outside.
    """
    times = numbers(t_eval, "t_eval")
    low, high = min(t0, t1), max(t0, t1)
    if times.ndim != 1 or not np.all((times >= low) & (times <= high)):
        raise InputError("t_eval is one-dimensional and within t_span", item="t_eval")
    steps = np.diff(times)
    if np.any(steps <= 0 if t1 >= t0 else steps >= 0):
        raise InputError("t_eval is not sorted from the start to the end of t_span", item="t_eval")
    return times
