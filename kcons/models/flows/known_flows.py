"""Flows with known solutions: oscillators, the pendulum, particle on a sphere, thermostat (notes examples 1 to 5)."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike

from kcons.constraints.arguments import FloatArray, NotNegative, Positive, as_float_array, check_call, checked, positive
from kcons.errors import InputError
from kcons.models.flows.flow import Flow, phase_volume
from kcons.models.flows.linear import JordanBlocks, JordanForm, LinearFlow, jordan_block
from kcons.models.integration import called

__all__ = ["DampedOscillator", "HarmonicOscillator", "ParticleOnSphere", "Pendulum", "Thermostat"]


class DampedOscillator(LinearFlow):
    """dx_1/dt = Omega x_2, dx_2/dt = -Omega x_1 - eta x_2, with x_1 = Omega x and x_2 = dx/dt (notes eqs. 20-22)."""

    @checked
    def __init__(self, omega: Positive = 1.0, eta: NotNegative = 0.2) -> None:
        self.omega, self.eta = omega, eta
        super().__init__([[0.0, self.omega], [-self.omega, -self.eta]])

    def eigenvalues(self) -> tuple[complex, complex]:
        """(-eta -+ a)/2, a = (eta^2 - 4 Omega^2)^1/2, in this order (notes eq. 23).

        Each to its own last digits: the slow one of two real ones is Omega^2 over the fast one, without a difference.
        """
        a = np.sqrt(complex(self.eta - 2 * self.omega)) * np.sqrt(self.eta + 2 * self.omega)
        first = complex(-0.5 * (self.eta + a))
        return first, (first.conjugate() if a.imag else self.omega * (self.omega / first))

    def jordan_form(self) -> JordanForm:
        """T and J in closed form (notes eqs. 17, 24); one block at critical damping, where T of (24) is singular."""
        first, second = self.eigenvalues()
        if first == second:
            T, J = np.array([[-1.0, -1.0 / self.omega], [1.0, 0.0]]), jordan_block(first, 2)
            return JordanForm(T.astype(np.complex128), J.astype(np.complex128), [JordanBlocks(first, (2,))])
        T = np.array([[second / self.omega, first / self.omega], [1.0, 1.0]])
        return JordanForm(T, np.diag([first, second]), [JordanBlocks(k, (1,)) for k in (first, second)])

    def closed_form(self, t: float) -> FloatArray:
        """exp(At), shape (2, 2), in one formula for all regimes (notes eq. 25, derived anew).

        e^(-eta t/2) [C 1 + S (A + eta/2)] with C = cosh(at/2), S = sinh(at/2)/(a/2): both depend on a^2 alone, and are
        smooth through a = 0.
        """
        half = 0.5 * np.sqrt(complex(self.eta - 2 * self.omega)) * np.sqrt(self.eta + 2 * self.omega)
        # C = e^(at/2) (1 + e^(-at))/2, the first factor with the other exponential: apart they overflow.
        first = np.exp(-(self.omega**2) / (0.5 * self.eta + half) * t)
        share = -np.expm1(-2 * half * t) / (2 * half * t) if half * t else 1.0
        C, S = first * (1.0 - half * t * share), first * t * share
        return np.asarray((C * np.eye(2) + S * (self.matrix + 0.5 * self.eta * np.eye(2))).real)


class HarmonicOscillator(DampedOscillator):
    """dx_1/dt = Omega x_2, dx_2/dt = -Omega x_1 (notes eqs. 4-6, 15)."""

    def __init__(self, omega: float = 1.0) -> None:
        super().__init__(omega, 0.0)


class Pendulum(Flow):
    """x_1 = theta, x_2 = (dtheta/dt)/Omega; H = Omega (x_2^2/2 + 1 - cos x_1) (notes example 3, eqs. 56-61)."""

    @checked
    def __init__(self, omega: Positive = 1.0) -> None:
        self.omega = omega
        super().__init__(
            lambda t, X: np.array([omega * X[1], -omega * np.sin(X[0])]),
            2,
            lambda t, X: np.array([[0.0, omega], [-omega * np.cos(X[0]), 0.0]]),
        )

    def energy(self, X: ArrayLike) -> float:
        """H, constant along every trajectory."""
        x1, x2 = self._state(X)
        return float(self.omega * (0.5 * x2**2 + 2.0 * np.sin(0.5 * x1) ** 2))


class ParticleOnSphere(Flow):
    """A particle of mass m on a sphere of radius R about the origin, X = (x, v) (notes example 4, eq. 110).

        a = (1 - x x^T/R^2) f/m - (v.v/R^2) x

    Parameters
    ----------
    radius, mass : float
    force : callable (x) -> (3,), optional
        None for free motion.
    """

    def __init__(
        self, radius: float = 1.0, mass: float = 1.0, force: Callable[[FloatArray], ArrayLike] | None = None
    ) -> None:
        self.radius, self.mass = positive(radius, "radius"), positive(mass, "mass")
        self.force = force
        super().__init__(lambda t, X: np.concatenate([X[3:], self.acceleration(X[:3], X[3:])]), 6)

    def acceleration(self, x: ArrayLike, v: ArrayLike) -> FloatArray:
        """The acceleration on the sphere, shape (3,) (notes eq. 110)."""
        x, v = as_float_array(x, "x"), as_float_array(v, "v")
        a = -(v @ v) / self.radius**2 * x
        if self.force is not None:
            f = called("force", self.force, (3,), x) / self.mass
            a = a + f - x * (x @ f) / self.radius**2
        return np.asarray(a)


class Thermostat(Flow):
    """Particles at constant kinetic energy; X = (M^1/2 x, M^1/2 v), in which this is a sphere (notes example 5).

        dx/dt = v,   dv/dt = f/m - alpha v,   alpha = v.f/(2K),   2K = v^T M v   (eq. 113)

    On the surface of constant K the flow compresses phase space at the rate div V = -(g - 1) alpha, g the number of
    components.

    Parameters
    ----------
    masses : array_like, shape (n,)
        One for each Cartesian component.
    force : callable (x) -> (n,)
    """

    def __init__(self, masses: ArrayLike, force: Callable[[FloatArray], ArrayLike]) -> None:
        m = as_float_array(masses, "masses").copy()
        if m.ndim != 1 or m.size < 2 or not np.all(np.isfinite(m) & (m > 0)):
            raise InputError("masses are positive, one for each of at least two Cartesian components", item="masses")
        check_call("force", force, ("x",))
        self.masses, self.root, self.force = m, np.sqrt(m), force
        super().__init__(self._field, 2 * m.size)

    def state(self, x: ArrayLike, v: ArrayLike) -> FloatArray:
        """X of positions and velocities."""
        x, v = as_float_array(x, "x").ravel(), as_float_array(v, "v").ravel()
        if x.shape != self.masses.shape or v.shape != self.masses.shape:
            raise InputError(f"x and v have {self.masses.size} components each, as the masses", item="x")
        if not v @ (self.masses * v) > 1e-290:
            raise InputError("an isokinetic thermostat needs non-zero kinetic energy", item="v")
        return self._state(np.concatenate([self.root * x, self.root * v]))

    def friction(self, X: ArrayLike) -> float:
        """alpha = v.f/(v^T M v) (notes eq. 113)."""
        X = as_float_array(X, "X")
        w = X[self.masses.size :]
        return float(w @ self._push(X) / (w @ w))

    def _push(self, X: FloatArray) -> FloatArray:
        """M^-1/2 f, shape (n,)."""
        x = X[: self.masses.size] / self.root
        return called("force", self.force, x.shape, x, scalar=True) / self.root

    def _field(self, t: float, X: FloatArray) -> FloatArray:
        w = X[self.masses.size :]
        return np.concatenate([w, self._push(X) - self.friction(X) * w])

    def compression(self, X0: ArrayLike, times: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Measure the compression of phase space along a trajectory, and predict it from alpha, shape (k,) each.

        The first is ln of the volume spanned by tangent vectors of the surface of constant K, carried along by the
        variational equation; the second -(g - 1) times the integral of alpha.
        """
        X0, n = self._state(X0), self.masses.size
        extended = Flow(lambda t, Y: np.append(self.velocity(t, Y[:-1]), self.friction(Y[:-1])), self.n + 1)
        wanted = np.atleast_1d(as_float_array(times, "times"))
        Y, volume, rows = np.append(X0, 0.0), 0.0, [(0.0, 0.0)]
        for a, b in pairwise(wanted):
            # Vectors along the surface start anew as orthonormal ones: carried far, they would all turn into one.
            T = scipy.linalg.block_diag(np.eye(n), scipy.linalg.null_space(Y[None, n:-1]))
            found = phase_volume(extended, Y, [a, b])
            carried = found.propagators[-1, :-1, :-1] @ T
            volume += 0.5 * float(np.linalg.slogdet(carried.T @ carried)[1])
            Y = found.states[-1]
            rows.append((volume, float(Y[-1])))
        volumes, frictions = np.array(rows).T
        return volumes, -(n - 1) * frictions
