"""Hamiltonian flows dq/dt = dH/dp, dp/dt = -dH/dq with symplectic integrators (notes eqs. 49-55)."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import check_call, finite_number, lent, numbers, whole_number
from kcons.constraints.target import WRONG
from kcons.errors import ConvergenceError, InputError
from kcons.models.flows.flow import STEP, FloatArray, Flow, jacobian_by_differences

#: (q, p) -> float, or (q, p, t) -> float where H depends on time.
Energy = Callable[..., float]
#: (q, p) -> (f,), or (q, p, t) -> (f,).
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
#: Parts of a step of leapfrog that make it of order 4 (Suzuki).
_PART = 1 / (4 - 4 ** (1 / 3))
SUZUKI = (_PART, _PART, 1 - 4 * _PART, _PART, _PART)


class SymplecticTrajectory(NamedTuple):
    """Times, shape (k,), coordinates and momenta, shape (k, f), and energies H(q, p, t), shape (k,)."""

    t: FloatArray
    q: FloatArray
    p: FloatArray
    energy: FloatArray


class HamiltonianFlow(Flow):
    """The flow of H(q, p) or H(q, p, t) on X = (q, p).

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
        taken = ("q", "p", "t") if time_dependent else ("q", "p")
        for name, function in (("hamiltonian", hamiltonian), ("dH_dq", dH_dq), ("dH_dp", dH_dp)):
            check_call(name, function, taken, "; time_dependent says whether it gets the time")
        self.hamiltonian = hamiltonian
        self.separable, self.time_dependent = separable, time_dependent
        self._dH_dq, self._dH_dp = dH_dq, dH_dp
        super().__init__(self._field, 2 * self.f)

    def _at(self, t: float) -> tuple[float, ...]:
        """What the user's functions take after q and p."""
        return (t,) if self.time_dependent else ()

    def energy(self, X: ArrayLike, t: float = 0.0) -> float:
        """H(q, p), or H(q, p, t)."""
        X = lent(self._state(X))
        return float(self.hamiltonian(X[: self.f], X[self.f :], *self._at(t)))

    def _require_separable(self, X: FloatArray, t: float) -> None:
        """Refuse H that is no T(p) + U(q) about X: an explicit step would be of another system."""
        near = X + 1e-2 * (np.abs(X) + 1.0) * np.random.default_rng(0).uniform(0.5, 1.0, X.shape)
        f = self.f
        both = [self.energy(np.concatenate([a[:f], b[f:]]), t) for a, b in ((X, X), (near, X), (X, near), (near, near))]
        mixed, change = both[3] - both[1] - both[2] + both[0], np.ptp(both)
        if abs(mixed) > 1e-6 * change + 1e-12 * np.abs(both).max():
            raise InputError(
                f"H is not T(p) + U(q): q and p change it together by {mixed:.3g} beside {change:.3g}; use "
                "separable=False and method='gauss6'",
                item="separable",
            )

    def gradient_q(self, q: FloatArray, p: FloatArray, t: float = 0.0) -> FloatArray:
        """dH/dq, shape (f,)."""
        if self._dH_dq is not None:
            return self._gradient("dH_dq", self._dH_dq(lent(q), lent(p), *self._at(t)))
        return jacobian_by_differences(lambda s, x: [self.hamiltonian(x, lent(p), *self._at(s))], t, q)[0]

    def gradient_p(self, q: FloatArray, p: FloatArray, t: float = 0.0) -> FloatArray:
        """dH/dp, shape (f,)."""
        if self._dH_dp is not None:
            return self._gradient("dH_dp", self._dH_dp(lent(q), lent(p), *self._at(t)))
        return jacobian_by_differences(lambda s, x: [self.hamiltonian(lent(q), x, *self._at(s))], t, p)[0]

    def _gradient(self, name: str, found: ArrayLike) -> FloatArray:
        gradient = numbers(found, name)
        if gradient.shape != (self.f,):
            raise InputError(f"{name} returned shape {gradient.shape}, not ({self.f},)", item=name)
        return gradient

    def _check_gradients(self, X: FloatArray, t: float) -> None:
        """Refuse gradients that differences of H contradict, and differences that do not serve."""
        q, p = X[: self.f], X[self.f :]
        field = np.concatenate([self.gradient_q(q, p, t), self.gradient_p(q, p, t)])
        energy = lambda s, Y: [self.energy(Y, s)]  # noqa: E731
        coarse, fine = (jacobian_by_differences(energy, t, X, step)[0] for step in (STEP, STEP / 2))
        rounding = 1e-10 * abs(self.energy(X, t))
        for k, part in enumerate((slice(0, self.f), slice(self.f, None))):
            name, given = ("dH_dq", "dH_dp")[k], (self._dH_dq, self._dH_dp)[k]
            allowed = WRONG * np.max(np.abs(fine[part])) + rounding
            if np.any(np.abs(fine - coarse)[part] > allowed):
                if given is None:
                    raise InputError(f"H changes too fast for differences: give its {name}", item=name)
            elif np.any(np.abs(field - fine)[part] > allowed):
                raise InputError(
                    f"{name} is {field[part]} at the start, but differences of H give {fine[part]}; correct it, or "
                    "leave it out",
                    item=name,
                )

    def _field(self, t: float, X: FloatArray) -> FloatArray:
        q, p = X[: self.f], X[self.f :]
        return np.concatenate([self.gradient_p(q, p, t), -self.gradient_q(q, p, t)])

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
        if method not in ("gauss6", "leapfrog", "suzuki4"):
            raise InputError(f"there is no method {method!r}; choose gauss6, leapfrog or suzuki4", item="method")
        if method != "gauss6" and not self.separable:
            raise InputError(f"{method} needs H = T(p) + U(q): say separable=True, or use gauss6", item="method")
        steps, every = whole_number(steps, "steps", 0), whole_number(every, "every")
        dt, t0 = finite_number(dt, "dt"), finite_number(t0, "t0")
        if dt == 0.0:
            raise InputError("dt is finite and not zero", item="dt")
        parts_of_state = [np.atleast_1d(numbers(part, name)) for name, part in (("q0", q0), ("p0", p0))]
        if any(part.shape != (self.f,) for part in parts_of_state):
            raise InputError(f"q0 and p0 have shape ({self.f},) each", item="q0")
        X = self._state(np.concatenate(parts_of_state))
        self._check_gradients(X, t0)
        if method != "gauss6":
            self._require_separable(X, t0)
        parts = [1.0] if method == "leapfrog" else list(SUZUKI)
        kept = [X]
        for step in range(1, steps + 1):
            t = t0 + (step - 1) * dt
            if method == "gauss6":
                X = self._gauss(t, X, dt)
            else:
                for part in parts:
                    X = self._leapfrog(t, X, part * dt)
                    t += part * dt
            if step % every == 0:
                kept.append(X)
        states = np.array(kept)
        times: FloatArray = np.asarray(t0 + dt * every * np.arange(len(states)), dtype=np.float64)
        return SymplecticTrajectory(
            times, states[:, : self.f], states[:, self.f :], np.array(list(map(self.energy, states, times)))
        )

    def _leapfrog(self, t: float, X: FloatArray, dt: float) -> FloatArray:
        q, p = X[: self.f], X[self.f :]
        p = p - 0.5 * dt * self.gradient_q(q, p, t)
        q = q + dt * self.gradient_p(q, p, t + 0.5 * dt)
        p = p - 0.5 * dt * self.gradient_q(q, p, t + dt)
        return np.concatenate([q, p])

    def _gauss(self, t: float, X: FloatArray, dt: float) -> FloatArray:
        K = np.repeat(self._field(t, X)[None, :], 3, axis=0)
        change, before = np.inf, np.inf
        for _ in range(100):
            with np.errstate(all="ignore"):
                new = np.array([self._field(t + GAUSS_C[k] * dt, X + dt * (GAUSS_A[k] @ K)) for k in range(3)])
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
