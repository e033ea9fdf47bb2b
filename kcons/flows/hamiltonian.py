"""Hamiltonian flows dq/dt = dH/dp, dp/dt = -dH/dq with symplectic integrators (notes eqs. 49-55)."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from kcons.errors import ConvergenceError, InputError
from kcons.flows.flow import FloatArray, Flow, jacobian_by_differences

Energy = Callable[[FloatArray, FloatArray], float]
Gradient = Callable[[FloatArray, FloatArray], ArrayLike]

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
#: Parts of a step of leapfrog that make it of order 4 (Suzuki).
_PART = 1 / (4 - 4 ** (1 / 3))
SUZUKI = (_PART, _PART, 1 - 4 * _PART, _PART, _PART)


class SymplecticTrajectory(NamedTuple):
    """Times, shape (k,), coordinates and momenta, shape (k, f), and energies, shape (k,)."""

    t: FloatArray
    q: FloatArray
    p: FloatArray
    energy: FloatArray


class HamiltonianFlow(Flow):
    """The flow of H(q, p) on X = (q, p).

    Parameters
    ----------
    hamiltonian : callable (q, p) -> float
        H, arrays of shape (f,).
    f : int
        Degrees of freedom.
    dH_dq, dH_dp : callable (q, p) -> (f,), optional
        Gradients; by differences where they are not given.
    separable : bool
        Whether H = T(p) + U(q): then explicit integrators apply.

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
    ) -> None:
        if f < 1:
            raise InputError(f"there is at least one degree of freedom, not {f}", item="f")
        self.f = int(f)
        self.hamiltonian = hamiltonian
        self.separable = separable
        self._dH_dq, self._dH_dp = dH_dq, dH_dp
        super().__init__(lambda t, X: self._field(X), 2 * self.f)

    def energy(self, X: ArrayLike) -> float:
        """H(q, p)."""
        X = self._state(X)
        return float(self.hamiltonian(X[: self.f], X[self.f :]))

    def gradient_q(self, q: FloatArray, p: FloatArray) -> FloatArray:
        """dH/dq, shape (f,)."""
        if self._dH_dq is not None:
            return np.asarray(self._dH_dq(q, p), dtype=np.float64)
        return jacobian_by_differences(lambda t, x: [self.hamiltonian(x, p)], 0.0, q)[0]

    def gradient_p(self, q: FloatArray, p: FloatArray) -> FloatArray:
        """dH/dp, shape (f,)."""
        if self._dH_dp is not None:
            return np.asarray(self._dH_dp(q, p), dtype=np.float64)
        return jacobian_by_differences(lambda t, x: [self.hamiltonian(q, x)], 0.0, p)[0]

    def _field(self, X: FloatArray) -> FloatArray:
        q, p = X[: self.f], X[self.f :]
        return np.concatenate([self.gradient_p(q, p), -self.gradient_q(q, p)])

    def symplectic(
        self, q0: ArrayLike, p0: ArrayLike, dt: float, steps: int, method: str = "gauss6", every: int = 1
    ) -> SymplecticTrajectory:
        """A trajectory with a fixed step and a symplectic method: its energy error does not grow.

        Parameters
        ----------
        q0, p0 : array_like, shape (f,)
        dt : float
        steps : int
        method : str
            'gauss6' for any H, implicit; 'leapfrog' (order 2) and 'suzuki4' (order 4) for a separable one, explicit.
        every : int
            Each so many steps are kept.

        Raises
        ------
        InputError
            An unknown method, an explicit one for an H that is not separable, or a step that is zero or not finite.
        ConvergenceError
            If the implicit equations of a step could not be solved; take a smaller one.
        """
        if method not in ("gauss6", "leapfrog", "suzuki4"):
            raise InputError(f"there is no method {method!r}; choose gauss6, leapfrog or suzuki4", item="method")
        if method != "gauss6" and not self.separable:
            raise InputError(f"{method} needs H = T(p) + U(q): say separable=True, or use gauss6", item="method")
        if not np.isfinite(dt) or dt == 0.0 or steps < 0 or every < 1:
            raise InputError("dt is finite and not zero, steps not negative, every at least 1", item="dt")
        X = self._state(np.concatenate([np.atleast_1d(q0), np.atleast_1d(p0)]).astype(np.float64))
        parts = [1.0] if method == "leapfrog" else list(SUZUKI)
        kept = [X]
        for step in range(1, steps + 1):
            if method == "gauss6":
                X = self._gauss(X, dt)
            else:
                for part in parts:
                    X = self._leapfrog(X, part * dt)
            if step % every == 0:
                kept.append(X)
        states = np.array(kept)
        times: FloatArray = np.asarray(dt * every * np.arange(len(states)), dtype=np.float64)
        return SymplecticTrajectory(
            times, states[:, : self.f], states[:, self.f :], np.array([self.energy(X) for X in states])
        )

    def _leapfrog(self, X: FloatArray, dt: float) -> FloatArray:
        q, p = X[: self.f], X[self.f :]
        p = p - 0.5 * dt * self.gradient_q(q, p)
        q = q + dt * self.gradient_p(q, p)
        p = p - 0.5 * dt * self.gradient_q(q, p)
        return np.concatenate([q, p])

    def _gauss(self, X: FloatArray, dt: float) -> FloatArray:
        K = np.repeat(self._field(X)[None, :], 3, axis=0)
        change, before = np.inf, np.inf
        for _ in range(100):
            with np.errstate(all="ignore"):
                new = np.array([self._field(X + dt * (row @ K)) for row in GAUSS_A])
                change = float(np.max(np.abs(new - K))) * abs(dt)
            if not np.isfinite(change):
                break
            K = new
            # To round-off: an iteration stopped earlier would let the energy drift.
            if change == 0.0 or (change >= before and change <= 1e-13 * max(1.0, float(np.max(np.abs(X))))):
                return np.asarray(X + dt * (GAUSS_B @ K))
            before = change
        if not change <= 1e-12 * max(1.0, float(np.max(np.abs(X)))):
            raise ConvergenceError(
                f"the implicit step of {dt:g} could not be solved; take a smaller one", residual=change
            )
        return np.asarray(X + dt * (GAUSS_B @ K))
