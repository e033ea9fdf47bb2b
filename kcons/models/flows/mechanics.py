"""Mechanics as flows: from a Lagrangian to Hamilton's equations, and symplectic steps (notes section 2).

Lagrangians are functions L(q, v, t) of arrays q, v of shape (f,) and a number t; Hamiltonians H(q, p) or H(q, p, t).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import root

from kcons.constraints.arguments import FloatArray, check_call, finite_number, lent, numbers, whole_number
from kcons.errors import ConvergenceError, InputError
from kcons.models.flows.flow import Flow
from kcons.models.integration import STEP, check_derivative, jacobian_by_differences

Lagrangian = Callable[[FloatArray, FloatArray, float], float]
#: (q, p) -> float or (f,), or (q, p, t) -> the same where H depends on time.
Energy = Callable[..., float]
Gradient = Callable[..., ArrayLike]

#: Gauss-Legendre collocation with three points: order 6, symplectic, for any H.
_ROOT = np.sqrt(15.0)
GAUSS_A = np.array(
    [
        [5 / 36, 2 / 9 - _ROOT / 15, 5 / 36 - _ROOT / 30],
        [5 / 36 + _ROOT / 24, 2 / 9, 5 / 36 - _ROOT / 24],
        [5 / 36 + _ROOT / 30, 2 / 9 + _ROOT / 15, 5 / 36],
    ]
)
GAUSS_B = np.array([5 / 18, 4 / 9, 5 / 18])
GAUSS_C = np.array([0.5 - _ROOT / 10, 0.5, 0.5 + _ROOT / 10])
_PART = 1 / (4 - 4 ** (1 / 3))
#: Parts of a step that are taken by leapfrog; five of them make it of order 4 (Suzuki).
SEPARABLE = {"leapfrog": (1.0,), "suzuki4": (_PART, _PART, 1 - 4 * _PART, _PART, _PART)}


class SymplecticTrajectory(NamedTuple):
    """Times, shape (k,), coordinates and momenta, shape (k, f), and energies H(q, p, t), shape (k,)."""

    t: FloatArray
    q: FloatArray
    p: FloatArray
    energy: FloatArray


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
    separable : bool
        Whether H = T(p) + U(q), or T(p, t) + U(q, t): then explicit integrators apply.
    time_dependent : bool
        Whether H and its gradients take the time as a third argument, (q, p, t). The energy then changes, by
        dH/dt = the derivative of H with respect to its third argument (notes eq. 51).

    Raises
    ------
    InputError
        If f < 1.
    """

    def __init__(
        self,
        hamiltonian: Energy,
        f: int,
        dH_dq: Gradient | None = None,
        dH_dp: Gradient | None = None,
        *,
        separable: bool = False,
        time_dependent: bool = False,
    ) -> None:
        self.f = whole_number(f, "f")
        self._given = {"dH_dq": dH_dq, "dH_dp": dH_dp}
        taken = ("q", "p", "t") if time_dependent else ("q", "p")
        for name, function in (("hamiltonian", hamiltonian), *self._given.items()):
            check_call(name, function, taken, "; time_dependent says whether it gets the time")
        self.hamiltonian = hamiltonian
        self.separable, self.time_dependent = separable, time_dependent
        super().__init__(self._field, 2 * self.f)

    def _of(self, function: Callable[..., ArrayLike], X: FloatArray, t: float) -> ArrayLike:
        """A function of the user at X."""
        X = lent(X)
        return function(X[: self.f], X[self.f :], *((t,) if self.time_dependent else ()))

    def energy(self, X: ArrayLike, t: float = 0.0) -> float:
        """H(q, p), or H(q, p, t)."""
        return float(self._of(self.hamiltonian, self._state(X), t))  # type: ignore[arg-type]

    def gradient(self, name: str, X: FloatArray, t: float = 0.0) -> FloatArray:
        """dH/dq or dH/dp, shape (f,); by the name of the argument."""
        function = self._given[name]
        if function is None:
            own = slice(0, self.f) if name == "dH_dq" else slice(self.f, None)
            step = lambda x: np.concatenate([x, X[self.f :]] if name == "dH_dq" else [X[: self.f], x])  # noqa: E731
            return jacobian_by_differences(lambda s, x: self._of(self.hamiltonian, step(x), s), t, X[own])
        found = numbers(self._of(function, X, t), name)
        if found.shape != (self.f,):
            raise InputError(f"{name} returned shape {found.shape}, not ({self.f},)", item=name)
        return found

    def _field(self, t: float, X: FloatArray) -> FloatArray:
        return np.concatenate([self.gradient("dH_dp", X, t), -self.gradient("dH_dq", X, t)])

    def _check(self, X: FloatArray, t: float) -> None:
        """Refuse gradients that differences of H contradict, differences that do not serve, H that is not separable."""
        f = self.f
        coarse, fine = (jacobian_by_differences(lambda s, Y: self.energy(Y, s), t, X, h) for h in (STEP, STEP / 2))
        rounding = 1e-10 * abs(self.energy(X, t))
        for name, part in (("dH_dq", slice(0, f)), ("dH_dp", slice(f, None))):
            given = None if self._given[name] is None else self.gradient(name, X, t)
            check_derivative(name, "H", given, coarse[part], fine[part], rounding=rounding)
        if not self.separable:
            return
        near = X + 1e-2 * (np.abs(X) + 1.0) * np.random.default_rng(0).uniform(0.5, 1.0, X.shape)
        both = [self.energy(np.concatenate([a[:f], b[f:]]), t) for a in (X, near) for b in (X, near)]
        mixed, change = both[3] - both[1] - both[2] + both[0], np.ptp(both)
        if abs(mixed) > 1e-6 * change + 1e-12 * np.abs(both).max():
            raise InputError(
                f"H is not T(p) + U(q): q and p change it together by {mixed:.3g} beside {change:.3g}; use "
                "separable=False and method='gauss6'",
                item="separable",
            )

    def symplectic(
        self,
        q0: ArrayLike,
        p0: ArrayLike,
        dt: float,
        steps: int,
        method: str = "gauss6",
        every: int = 1,
        *,
        t0: float = 0.0,
    ) -> SymplecticTrajectory:
        """A trajectory with a fixed step and a symplectic method: its energy error does not grow.

        Where H depends on time, it is the error of the energy and of the momentum that goes with the time, -H, taken
        together; the steps are symmetric in time, and keep their order.

        Parameters
        ----------
        q0, p0 : array_like, shape (f,)
        dt : float
        steps : int
        method : str
            'gauss6' for any H, implicit; 'leapfrog' (order 2) and 'suzuki4' (order 4) for a separable one, explicit.
        every : int
            Each so many steps are kept.
        t0 : float
            The time of the start.

        Raises
        ------
        InputError
            An unknown method, an explicit one for an H that is not separable, a step that is zero or not finite, or
            gradients that differences of H contradict.
        ConvergenceError
            If the implicit equations of a step could not be solved; take a smaller one.
        """
        if method != "gauss6" and method not in SEPARABLE:
            raise InputError(f"there is no method {method!r}; choose gauss6, leapfrog or suzuki4", item="method")
        if method != "gauss6" and not self.separable:
            raise InputError(f"{method} needs H = T(p) + U(q): say separable=True, or use gauss6", item="method")
        steps, every = whole_number(steps, "steps", 0), whole_number(every, "every")
        dt, t0 = finite_number(dt, "dt"), finite_number(t0, "t0")
        if dt == 0.0:
            raise InputError("dt is finite and not zero", item="dt")
        halves = [np.atleast_1d(numbers(part, name)) for name, part in (("q0", q0), ("p0", p0))]
        if any(part.shape != (self.f,) for part in halves):
            raise InputError(f"q0 and p0 have shape ({self.f},) each", item="q0")
        X = self._state(np.concatenate(halves))
        self._check(X, t0)
        kept = [X]
        for step in range(1, steps + 1):
            t = t0 + (step - 1) * dt
            if method == "gauss6":
                X = self._gauss(t, X, dt)
            for part in SEPARABLE.get(method, ()):
                X = self._leapfrog(t, X, part * dt)
                t += part * dt
            if step % every == 0:
                kept.append(X)
        states, times = np.array(kept), t0 + dt * every * np.arange(len(kept), dtype=np.float64)
        energies = np.array([self.energy(X, t) for X, t in zip(states, times, strict=True)])
        return SymplecticTrajectory(times, states[:, : self.f], states[:, self.f :], energies)

    def _leapfrog(self, t: float, X: FloatArray, dt: float) -> FloatArray:
        q, p = np.split(X, 2)
        p = p - 0.5 * dt * self.gradient("dH_dq", X, t)
        q = q + dt * self.gradient("dH_dp", np.concatenate([q, p]), t + 0.5 * dt)
        p = p - 0.5 * dt * self.gradient("dH_dq", np.concatenate([q, p]), t + dt)
        return np.concatenate([q, p])

    def _gauss(self, t: float, X: FloatArray, dt: float) -> FloatArray:
        K = np.repeat(self._field(t, X)[None, :], 3, axis=0)
        size, change, before = max(1.0, float(np.max(np.abs(X)))), np.inf, np.inf
        for _ in range(100):
            with np.errstate(all="ignore"):
                new = np.array([self._field(t + GAUSS_C[k] * dt, X + dt * (GAUSS_A[k] @ K)) for k in range(3)])
                change = float(np.max(np.abs(new - K))) * abs(dt)
            if not np.isfinite(change):
                break
            K = new
            # To round-off: an iteration stopped earlier would let the energy drift.
            if change == 0.0 or before <= change <= 1e-13 * size:
                break
            before = change
        if not change <= 1e-12 * size:
            raise ConvergenceError(
                f"the implicit step of {dt:g} could not be solved; take a smaller one", residual=change
            )
        return np.asarray(X + dt * (GAUSS_B @ K))


# -- from a Lagrangian --------------------------------------------------------------------------------


def action(lagrangian: Lagrangian, times: ArrayLike, path: ArrayLike) -> float:
    """S of a path through q(t_k), shape (k, f), straight between the times (notes eq. 42).

    The velocity of a piece is its difference quotient and L is taken at its middle, so that the path of least S obeys
    Lagrange's equations to second order in the time step.
    """
    t, q = numbers(times, "times"), numbers(path, "path")
    if t.ndim != 1 or not np.all(np.diff(t) > 0) or q.shape[:1] != t.shape:
        raise InputError("times increase, and the path has a place for each of them", item="times")
    q = q.reshape(len(t), -1)
    steps = np.diff(t)
    middles, velocities = 0.5 * (q[1:] + q[:-1]), np.diff(q, axis=0) / steps[:, None]
    values = [lagrangian(x, v, float(s)) for x, v, s in zip(middles, velocities, 0.5 * (t[1:] + t[:-1]), strict=True)]
    return float(np.dot(values, steps))


def momentum(lagrangian: Lagrangian, q: ArrayLike, v: ArrayLike, t: float = 0.0) -> FloatArray:
    """p = dL/dv, shape (f,) (notes eq. 45)."""
    q = numbers(q, "q")
    return jacobian_by_differences(lambda s, w: lagrangian(q, w, t), t, v)


def lagrange_residual(
    lagrangian: Lagrangian, q: ArrayLike, v: ArrayLike, a: ArrayLike, t: float = 0.0, step: float = 1e-2
) -> FloatArray:
    """d/dt dL/dv - dL/dq along q, v, a, shape (f,); zero on a true motion (notes eq. 44)."""
    q, v, a = numbers(q, "q"), numbers(v, "v"), numbers(a, "a")

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
    p = numbers(p, "p")
    start = p if guess is None else numbers(guess, "guess")
    found = root(lambda v: momentum(lagrangian, q, v, t) - p, start, options={"xtol": 1e-13})
    if not np.all(np.abs(found.fun) <= 1e-9 * np.maximum(1.0, np.abs(p))):
        left = float(np.max(np.abs(found.fun)))
        raise ConvergenceError("no velocity has this momentum; give a guess near it", residual=left)
    return np.asarray(found.x)


def hamiltonian(lagrangian: Lagrangian, q: ArrayLike, p: ArrayLike, t: float = 0.0) -> float:
    """H(q, p, t) = v . p - L with v the velocity of this momentum (notes eqs. 47, 48)."""
    q = numbers(q, "q")
    v = velocity_of_momentum(lagrangian, q, p, t)
    return float(v @ numbers(p, "p") - lagrangian(q, v, t))
