"""The Gaussian isokinetic flow and its phase-space compression (notes example 5).

    dx/dt = v,   dv/dt = f/m - alpha v,   alpha = v.f/(2K),   2K = v^T M v   (eq. 113)

On the surface of constant K (and of constant total momentum, where that is zero and conserved) g degrees of freedom
move, and the flow compresses phase space at the rate div V = -(g - 1) alpha.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import check_call, lent, numbers, whole_number
from kcons.errors import InputError
from kcons.models.flows.flow import FloatArray, Flow, phase_volume


class Compression(NamedTuple):
    """Phase volume on the surface of constant K, along a trajectory.

    Attributes
    ----------
    t : ndarray, shape (k,)
    log_volume : ndarray, shape (k,)
        Measured: ln of the volume spanned by the tangent vectors, carried along by the variational equation.
    predicted : ndarray, shape (k,)
        -(g - 1) times the integral of alpha.
    g : int
    """

    t: FloatArray
    log_volume: FloatArray
    predicted: FloatArray
    g: int


class Thermostat(Flow):
    """Particles at constant kinetic energy; X = (M^1/2 x, M^1/2 v), in which that surface is a sphere.

    Parameters
    ----------
    masses : array_like, shape (n,)
        One for each Cartesian component.
    force : callable (x) -> (n,)
    momentum_removed : int
        Number of directions in which the total momentum is zero and stays so (the forces sum to zero there): 0, or the
        dimension of space, the components running fastest. They do not count as degrees of freedom.

    Raises
    ------
    InputError
        Masses that are not positive.
    """

    def __init__(
        self, masses: ArrayLike, force: Callable[[FloatArray], ArrayLike], *, momentum_removed: int = 0
    ) -> None:
        m = numbers(masses, "masses").copy()
        if m.ndim != 1 or m.size < 2 or not np.all(np.isfinite(m) & (m > 0)):
            raise InputError("masses are positive, one for each of at least two Cartesian components", item="masses")
        check_call("force", force, ("x",))
        momentum_removed = whole_number(momentum_removed, "momentum_removed", 0)
        if momentum_removed and (m.size % momentum_removed or m.size == momentum_removed):
            raise InputError("the components do not divide into particles of this dimension", item="momentum_removed")
        self.masses, self.root = m, np.sqrt(m)
        self.force, self.removed = force, momentum_removed
        super().__init__(self._field, 2 * m.size)

    @property
    def degrees_of_freedom(self) -> int:
        """g, before the thermostat takes its one."""
        return self.masses.size - self.removed

    def state(self, x: ArrayLike, v: ArrayLike) -> FloatArray:
        """X of positions and velocities.

        Raises
        ------
        InputError
            Without kinetic energy, or with a total momentum although it was said to be removed.
        """
        x, v = numbers(x, "x").ravel(), numbers(v, "v").ravel()
        if x.shape != self.masses.shape or v.shape != self.masses.shape:
            raise InputError(f"x and v have {self.masses.size} components each, as the masses", item="x")
        if not v @ (self.masses * v) > 1e-290:
            raise InputError("an isokinetic thermostat needs non-zero kinetic energy", item="v")
        if self.removed:
            total = (self.masses * v).reshape(-1, self.removed).sum(axis=0)
            if np.max(np.abs(total)) > 1e-12 * np.sum(np.abs(self.masses * v)):
                raise InputError("the total momentum is not zero: subtract it from the start", item="v")
            pull = self._force(x).reshape(-1, self.removed)
            if np.max(np.abs(pull.sum(axis=0))) > 1e-9 * np.sum(np.abs(pull)):
                raise InputError("the forces do not sum to zero, as momentum_removed has it", item="momentum_removed")
        return self._state(np.concatenate([self.root * x, self.root * v]))

    def positions(self, X: FloatArray) -> FloatArray:
        """x, shape (n,)."""
        return np.asarray(X[: self.masses.size] / self.root)

    def friction(self, X: ArrayLike) -> float:
        """alpha = v.f/(v^T M v) (notes eq. 113)."""
        X = numbers(X, "X")
        w = X[self.masses.size :]
        return float(w @ (self._force(self.positions(X)) / self.root) / (w @ w))

    def _force(self, x: FloatArray) -> FloatArray:
        f = numbers(self.force(lent(x)), "force")
        if f.shape not in ((), x.shape):
            raise InputError(f"force returned shape {f.shape}, not {x.shape}", item="force")
        return np.broadcast_to(f, x.shape)

    def _field(self, t: float, X: FloatArray) -> FloatArray:
        w = X[self.masses.size :]
        return np.concatenate([w, self._force(self.positions(X)) / self.root - self.friction(X) * w])

    def tangents(self, X: FloatArray) -> FloatArray:
        """Orthonormal vectors along the surface of constant K and momentum, shape (2n, 2g - 1)."""
        n = self.masses.size
        fixed = np.zeros((n, 0))
        if self.removed:
            fixed = np.stack([self.root * (np.arange(n) % self.removed == k) for k in range(self.removed)], axis=1)
        places = _complement(fixed)
        speeds = _complement(np.column_stack([fixed, X[n:]]))
        T = np.zeros((2 * n, places.shape[1] + speeds.shape[1]))
        T[:n, : places.shape[1]], T[n:, places.shape[1] :] = places, speeds
        return T

    def surface_divergence(self, X: ArrayLike) -> float:
        """div V along the surface, tr(T^T dV/dX T); equal to -(g - 1) alpha."""
        T = self.tangents(self._state(X))
        return float(np.trace(T.T @ self.jacobian(0.0, X) @ T))

    def compression(self, X0: ArrayLike, times: ArrayLike, pieces: int = 1) -> Compression:
        """Measure the compression of phase space along a trajectory, and predict it from alpha."""
        X0 = self._state(X0)
        extended = Flow(lambda t, Y: np.append(self.velocity(t, Y[:-1]), self.friction(Y[:-1])), self.n + 1)
        wanted, pieces = np.atleast_1d(numbers(times, "times")), whole_number(pieces, "pieces")
        Y, volume, rows = np.append(X0, 0.0), 0.0, [(0.0, 0.0)]
        for a, b in pairwise(wanted):
            for c, d in pairwise(np.linspace(a, b, pieces + 1)):
                # The tangent vectors start anew as orthonormal ones: carried far, they would all turn into one.
                T = self.tangents(Y[:-1])
                found = phase_volume(extended, Y, [c, d])
                carried = found.propagators[-1, :-1, :-1] @ T
                volume += 0.5 * float(np.linalg.slogdet(carried.T @ carried)[1])
                Y = found.states[-1]
            rows.append((volume, float(Y[-1])))
        volumes, frictions = np.array(rows).T
        g = self.degrees_of_freedom
        return Compression(wanted, volumes, -(g - 1) * frictions, g)

    def exact_constant_force(self, t: float, x: ArrayLike, v: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """x(t), v(t) under a force that does not depend on x, in closed form.

        v(t) = (v + s f/m)/s', with s' = cosh(ct) + (a/c) sinh(ct), c^2 = f.M^-1 f/2K, a = v.f/2K. The positions follow
        from integral s/s' = (ln s' - a I)/c^2, I = integral 1/s'.
        """
        x, v = numbers(x, "x").ravel(), numbers(v, "v").ravel()
        f = self._force(x)
        two_K = float(v @ (self.masses * v))
        a, c = float(v @ f) / two_K, float(np.sqrt(f @ (f / self.masses) / two_K))
        if c == 0.0:
            return x + t * v, v
        # Divided by e^(ct), nothing overflows; 1 + a/c and 1 - a/c as they are.
        r, decay = a / c, np.exp(-2 * c * t)
        slope = 0.5 * ((1 + r) + (1 - r) * decay)
        s = (0.5 * (1 + r) - 0.5 * (1 - r) * decay - r * np.exp(-c * t)) / c
        velocity = (v * np.exp(-c * t) + s * f / self.masses) / slope
        log_slope = np.log(slope) + c * t
        # I = integral of 1/(cosh + r sinh): 2 atan(...) of it, in a form that holds for |r| = 1 as well.
        half = np.tanh(0.5 * c * t)
        root = np.sqrt(max(1.0 - r * r, 0.0))
        angle = 2 * half / (1 + r * half)
        I = angle / c if root < 1e-8 else 2 * np.arctan(root * half / (1 + r * half)) / (root * c)
        return x + v * I + (log_slope - a * I) / c**2 * f / self.masses, velocity


def _complement(vectors: FloatArray) -> FloatArray:
    """Orthonormal basis of what is orthogonal to the columns, shape (n, n - k)."""
    n, k = vectors.shape
    if k == 0:
        return np.eye(n)
    full, _ = np.linalg.qr(vectors, mode="complete")
    return np.asarray(full[:, k:])
