"""Mechanical systems in any coordinates q: a full mass matrix, and constraints g(q) = 0.

M(q) q'' = f(q, q', t) + G^T lambda,  g(q) = 0,  G = dg/dq

as multibody problems are published. Accelerations obey G q'' = b, b = -(q' d/dq)^2 g. With N an orthonormal basis of
the null space of G and G a_0 = b they are a_0 + N y, (N^T M N) y = N^T (f - M a_0). So M need not be regular, only
positive along what the constraints leave free, and rows may depend on each other. Corrections of positions and
velocities are the smallest in the metric of M by the same formula, with f = 0.

References
----------
Bott & Duffin, Trans. AMS 74, 99 (1953). Hairer & Wanner, Solving Ordinary Differential Equations II, VII.1 and VII.2
(index reduction and projection). Mazzia & Magherini, Test Set for Initial Value Problem Solvers, release 2.4 (2008).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import lapack

from kcons.constraints.arguments import FloatArray, IntArray, as_float_array, check_call, positive, read_only_view
from kcons.constraints.target import WRONG, first_derivative_4, second_derivative
from kcons.errors import ConstraintError, ConvergenceError, InputError, NonFiniteError, SingularGeometryError
from kcons.models.integration import called, check_derivative, check_run, integrate

#: Rows of G, of unit length, depend on others where no more than this part of them is left beside these.
DEPENDENT = 1e-10
#: N^T M N is taken for singular where elimination leaves no more than this part of a diagonal element.
MASSLESS = 1e-13
#: A start may be off the constraints by so much of its size; what is left after a projection, by so much.
START, ACCEPTED = 1e-6, 1e-9
ITERATIONS = 50
_EPS = float(np.finfo(float).eps)


class MultibodySolution(NamedTuple):
    """A motion, on the constraints to rounding; q, v and accelerations at k times have shape (k, n)."""

    t: FloatArray
    q: FloatArray
    v: FloatArray
    accelerations: FloatArray
    #: lambda of M q'' = f + G^T lambda, shape (k, m).
    multipliers: FloatArray
    #: Of the accelerations, to integrate.
    evaluations: int


class _Place(NamedTuple):
    """M and G at one place, and their factors.

    `rows` are independent and span all: G[rows] = size[rows] R^T Q^T; N spans their null space, N^T M N = W^T W.
    """

    t: float
    q: FloatArray
    M: FloatArray
    G: FloatArray
    size: FloatArray
    rows: IntArray
    Q: FloatArray
    R: FloatArray
    N: FloatArray
    W: FloatArray

    def solve(self, f: FloatArray, b: FloatArray) -> FloatArray:
        """a with G a = b and N^T (M a - f) = 0."""
        a: FloatArray = np.zeros(len(f))
        if len(self.rows):
            a = self.Q @ lapack.dtrtrs(self.R, (b / self.size)[self.rows], trans=1)[0]
        if self.N.shape[1]:
            a = a + self.N @ lapack.dpotrs(self.W, self.N.T @ (f - self.M @ a))[0]
        return a

    def multipliers(self, z: FloatArray) -> FloatArray:
        """lambda with G^T lambda = z; of least norm where rows depend."""
        basis, triangle = np.linalg.qr(self.G @ self.Q)  # of the range of G
        return np.asarray(basis @ np.linalg.solve(triangle.T, self.Q.T @ z))


class Multibody:
    """M(q) q'' = f(q, q', t) + G^T lambda, g(q) = 0, in any coordinates.

    Parameters
    ----------
    mass : array_like, shape (n,) or (n, n), or callable
        Diagonal, or matrix; or ``mass(q) -> (n, n)``. Symmetric, and positive along what the constraints leave free.
    force : callable
        ``force(q, v, t) -> (n,)``, all that stands beside M q'': applied forces and the terms in the velocities
        (Coriolis, centrifugal) that come with a mass that changes with q.
    constraints : callable, optional
        ``constraints(q) -> (m,)``, held at 0.
    jacobian : callable, optional
        ``jacobian(q) -> (m, n)``, G. Without it g is differenced (12 digits).
    curvature : callable, optional
        ``curvature(q, v) -> (m,)``, v^T (d2g/dq2) v. Without it G, or g, is differenced along v (12 digits, or 10).
    length : float
        Change of the coordinates over which g bends; differences are taken at a small part of it.

    Notes
    -----
    Many publish M q'' = f - G^T lambda: their multipliers have the opposite sign.
    """

    def __init__(
        self,
        mass: ArrayLike | Callable[..., ArrayLike],
        force: Callable[..., ArrayLike],
        constraints: Callable[..., ArrayLike] | None = None,
        jacobian: Callable[..., ArrayLike] | None = None,
        *,
        curvature: Callable[..., ArrayLike] | None = None,
        length: float = 1.0,
    ) -> None:
        self.force, self.constraints, self.jacobian, self.curvature = force, constraints, jacobian, curvature
        self.length = positive(length, "length")
        check_call("force", force, ("q", "v", "t"), needed=True)
        for name, taken in (("constraints", ("q",)), ("jacobian", ("q",)), ("curvature", ("q", "v"))):
            check_call(name, getattr(self, name), taken)
            if constraints is None and getattr(self, name) is not None:
                raise InputError(f"there is a {name} without constraints; give the function g as well", item=name)
        #: Number of constraints, None until it is seen.
        self.m: int | None = 0 if constraints is None else None
        if callable(mass):
            check_call("mass", mass, ("q",))
            self.mass: FloatArray | Callable[..., ArrayLike] = mass
        else:
            matrix = np.array(as_float_array(mass, "mass"))
            self.mass = np.diag(matrix) if matrix.ndim == 1 else matrix
            _check_symmetric(self.mass)

    def degrees_of_freedom(self, q: ArrayLike) -> int:
        """n - rank G at `q`."""
        q, _ = self._state(q, q)
        return len(q) - len(self._place(q, 0.0, None).rows)

    def motion(self, q: ArrayLike, v: ArrayLike, t: float = 0.0) -> tuple[FloatArray, FloatArray]:
        """Accelerations, shape (n,), and multipliers, shape (m,), at a state on the constraints."""
        q, v = self._state(q, v)
        return self._motion(self._place(q, t, None), v)

    def _motion(self, place: _Place, v: FloatArray) -> tuple[FloatArray, FloatArray]:
        f = self._called("force", (len(v),), place.q, v, place.t)
        a = place.solve(f, self._b(place.q, v))
        return a, place.multipliers(place.M @ a - f)

    def project(self, q: ArrayLike, v: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """The state on the constraints near (q, v): corrections are the smallest in the metric of M.

        Raises
        ------
        ConvergenceError
            No positions near `q` are on the constraints.
        """
        q, v = self._state(q, v)
        place = self._placed(q, 0.0, None)
        return place.q, self._tangent(place, v)

    def solve(
        self,
        q: ArrayLike,
        v: ArrayLike,
        t_span: Sequence[float],
        t_eval: ArrayLike | None = None,
        *,
        method: str = "DOP853",
        rtol: float = 1e-9,
        atol: ArrayLike = 1e-11,
        **options: Any,
    ) -> MultibodySolution:
        """Integrate; after each step positions and velocities are put back on the constraints, to rounding.

        Parameters
        ----------
        q, v : array_like, shape (n,)
            Start, on the constraints; see `project`.
        t_span : pair of float
            Start and end; the end may be earlier.
        t_eval : array_like, optional
            Times of the result, by default the ends of the steps; between them it is on the constraints as well.
        method, rtol, atol, options
            As in ``solve_ivp``, but LSODA, for (q, v); 'Radau' or 'BDF' serve stiff forces.

        Raises
        ------
        ConstraintError
            The start is off the constraints, or its velocities are.
        ConvergenceError
            Steps became too small, or no positions were found on the constraints; says when.
        SingularGeometryError
            M is not positive along what the constraints leave free, or constraints become dependent on the way.
        NonFiniteError
            A function gave a NaN or infinity.
        """
        options |= {"rtol": rtol, "atol": atol}
        solver, (t0, t1), wanted = check_run(t_span, t_eval, method, options, 2 * np.size(q))
        q, v = self._state(q, v)
        place = self._start(q, v, t0)
        n, rank = len(q), len(place.rows)

        def project(t: float, y: FloatArray) -> FloatArray:
            nonlocal place
            place = self._placed(y[:n], t, rank)
            return np.concatenate([place.q, self._tangent(place, y[n:])])

        def slope(t: float, y: FloatArray) -> FloatArray:
            q, v = y[:n], y[n:]
            here = place if place.t == t and np.array_equal(place.q, q) else self._place(q, t, rank)
            return np.concatenate([v, here.solve(self._called("force", (n,), q, v, t), self._b(q, v))])

        start = project(t0, np.concatenate([q, v]))
        ode = integrate(slope, (t0, t1), start, solver, project, t_eval=wanted, **options)
        if ode.status < 0:
            raise ConvergenceError(
                f"the run ended at t = {place.t:.8g}: {ode.message} Stiff forces: method='Radau'; forces "
                "that jump: end the run there; or a larger tolerance"
            )
        q, v = np.split(np.reshape(ode.y, (2 * n, -1)).T, 2, axis=1)
        a, multipliers = np.zeros((len(q), n)), np.zeros((len(q), self.m or 0))
        for k, (t, x, w) in enumerate(zip(ode.t, q, v, strict=True)):
            a[k], multipliers[k] = self._motion(self._place(x, t, rank), w)
        return MultibodySolution(np.asarray(ode.t), q, v, a, multipliers, ode.nfev)

    def _place(self, q: FloatArray, t: float, rank: int | None) -> _Place:
        """Factors at `q`, with so many independent rows, by default as many as there are."""
        n = len(q)
        M, G = self._M(q), self._G(q)
        size = np.sqrt(np.einsum("ij,ij->i", G, G))
        size[size == 0] = 1.0
        Q, R, rows = _factors(G / size[:, None])
        left = np.abs(R.diagonal())
        if rank is None or (rank and not left[rank - 1] > DEPENDENT * left[0]):
            found = int(np.sum(left > DEPENDENT * left[:1]))
            if rank is not None:
                raise SingularGeometryError(
                    f"at t = {t:.8g} only {found} constraints are independent, and {rank} at the start: a singular "
                    f"place of the mechanism, q = {_shown(q)}. End the run before, or hold it by other constraints"
                )
            rank = found
        N = Q[:, rank:]
        S = N.T @ M @ N
        W, info = lapack.dpotrf(S) if rank < n else (S, 0)
        if info or (W.diagonal() ** 2 <= MASSLESS * S.diagonal()).any():
            raise SingularGeometryError(
                f"at t = {t:.8g}, q = {_shown(q)} the mass matrix is not positive along what the {rank} independent "
                "constraints leave free: give the coordinates that move there a mass, or hold them"
            )
        return _Place(t, q, M, G, size, rows[:rank], Q[:, :rank], R[:rank, :rank], N, W)

    def _start(self, q: FloatArray, v: FloatArray, t: float) -> _Place:
        """The place of a start; refused where that is off the constraints."""
        place = self._place(q, t, None)
        gained = np.sqrt(_largest(self._motion(place, v)[0]) * self.length)
        for miss, allowed, what in (
            (self._g(q), max(self.length, _largest(q)), "off"),
            (place.G @ v, _largest(v) + gained, "left by the velocities, per unit of time,"),
        ):
            off = np.abs(miss) / place.size
            if np.any(off > START * allowed):
                row = int(np.argmax(off))
                raise ConstraintError(
                    f"constraint {row} is {what} by {off[row]:.3g} at the start. Start from body.project(q, v), "
                    "which gives the nearest state on the constraints",
                    rows=[row],
                )
        return self._placed(q, t, None)

    def _placed(self, q: FloatArray, t: float, rank: int | None) -> _Place:
        """The place on the constraints near `q`, by Newton's method down to rounding."""
        place, g = self._place(q, t, rank), self._g(q)
        off = _largest(g / place.size)
        accepted = ACCEPTED * max(self.length, _largest(q))
        for _ in range(ITERATIONS):
            if np.all(np.abs(g) <= 2 * _EPS * (np.abs(place.G) @ np.abs(place.q))):
                break
            step = place.solve(np.zeros(len(q)), -g)
            moved = place.q + step
            there = self._g(moved)
            left = _largest(there / place.size)
            if left >= 0.5 * off:
                break
            place, g, off = self._place(moved, t, rank), there, left
        if not off <= accepted:
            row = int(np.argmax(np.abs(g / place.size)))
            raise ConvergenceError(
                f"no positions on the constraints were found near q = {_shown(q)} at t = {t:.8g}: constraint {row} "
                f"stays off by {off:.3g}. Start nearer, take smaller steps (rtol, max_step), or see whether the "
                "constraints can be met together",
                residual=off,
                tolerance=accepted,
                row=row,
            )
        return place

    def _tangent(self, place: _Place, v: FloatArray) -> FloatArray:
        """The nearest velocities that stay on the constraints."""
        for _ in range(2):  # the second time for what rounding left
            v = v - place.solve(np.zeros(len(v)), place.G @ v)
        return v

    # -- what the user gave: called, differenced where derivatives are missing, and checked ----------------

    def _called(self, name: str, shape: tuple[int, ...], *arguments: Any) -> FloatArray:
        """What a function of the user returned, of that shape and finite; a copy."""
        array = np.array(called(name, getattr(self, name), shape, *arguments, scalar=shape == (1,)))
        if not np.isfinite(array).all():
            entry = np.argwhere(~np.isfinite(array))[0].tolist()
            raise NonFiniteError(
                f"{name} is not finite at q = {_shown(arguments[0])}: entry {entry}; mend the function, or keep the "
                "motion away from there",
                item=name,
            )
        return array

    def _M(self, q: FloatArray) -> FloatArray:
        return self.mass if isinstance(self.mass, np.ndarray) else self._called("mass", (len(q), len(q)), q)

    def _g(self, q: FloatArray) -> FloatArray:
        return self._called("constraints", (self.m,), q) if self.m else np.zeros(0)

    def _G(self, q: FloatArray) -> FloatArray:
        if self.m and self.jacobian is not None:
            return self._called("jacobian", (self.m, len(q)), q)

        def along(e: FloatArray) -> FloatArray:
            return first_derivative_4(lambda s: self._g(q + s * e), 0.0, 1e-3 * self.length)

        return np.stack([along(e) for e in np.eye(len(q))], axis=1)

    def _b(self, q: FloatArray, v: FloatArray) -> FloatArray:
        """What G a must be, shape (m,)."""
        if self.m and self.curvature is not None:
            return -self._called("curvature", (self.m,), q, v)
        speed = _largest(v) / self.length
        if not self.m or speed == 0.0:
            return np.zeros(self.m or 0)
        if self.jacobian is not None:
            return -first_derivative_4(lambda s: self._G(q + s * v) @ v, 0.0, 1e-3 / speed)
        return -second_derivative(lambda s: self._g(q + s * v), 0.0, 0.02 / speed)

    def _state(self, q: ArrayLike, v: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """A state as arrays, after all functions were seen to fit it."""
        place, speed = (np.array(as_float_array(given, item)) for item, given in (("q", q), ("v", v)))
        n = place.size if callable(self.mass) else len(self.mass)
        for item, array in (("q", place), ("v", speed)):
            if array.shape != (n,) or n == 0 or not np.isfinite(array).all():
                raise InputError(
                    f"{item} is {_shown(array)}; give a finite number for each coordinate, shape ({n},)", item=item
                )
        self._check_functions(place)
        return place, speed

    def _check_functions(self, q: FloatArray) -> None:
        """Count the constraints; refuse derivatives that differences contradict, which would give wrong motion."""
        if callable(self.mass):
            _check_symmetric(self._M(q))
        if self.constraints is None:
            return
        self.m = as_float_array(self.constraints(read_only_view(q)), "constraints").size
        along = self.length * np.random.default_rng(0).normal(size=len(q))
        bare, half = copy(self), copy(self)
        bare.jacobian = bare.curvature = half.jacobian = half.curvature = None
        half.length = 0.5 * self.length
        own, found, finer = ((body._G(q), -body._b(q, along)) for body in (self, bare, half))
        bent = WRONG * self.length * _largest(found[0])
        for k, (name, rounding) in enumerate((("jacobian", 0.0), ("curvature", bent))):
            given = getattr(self, name) is not None
            of, fine = ("the constraints (see `length`)", found) if given else ("what is held (see `length`)", finer)
            check_derivative(name, of, own[k] if given else None, found[k], fine[k], rounding=rounding)


def _factors(A: FloatArray) -> tuple[FloatArray, FloatArray, IntArray]:
    """Q, shape (n, n), and R of A^T with its columns exchanged, and their order: QR in two calls of LAPACK."""
    m, n = A.shape
    if m == 0:
        return np.eye(n), np.zeros((0, 0)), np.zeros(0, dtype=np.int64)
    R, order, tau, _, _ = lapack.dgeqp3(A.T)
    k = min(m, n)
    Q = np.zeros((n, n), order="F")
    Q[:, :k] = R[:, :k]
    return lapack.dorgqr(Q, tau)[0], R[:k], order - 1


def _check_symmetric(M: FloatArray) -> None:
    if M.ndim != 2 or len(M) != M.shape[-1] or len(M) == 0:
        raise InputError(f"mass has shape {M.shape}; give a diagonal (n,) or a matrix (n, n)", item="mass")
    if not np.isfinite(M).all():
        raise InputError(f"mass is not finite in row {int(np.argmin(np.isfinite(M).all(axis=1)))}", item="mass")
    off = np.abs(M - M.T)
    i, j = np.unravel_index(int(np.argmax(off)), off.shape)
    if off[i, j] > 1e-10 * np.abs(M).max():
        raise InputError(
            f"mass is not symmetric: {M[i, j]:.6g} at [{i}, {j}] and {M[j, i]:.6g} at [{j}, {i}]; both are needed",
            item="mass",
        )


def _largest(values: FloatArray) -> float:
    return float(np.max(np.abs(values), initial=0.0))


def _shown(q: FloatArray) -> str:
    return np.array2string(q, precision=6, threshold=8)
