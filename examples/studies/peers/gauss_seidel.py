"""SHAKE and RATTLE as the literature has them: one constraint after another, in sweeps, until all are fulfilled.

Written here from the papers and compiled, so that the comparison is with the algorithm and not with an interpreter.
Distances only, without periodic images; each molecule has to be whole.

References
----------
Ryckaert, Ciccotti and Berendsen, J. Comput. Phys. 23, 327 (1977); Andersen, J. Comput. Phys. 52, 24 (1983).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.compilation import njit
from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, InputError

#: Sweeps before giving up. GROMACS and ASE allow 1000 and 500; long chains need more.
MANY_SWEEPS = 20_000
#: A molecule that is stretched by more than this at the start is not whole.
TORN = 0.01


class GaussSeidel:
    """Distances held by sweeps.

    Parameters
    ----------
    pairs : array_like of int, shape (n, 2)
    masses : array_like, shape (n_atoms,)
        Infinite for atoms that do not move.
    positions : array_like, shape (n_atoms, 3)
        Where the lengths are taken from.
    tolerance : float
        Largest |r^2 - d^2|/(2 d^2), and largest change of that a step that velocities may lead to.
    lengths : array_like, shape (n,), optional

    Raises
    ------
    InputError
        Given lengths differ from the distances found by more than a hundredth.
    """

    def __init__(
        self,
        pairs: ArrayLike,
        masses: ArrayLike,
        positions: ArrayLike,
        tolerance: float,
        lengths: ArrayLike | None = None,
    ) -> None:
        x = np.asarray(positions, dtype=float)
        self.pairs: IntArray = np.ascontiguousarray(pairs, dtype=np.int32)
        self.inverse_masses = 1.0 / np.asarray(masses, dtype=float)
        found = np.linalg.norm(x[self.pairs[:, 0]] - x[self.pairs[:, 1]], axis=1)
        wanted = found if lengths is None else np.broadcast_to(np.asarray(lengths, dtype=float), found.shape)
        off = np.abs(found / wanted - 1.0)
        if len(off) and off.max() > TORN:
            row = int(np.argmax(off))
            raise InputError(
                f"atoms {self.pairs[row].tolist()} are {found[row]:.4g} apart and to be held at {wanted[row]:.4g}; "
                "molecules have to be whole here",
                atoms=self.pairs[row].tolist(),
            )
        self.squares: FloatArray = wanted**2
        self.tolerance = float(tolerance)
        self.sweeps = 0
        self._old = np.empty((len(self.pairs), 3))

    def positions(self, x: FloatArray, reference: FloatArray, velocities: FloatArray, dt: float) -> None:
        """Bring x onto the constraints along the bonds of `reference`, in place, and change velocities by dx/dt.

        Raises
        ------
        ConvergenceError
        """
        sweeps = shake(
            x, reference, velocities, 1.0 / dt, self.pairs, self.squares, self.inverse_masses, self._old,
            self.tolerance, MANY_SWEEPS,
        )  # fmt: skip
        self._check(sweeps, "SHAKE")

    def velocities(self, x: FloatArray, velocities: FloatArray, dt: float) -> None:
        """Take the components along the bonds out of the velocities, in place.

        Raises
        ------
        ConvergenceError
        """
        sweeps = rattle(
            x, velocities, dt, self.pairs, self.squares, self.inverse_masses, self._old, self.tolerance, MANY_SWEEPS
        )
        self._check(sweeps, "RATTLE")

    def march(
        self,
        x: FloatArray,
        velocities: FloatArray,
        forces: FloatArray,
        dt: float,
        steps: int,
        force: Callable[[FloatArray], FloatArray],
        old: FloatArray,
    ) -> FloatArray:
        """Steps of velocity Verlet in place, two compiled calls and one for the forces each; the last forces.

        Parameters
        ----------
        x, velocities : ndarray, shape (n_atoms, 3)
            Change.
        forces : ndarray, shape (n_atoms, 3)
            At `x`.
        dt : float
        steps : int
        force : callable
            Forces at given positions.
        old : ndarray, shape (n_atoms, 3)
            Room to work in.

        Raises
        ------
        ConvergenceError
            The sweeps do not converge; `x` and `velocities` are then those of the middle of a step.
        """
        pairs, squares, w, bonds, tolerance = (
            self.pairs, self.squares, self.inverse_masses, self._old, self.tolerance,
        )  # fmt: skip
        f = forces
        for _ in range(steps):
            sweeps = first_half(x, velocities, f, w, dt, old, pairs, squares, bonds, tolerance, MANY_SWEEPS)
            if sweeps < 0:
                self._check(sweeps, "SHAKE")
            f = force(x)
            sweeps = second_half(x, velocities, f, w, dt, pairs, squares, bonds, tolerance, MANY_SWEEPS)
            if sweeps < 0:
                self._check(sweeps, "RATTLE")
        return f

    def _check(self, sweeps: int, what: str) -> None:
        self.sweeps = abs(sweeps)
        if sweeps < 0:
            raise ConvergenceError(
                f"{what} did not converge to {self.tolerance:g} in {-sweeps} sweeps",
                tolerance=self.tolerance,
                iterations=-sweeps,
            )


@njit(cache=True, nogil=True)
def shake(x, reference, v, inv_dt, pairs, squares, w, old, tolerance, most):  # type: ignore[no-untyped-def]
    """Sweeps done; their negative where they did not converge."""
    n = len(pairs)
    for k in range(n):
        i, j = pairs[k, 0], pairs[k, 1]
        for axis in range(3):
            old[k, axis] = reference[i, axis] - reference[j, axis]
    for sweep in range(1, most + 1):
        done = True
        for k in range(n):
            i, j = pairs[k, 0], pairs[k, 1]
            p0, p1, p2 = x[i, 0] - x[j, 0], x[i, 1] - x[j, 1], x[i, 2] - x[j, 2]
            off = squares[k] - (p0 * p0 + p1 * p1 + p2 * p2)
            # Turned round, so that NaN does not pass.
            if not (abs(off) <= 2.0 * tolerance * squares[k]):
                done = False
                along = old[k, 0] * p0 + old[k, 1] * p1 + old[k, 2] * p2
                if not (along > 1e-6 * squares[k]):
                    return -sweep
                g = off / (2.0 * (w[i] + w[j]) * along)
                gi, gj = g * w[i], g * w[j]
                for axis in range(3):
                    x[i, axis] += gi * old[k, axis]
                    x[j, axis] -= gj * old[k, axis]
                    v[i, axis] += inv_dt * gi * old[k, axis]
                    v[j, axis] -= inv_dt * gj * old[k, axis]
        if done:
            return sweep
    return -most


@njit(cache=True, nogil=True)
def rattle(x, v, dt, pairs, squares, w, old, tolerance, most):  # type: ignore[no-untyped-def]
    """Sweeps done; their negative where they did not converge."""
    n = len(pairs)
    for k in range(n):
        i, j = pairs[k, 0], pairs[k, 1]
        for axis in range(3):
            old[k, axis] = x[i, axis] - x[j, axis]
    for sweep in range(1, most + 1):
        done = True
        for k in range(n):
            i, j = pairs[k, 0], pairs[k, 1]
            b0, b1, b2 = old[k, 0], old[k, 1], old[k, 2]
            rate = b0 * (v[i, 0] - v[j, 0]) + b1 * (v[i, 1] - v[j, 1]) + b2 * (v[i, 2] - v[j, 2])
            if not (abs(rate) * dt <= tolerance * squares[k]):
                done = False
                if not np.isfinite(rate):
                    return -sweep
                g = -rate / ((w[i] + w[j]) * squares[k])
                for axis in range(3):
                    v[i, axis] += g * w[i] * old[k, axis]
                    v[j, axis] -= g * w[j] * old[k, axis]
        if done:
            return sweep
    return -most


@njit(cache=True, nogil=True)
def kick_and_drift(x, v, f, w, dt, old):  # type: ignore[no-untyped-def]
    """The first half of velocity Verlet in place; where x was goes into `old`."""
    for i in range(x.shape[0]):
        for axis in range(3):
            old[i, axis] = x[i, axis]
            v[i, axis] += 0.5 * dt * w[i] * f[i, axis]
            x[i, axis] += dt * v[i, axis]


@njit(cache=True, nogil=True)
def kick(v, f, w, dt):  # type: ignore[no-untyped-def]
    """v + dt/2 M^-1 f in place."""
    for i in range(v.shape[0]):
        for axis in range(3):
            v[i, axis] += 0.5 * dt * w[i] * f[i, axis]


@njit(cache=True, nogil=True)
def first_half(x, v, f, w, dt, old, pairs, squares, bonds, tolerance, most):  # type: ignore[no-untyped-def]
    """A step up to the new positions; sweeps as `shake` counts them."""
    kick_and_drift(x, v, f, w, dt, old)
    return shake(x, old, v, 1.0 / dt, pairs, squares, w, bonds, tolerance, most)


@njit(cache=True, nogil=True)
def second_half(x, v, f, w, dt, pairs, squares, bonds, tolerance, most):  # type: ignore[no-untyped-def]
    """The rest of a step; sweeps as `rattle` counts them."""
    kick(v, f, w, dt)
    return rattle(x, v, dt, pairs, squares, w, bonds, tolerance, most)
