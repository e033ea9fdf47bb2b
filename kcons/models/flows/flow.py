"""Flows: dX/dt = V(X, t) (notes eqs. 1-3), their Jacobians, divergence, trajectories and phase-space volume; mechanics.

Functions take their arguments in SciPy's order, (t, X). Lagrangians are functions L(q, v, t) of arrays q, v of shape
(f,) and a number t; Hamiltonians H(q, p, t) likewise (notes section 2).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp
from scipy.optimize import root

from kcons.constraints.arguments import FloatArray, as_float_array, check_call, read_only_view, whole_number
from kcons.constraints.target import WRONG, first_derivative_4
from kcons.errors import ConvergenceError, InputError
from kcons.models.integration import STEP, called, check_derivative, jacobian_by_differences

__all__ = ["Flow", "HamiltonianFlow", "PhaseVolume", "action", "hamiltonian", "jacobian_by_differences"]
__all__ += ["lagrange_residual", "momentum", "phase_volume"]

Field = Callable[[float, FloatArray], ArrayLike]
Lagrangian = Callable[[FloatArray, FloatArray, float], float]


class Flow:
    """A velocity field in phase space.

    Parameters
    ----------
    velocity : callable (t, X) -> (n,)
        V.
    n : int
        Number of variables.
    jacobian : callable (t, X) -> (n, n), optional
        A_kl = dV_k/dX_l (notes eq. 27); by differences where it is not given.
    """

    def __init__(self, velocity: Field, n: int, jacobian: Field | None = None) -> None:
        self.n = whole_number(n, "n")
        check_call("velocity", velocity, ("t", "X"))
        check_call("jacobian", jacobian, ("t", "X"))
        self._velocity = velocity
        self._jacobian = jacobian

    def velocity(self, t: float, X: ArrayLike) -> FloatArray:
        """V(X, t), shape (n,) (notes eqs. 2, 3)."""
        return called("velocity", self._velocity, (self.n,), t, self._state(X))

    def jacobian(self, t: float, X: ArrayLike) -> FloatArray:
        """A = dV/dX, shape (n, n) (notes eq. 27)."""
        X = self._state(X)
        if self._jacobian is None:
            return jacobian_by_differences(self._velocity, t, X)
        return called("jacobian", self._jacobian, (self.n, self.n), t, X)

    def jacobian_error(self, t: float, X: ArrayLike) -> FloatArray:
        """How far `jacobian` may be off, shape (n, n): 0 where it is given, else what half the steps change."""
        if self._jacobian is not None:
            return np.zeros((self.n, self.n))
        whole, half = self._differences(t, X)
        # Beyond truncation: the rounding of V, which half the steps double.
        return np.asarray(2.0 * np.abs(whole - half) + 1e-12 * np.max(np.abs(whole)))

    def _differences(self, t: float, X: ArrayLike) -> list[FloatArray]:
        """Jacobians with a step and with half of it."""
        return [jacobian_by_differences(self._velocity, t, self._state(X), step) for step in (STEP, STEP / 2)]

    def _check_jacobian(self, t: float, X: FloatArray) -> None:
        given = None if self._jacobian is None else self.jacobian(t, X)
        check_derivative("jacobian", "the velocity", given, *self._differences(t, X))

    def divergence(self, t: float, X: ArrayLike) -> float:
        """div V = tr A (notes eqs. 36, 37)."""
        return float(np.trace(self.jacobian(t, X)))

    def solve(
        self,
        t_span: Sequence[float],
        X0: ArrayLike,
        method: str = "DOP853",
        *,
        rtol: float = 1e-10,
        atol: float = 1e-12,
        **options: Any,
    ) -> Any:
        """A trajectory X(t) = f(X_0; t) (notes eq. 30): SciPy's ``solve_ivp``, with tighter tolerances."""
        return solve_ivp(self.velocity, tuple(t_span), self._state(X0), method, rtol=rtol, atol=atol, **options)

    def _state(self, X: ArrayLike) -> FloatArray:
        array = as_float_array(X, "X")
        if array.shape != (self.n,):
            raise InputError(f"a state of this flow has shape ({self.n},), not {array.shape}", item="X")
        if not np.all(np.isfinite(array)):
            raise InputError("the state is not finite", item="X")
        return array


class PhaseVolume(NamedTuple):
    """How a small volume is carried along, at k times."""

    t: FloatArray
    #: Shape (k, n).
    states: FloatArray
    #: dX_t/dX_0, shape (k, n, n) (notes eq. 34).
    propagators: FloatArray
    #: ln |det dX_t/dX_0|, from the propagators (notes eq. 33).
    log_volume: FloatArray
    #: The integral of div V along the trajectory; the same number.
    integrated_divergence: FloatArray


def phase_volume(
    flow: Flow, X0: ArrayLike, times: ArrayLike, *, rtol: float = 1e-11, atol: float = 1e-12
) -> PhaseVolume:
    """The change of phase-space volume along a trajectory (notes eqs. 30-39).

    Integrates the variational equation dJ/dt = A(X, t) J, J = 1, together with the trajectory, starting J anew at every
    time wanted, so that a volume that shrinks by many orders of magnitude keeps its digits.

    Parameters
    ----------
    flow : Flow
    X0 : array_like, shape (n,)
    times : array_like, shape (k,)
        Increasing; the first is that of X0.

    Raises
    ------
    InputError
        Times that do not increase; a Jacobian that differences contradict.
    ConvergenceError
        If the integration fails, or a volume shrinks beyond the digits of its propagator.
    """
    wanted = as_float_array(times, "times")
    if wanted.ndim != 1 or len(wanted) < 1 or not np.all(np.diff(wanted) > 0):
        raise InputError("times are one-dimensional and increase", item="times")
    n = flow.n
    state, total = flow._state(X0), np.eye(n)
    flow._check_jacobian(wanted[0], state)
    log_volume = divergence = 0.0
    rows = [(state, total, 0.0, 0.0)]

    def together(t: float, Y: FloatArray) -> FloatArray:
        A = flow.jacobian(t, Y[:n])
        return np.concatenate([flow.velocity(t, Y[:n]), (A @ Y[n:-1].reshape(n, n)).ravel(), [np.trace(A)]])

    for a, b in pairwise(wanted):
        start = np.concatenate([state, np.eye(n).ravel(), [0.0]])
        found = solve_ivp(together, (a, b), start, "DOP853", rtol=rtol, atol=atol)
        if not found.success:
            raise ConvergenceError(f"the variational equation could not be integrated beyond t = {found.t[-1]:.6g}")
        state, J = found.y[:n, -1], found.y[n:-1, -1].reshape(n, n)
        change, integral = float(np.linalg.slogdet(J)[1]), float(found.y[-1, -1])
        if not abs(change - integral) <= WRONG * max(1.0, abs(integral)):
            raise ConvergenceError(
                f"from t = {a:.6g} to {b:.6g} the volume changes by exp({integral:.6g}), which its propagator no "
                "longer resolves: give more times"
            )
        flow._check_jacobian(b, state)
        log_volume, divergence, total = log_volume + change, divergence + integral, J @ total
        rows.append((state, total, log_volume, divergence))
    return PhaseVolume(wanted, *(np.array(column) for column in zip(*rows, strict=True)))


# -- mechanics -----------------------------------------------------------------------------------------


class HamiltonianFlow(Flow):
    """The flow of H(q, p, t) on X = (q, p): dq/dt = dH/dp, dp/dt = -dH/dq (notes eqs. 49-55).

    The gradients are differences of H; where they are known, `Flow` takes (dH/dp, -dH/dq).

    Parameters
    ----------
    hamiltonian : callable (q, p, t) -> float
        H, arrays of shape (f,). Where it depends on t, the energy changes with its derivative by t (notes eq. 51).
    f : int
        Degrees of freedom.
    """

    def __init__(self, hamiltonian: Callable[..., float], f: int) -> None:
        self.f = whole_number(f, "f")
        check_call("hamiltonian", hamiltonian, ("q", "p", "t"))
        self.hamiltonian = hamiltonian
        super().__init__(self._field, 2 * self.f)

    def energy(self, X: ArrayLike, t: float = 0.0) -> float:
        """H(q, p, t)."""
        q, p = np.split(read_only_view(self._state(X)), 2)
        return float(called("hamiltonian", self.hamiltonian, (), q, p, t))

    def _gradient(self, t: float, X: FloatArray, step: float = STEP) -> FloatArray:
        """(dH/dq, dH/dp), shape (2f,)."""
        return jacobian_by_differences(lambda s, Y: self.energy(Y, s), t, X, step)

    def _field(self, t: float, X: FloatArray) -> FloatArray:
        slope = self._gradient(t, X)
        return np.concatenate([slope[self.f :], -slope[: self.f]])

    def solve(self, t_span: Sequence[float], X0: ArrayLike, method: str = "DOP853", **options: Any) -> Any:
        """As `Flow.solve`; refused where differences of H with half the step are others."""
        X, t = self._state(X0), float(t_span[0])
        both = (self._gradient(t, X, step) for step in (STEP, STEP / 2))
        rounding = 1e-10 * abs(self.energy(X, t))
        check_derivative("gradient to a Flow", "H", None, *both, rounding=rounding)
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
    places = zip(middles, velocities, 0.5 * (t[1:] + t[:-1]), strict=True)
    return float(np.dot([called("lagrangian", lagrangian, (), x, v, float(s)) for x, v, s in places], steps))


def momentum(lagrangian: Lagrangian, q: ArrayLike, v: ArrayLike, t: float = 0.0) -> FloatArray:
    """p = dL/dv, shape (f,) (notes eq. 45)."""
    q = as_float_array(q, "q")
    return jacobian_by_differences(lambda s, w: called("lagrangian", lagrangian, (), q, w, t), t, v)


def lagrange_residual(
    lagrangian: Lagrangian, q: ArrayLike, v: ArrayLike, a: ArrayLike, t: float = 0.0, step: float = 1e-2
) -> FloatArray:
    """d/dt dL/dv - dL/dq along q, v, a, shape (f,); zero on a true motion (notes eq. 44)."""
    q, v, a = as_float_array(q, "q"), as_float_array(v, "v"), as_float_array(a, "a")

    def along(h: float) -> FloatArray:
        return momentum(lagrangian, q + h * v + 0.5 * h * h * a, v + h * a, t + h)

    slope = jacobian_by_differences(lambda s, x: called("lagrangian", lagrangian, (), x, v, t), t, q)
    return first_derivative_4(along, 0.0, step) - slope


def hamiltonian(lagrangian: Lagrangian, q: ArrayLike, p: ArrayLike, t: float = 0.0) -> float:
    """H(q, p, t) = v . p - L, v the velocity with dL/dv = p (notes eqs. 47, 48).

    Raises
    ------
    ConvergenceError
        If no such velocity is found.
    """
    q, p = as_float_array(q, "q"), as_float_array(p, "p")
    found = root(lambda v: momentum(lagrangian, q, v, t) - p, p, options={"xtol": 1e-13})
    if not np.all(np.abs(found.fun) <= 1e-9 * np.maximum(1.0, np.abs(p))):
        left = float(np.max(np.abs(found.fun)))
        raise ConvergenceError("no velocity has this momentum; see whether dL/dv can take it", residual=left)
    return float(found.x @ p - lagrangian(q, found.x, t))
