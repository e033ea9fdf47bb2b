"""Mechanics as flows: from a Lagrangian to Hamilton's equations (notes section 2).

Lagrangians are functions L(q, v, t) of arrays q, v of shape (f,) and a number t; Hamiltonians H(q, p) or H(q, p, t).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import root

from kcons.constraints.arguments import FloatArray, as_float_array, check_call, read_only_view, whole_number
from kcons.errors import ConvergenceError, InputError
from kcons.models.flows.flow import Flow
from kcons.models.integration import STEP, called, check_derivative, jacobian_by_differences

Lagrangian = Callable[[FloatArray, FloatArray, float], float]


class HamiltonianFlow(Flow):
    """The flow of H(q, p) or H(q, p, t) on X = (q, p): dq/dt = dH/dp, dp/dt = -dH/dq (notes eqs. 49-55).

    Parameters
    ----------
    hamiltonian : callable (q, p) -> float
        H, arrays of shape (f,).
    f : int
        Degrees of freedom.
    dH_dq, dH_dp : callable (q, p) -> (f,), optional
        Gradients; by differences where they are not given.
    time_dependent : bool
        Whether H and its gradients take the time as a third argument, (q, p, t). The energy then changes, by
        dH/dt = the derivative of H with respect to its third argument (notes eq. 51).
    """

    def __init__(
        self,
        hamiltonian: Callable[..., float],
        f: int,
        dH_dq: Callable[..., ArrayLike] | None = None,
        dH_dp: Callable[..., ArrayLike] | None = None,
        *,
        time_dependent: bool = False,
    ) -> None:
        self.f = whole_number(f, "f")
        self._given = {"dH_dq": dH_dq, "dH_dp": dH_dp}
        taken = ("q", "p", "t") if time_dependent else ("q", "p")
        for name, function in (("hamiltonian", hamiltonian), *self._given.items()):
            check_call(name, function, taken, "; time_dependent says whether it gets the time")
        self.hamiltonian, self.time_dependent = hamiltonian, time_dependent
        super().__init__(self._field, 2 * self.f)

    def _of(self, function: Callable[..., Any], X: FloatArray, t: float) -> Any:
        """A function of the user at X."""
        X = read_only_view(X)
        return function(X[: self.f], X[self.f :], *((t,) if self.time_dependent else ()))

    def energy(self, X: ArrayLike, t: float = 0.0) -> float:
        """H(q, p), or H(q, p, t)."""
        return float(self._of(self.hamiltonian, self._state(X), t))

    def _gradient(self, t: float, X: FloatArray) -> FloatArray:
        """(dH/dq, dH/dp), shape (2f,)."""
        found = {
            name: called(name, lambda X, g=function: self._of(g, X, t), (self.f,), X)
            for name, function in self._given.items()
            if function is not None
        }
        if len(found) < 2:
            found = dict(zip(self._given, np.split(self._differences_of_energy(t, X, STEP), 2), strict=True)) | found
        return np.concatenate([found[name] for name in self._given])

    def _differences_of_energy(self, t: float, X: FloatArray, step: float) -> FloatArray:
        return jacobian_by_differences(lambda s, Y: self._of(self.hamiltonian, Y, s), t, X, step)

    def _field(self, t: float, X: FloatArray) -> FloatArray:
        slope = self._gradient(t, X)
        return np.concatenate([slope[self.f :], -slope[: self.f]])

    def solve(self, t_span: Sequence[float], X0: ArrayLike, method: str = "DOP853", **options: Any) -> Any:
        """As `Flow.solve`; gradients are compared with differences of H at the start."""
        X, t = self._state(X0), float(t_span[0])
        slope, rounding = self._gradient(t, X), 1e-10 * abs(self.energy(X, t))
        differences = (self._differences_of_energy(t, X, step) for step in (STEP, STEP / 2))
        for (name, function), own, *both in zip(
            self._given.items(), *(np.split(part, 2) for part in (slope, *differences)), strict=True
        ):
            check_derivative(name, "H", None if function is None else own, *both, rounding=rounding)
        return super().solve(t_span, X, method, **options)


# -- from a Lagrangian --------------------------------------------------------------------------------


def action(lagrangian: Lagrangian, times: ArrayLike, path: ArrayLike) -> float:
    """S of a path through q(t_k), shape (k, f), straight between the times (notes eq. 42).

    The velocity of a piece is its difference quotient and L is taken at its middle, so that the path of least S obeys
    Lagrange's equations to second order in the time step.
    """
    t, q = as_float_array(times, "times"), as_float_array(path, "path")
    if t.ndim != 1 or not np.all(np.diff(t) > 0) or q.shape[:1] != t.shape:
        raise InputError("times increase, and the path has a place for each of them", item="times")
    q = q.reshape(len(t), -1)
    steps = np.diff(t)
    middles, velocities = 0.5 * (q[1:] + q[:-1]), np.diff(q, axis=0) / steps[:, None]
    values = [lagrangian(x, v, float(s)) for x, v, s in zip(middles, velocities, 0.5 * (t[1:] + t[:-1]), strict=True)]
    return float(np.dot(values, steps))


def momentum(lagrangian: Lagrangian, q: ArrayLike, v: ArrayLike, t: float = 0.0) -> FloatArray:
    """p = dL/dv, shape (f,) (notes eq. 45)."""
    q = as_float_array(q, "q")
    return jacobian_by_differences(lambda s, w: lagrangian(q, w, t), t, v)


def lagrange_residual(
    lagrangian: Lagrangian, q: ArrayLike, v: ArrayLike, a: ArrayLike, t: float = 0.0, step: float = 1e-2
) -> FloatArray:
    """d/dt dL/dv - dL/dq along q, v, a, shape (f,); zero on a true motion (notes eq. 44)."""
    q, v, a = as_float_array(q, "q"), as_float_array(v, "v"), as_float_array(a, "a")

    def along(h: float) -> FloatArray:
        return momentum(lagrangian, q + h * v + 0.5 * h * h * a, v + h * a, t + h)

    first, second = ((along(h) - along(-h)) / (2 * h) for h in (step, step / 2))
    return (4 * second - first) / 3 - jacobian_by_differences(lambda s, x: lagrangian(x, v, t), t, q)


def velocity_of_momentum(
    lagrangian: Lagrangian, q: ArrayLike, p: ArrayLike, t: float = 0.0, guess: ArrayLike | None = None
) -> FloatArray:
    """The v with dL/dv = p, shape (f,).

    Raises
    ------
    ConvergenceError
        If there is none near the guess.
    """
    p = as_float_array(p, "p")
    start = p if guess is None else as_float_array(guess, "guess")
    found = root(lambda v: momentum(lagrangian, q, v, t) - p, start, options={"xtol": 1e-13})
    if not np.all(np.abs(found.fun) <= 1e-9 * np.maximum(1.0, np.abs(p))):
        left = float(np.max(np.abs(found.fun)))
        raise ConvergenceError("no velocity has this momentum; give a guess near it", residual=left)
    return np.asarray(found.x)


def hamiltonian(lagrangian: Lagrangian, q: ArrayLike, p: ArrayLike, t: float = 0.0) -> float:
    """H(q, p, t) = v . p - L with v the velocity of this momentum (notes eqs. 47, 48)."""
    q = as_float_array(q, "q")
    v = velocity_of_momentum(lagrangian, q, p, t)
    return float(v @ as_float_array(p, "p") - lagrangian(q, v, t))
