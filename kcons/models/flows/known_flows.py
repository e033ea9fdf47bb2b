"""Flows with known solutions: oscillators, the pendulum, particle on a sphere, thermostat (notes examples 1 to 5)."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike
from scipy.special import ellipj, ellipkinc

from kcons.constraints.arguments import FloatArray, NotNegative, Positive, as_float_array, check_call, checked, positive
from kcons.errors import InputError
from kcons.models.flows.flow import Flow, HamiltonianFlow, phase_volume
from kcons.models.flows.linear import JordanBlocks, JordanForm, LinearFlow, jordan_block
from kcons.models.integration import called

__all__ = ["Compression", "DampedOscillator", "HarmonicOscillator", "ParticleOnSphere", "Pendulum", "Thermostat"]

#: Part of the energy of the separatrix, within which elliptic functions of double precision lose their digits.
NEAR_SEPARATRIX = 1e-9


class DampedOscillator(LinearFlow):
    """dx_1/dt = Omega x_2, dx_2/dt = -Omega x_1 - eta x_2, with x_1 = Omega x and x_2 = dx/dt (notes eqs. 20-22)."""

    @checked
    def __init__(self, omega: Positive = 1.0, eta: NotNegative = 0.2) -> None:
        self.omega, self.eta = omega, eta
        super().__init__([[0.0, self.omega], [-self.omega, -self.eta]])

    @property
    def regime(self) -> str:
        """'undamped', 'oscillating', 'critical' or 'overdamped', by the sign of a^2 = eta^2 - 4 Omega^2."""
        if self.eta == 0:
            return "undamped"
        if self.eta == 2 * self.omega:
            return "critical"
        return "oscillating" if self.eta < 2 * self.omega else "overdamped"

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
            return JordanForm(
                np.array([[-1.0, -1.0 / self.omega], [1.0, 0.0]], dtype=np.complex128),
                jordan_block(first, 2).astype(np.complex128),
                [JordanBlocks(first, (2,))],
            )
        return JordanForm(
            np.array([[second / self.omega, first / self.omega], [1.0, 1.0]]),
            np.diag([first, second]),
            [JordanBlocks(first, (1,)), JordanBlocks(second, (1,))],
        )

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

    def circle(self, t: ArrayLike, X0: ArrayLike) -> FloatArray:
        """X(t) on its circle, shape (2,) or (k, 2) (notes eqs. 18, 19)."""
        x1, x2 = self._state(X0)
        angle = self.omega * as_float_array(t, "t")
        c, s = np.cos(angle), np.sin(angle)
        return np.stack([c * x1 + s * x2, c * x2 - s * x1], axis=-1)


class Pendulum(HamiltonianFlow):
    """x_1 = theta, x_2 = (dtheta/dt)/Omega; H = Omega (x_2^2/2 + 1 - cos x_1) (notes example 3, eqs. 56, 57)."""

    @checked
    def __init__(self, omega: Positive = 1.0) -> None:
        self.omega = omega
        super().__init__(
            lambda q, p: float(self.omega * (0.5 * p[0] ** 2 + 2.0 * np.sin(0.5 * q[0]) ** 2)),
            1,
            lambda q, p: self.omega * np.sin(q),
            lambda q, p: self.omega * p,
        )
        self._jacobian = lambda t, X: np.array([[0.0, self.omega], [-self.omega * np.cos(X[0]), 0.0]])

    def exact(self, t: ArrayLike, X0: ArrayLike) -> FloatArray:
        """X(t) by Jacobi's elliptic functions, shape (2,) or (k, 2).

        With k^2 = H/(2 Omega): sin(theta/2) = k sn(Omega t + u_0 | k^2) for k < 1, and theta/2 = am(k Omega t + u_0 |
        1/k^2) for k > 1, where the pendulum turns over.

        Raises
        ------
        InputError
            A start on the separatrix, k = 1, or so near that elliptic functions lose their digits.
        """
        theta0, rate0 = self._state(X0)
        times = as_float_array(t, "t")
        m = self.energy(X0) / (2.0 * self.omega)
        up, half = np.abs(np.cos(0.5 * theta0)), 0.5 * abs(rate0)
        short = (up - half) * (up + half)  # 1 - m without its cancellation
        if abs(short) < NEAR_SEPARATRIX:
            raise InputError(
                f"the start is so near the separatrix (by {short:.2g} of its energy) that elliptic functions lose "
                "their digits: take flow.solve(...)",
                item="X0",
            )
        # Measured from the nearest lowest position.
        turns = np.round(theta0 / (2 * np.pi))
        sine, half_rate = np.sin(0.5 * (theta0 - 2 * np.pi * turns)), 0.5 * rate0
        k = np.sqrt(m)
        if m < 1.0:
            start = ellipkinc(np.arctan2(sine, half_rate), m)
            sn, cn, dn, _ = ellipj(self.omega * times + start, m)
            half = np.arctan2(k * sn, dn)
            return np.stack([2.0 * half + 2 * np.pi * turns, 2.0 * k * cn], axis=-1)
        direction = np.sign(rate0)
        start = ellipkinc(0.5 * direction * (theta0 - 2 * np.pi * turns), 1.0 / m)
        _, _, dn, am = ellipj(k * self.omega * times + start, 1.0 / m)
        return np.stack([direction * 2.0 * am + 2 * np.pi * turns, direction * 2.0 * k * dn], axis=-1)

    def stationary_point(self, k: int) -> FloatArray:
        """(k pi, 0), stable for even k (notes eqs. 58-61)."""
        return np.array([k * np.pi, 0.0])


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

    def great_circle(self, t: ArrayLike, x0: ArrayLike, v0: ArrayLike) -> FloatArray:
        """The free motion x(t), shape (3,) or (k, 3)."""
        x0, v0 = np.split(self._state(np.append(as_float_array(x0, "x0"), as_float_array(v0, "v0"))), 2)
        speed = float(np.linalg.norm(v0))
        if abs(np.linalg.norm(x0) - self.radius) > 1e-9 * self.radius:
            raise InputError(f"x0 is {np.linalg.norm(x0):.9g} from the center, not {self.radius:.9g}", item="x0")
        if abs(x0 @ v0) > 1e-9 * self.radius * speed:
            raise InputError("v0 leaves the sphere: give its part along it, v - x (x.v)/R^2", item="v0")
        angle = as_float_array(t, "t")[..., None] * speed / self.radius
        return np.asarray(np.cos(angle) * x0 + self.radius * np.sin(angle) * (v0 / speed if speed else v0))


class Compression(NamedTuple):
    """Phase volume on the surface of constant K, along a trajectory, at k times."""

    t: FloatArray
    #: Measured: ln of the volume spanned by the tangent vectors, carried along by the variational equation.
    log_volume: FloatArray
    #: -(g - 1) times the integral of alpha.
    predicted: FloatArray
    g: int


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

    @property
    def degrees_of_freedom(self) -> int:
        """g, before the thermostat takes its one."""
        return self.masses.size

    def state(self, x: ArrayLike, v: ArrayLike) -> FloatArray:
        """X of positions and velocities."""
        x, v = as_float_array(x, "x").ravel(), as_float_array(v, "v").ravel()
        if x.shape != self.masses.shape or v.shape != self.masses.shape:
            raise InputError(f"x and v have {self.masses.size} components each, as the masses", item="x")
        if not v @ (self.masses * v) > 1e-290:
            raise InputError("an isokinetic thermostat needs non-zero kinetic energy", item="v")
        return self._state(np.concatenate([self.root * x, self.root * v]))

    def positions(self, X: FloatArray) -> FloatArray:
        """x, shape (n,)."""
        return np.asarray(X[: self.masses.size] / self.root)

    def friction(self, X: ArrayLike) -> float:
        """alpha = v.f/(v^T M v) (notes eq. 113)."""
        X = as_float_array(X, "X")
        w = X[self.masses.size :]
        return float(w @ (self._force(self.positions(X)) / self.root) / (w @ w))

    def _force(self, x: FloatArray) -> FloatArray:
        return called("force", self.force, x.shape, x, scalar=True)

    def _field(self, t: float, X: FloatArray) -> FloatArray:
        w = X[self.masses.size :]
        return np.concatenate([w, self._force(self.positions(X)) / self.root - self.friction(X) * w])

    def compression(self, X0: ArrayLike, times: ArrayLike) -> Compression:
        """Measure the compression of phase space along a trajectory, and predict it from alpha."""
        X0, n, g = self._state(X0), self.masses.size, self.degrees_of_freedom
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
        return Compression(wanted, volumes, -(g - 1) * frictions, g)
