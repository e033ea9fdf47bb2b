"""Mechanical systems in any coordinates q: a full mass matrix, and constraints g(q, t) = 0.

M(q) q'' = f(q, q', t) + G^T lambda,  g(q, t) = 0,  G = dg/dq

as multibody problems and the test sets for differential-algebraic equations are published. Accelerations obey
G q'' = b, b = -(q' d/dq + d/dt)^2 g. With N an orthonormal basis of the null space of G and a_0 any solution of
G a_0 = b, they are a_0 + N y, (N^T M N) y = N^T (f - M a_0). So M need not be regular, only positive along what the
constraints leave free, and rows may depend on each other. Corrections of positions and velocities are the smallest
in the metric of M by the same formula, with f = 0.

References
----------
Bott & Duffin, Trans. AMS 74, 99 (1953). Hairer & Wanner, Solving Ordinary Differential Equations II, VII.1 and VII.2
(index reduction and projection). Mazzia & Magherini, Test Set for Initial Value Problem Solvers, release 2.4 (2008).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp
from scipy.linalg import lapack

from kcons.constraints.arguments import FloatArray, IntArray, lent
from kcons.errors import (
    ConstraintError,
    ContradictionError,
    ConvergenceError,
    NonFiniteError,
    SingularGeometryError,
)
from kcons.models.integration import check_run, projecting
from kcons.models.multibody_functions import MultibodyFunctions, largest, shown

#: Rows of G, of unit length, depend on others where no more than this part of them is left beside these.
DEPENDENT = 1e-10
#: N^T M N is taken for singular where elimination leaves no more than this part of a diagonal element.
MASSLESS = 1e-13
#: A start may be off the constraints by so much of its size; what is left after a projection, by so much.
START, ACCEPTED = 1e-6, 1e-9
ITERATIONS = 50
#: Parts of a step of Newton's method that are tried far from the constraints.
PARTS = tuple(0.5**k for k in range(8))
_EPS = float(np.finfo(float).eps)


class MultibodySolution(NamedTuple):
    """A motion, on the constraints to rounding.

    Attributes
    ----------
    t : ndarray, shape (k,)
    q, v, accelerations : ndarray, shape (k, n)
    multipliers : ndarray, shape (k, m)
        lambda of M q'' = f + G^T lambda.
    evaluations, steps : int
        Evaluations of the accelerations, and steps, that were taken to integrate.
    """

    t: FloatArray
    q: FloatArray
    v: FloatArray
    accelerations: FloatArray
    multipliers: FloatArray
    evaluations: int
    steps: int


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


class Multibody(MultibodyFunctions):
    """M(q) q'' = f(q, q', t) + G^T lambda, g(q, t) = 0, in any coordinates.

    Parameters
    ----------
    mass : array_like, shape (n,) or (n, n), or callable
        Diagonal, or matrix; or ``mass(q) -> (n, n)``. Symmetric, and positive along what the constraints leave free.
    force : callable
        ``force(q, v, t) -> (n,)``, all that stands beside M q'': applied forces and the terms in the velocities
        (Coriolis, centrifugal) that come with a mass that changes with q.
    constraints : callable, optional
        ``constraints(q) -> (m,)``, held at 0; with `time_dependent`, ``(q, t)``.
    jacobian : callable, optional
        ``jacobian(q) -> (m, n)``, G; with `time_dependent`, ``(q, t)``. Without it g is differenced (12 digits).
    curvature : callable, optional
        ``curvature(q, v) -> (m,)``, v^T (d2g/dq2) v; with `time_dependent`, ``(q, v, t)`` and with
        2 (d2g/dq dt) v + d2g/dt2 added. Without it G, or g, is differenced along v (12 digits, or 10).
    time_dependent : bool
        Whether constraints take the time as their last argument.
    length : float
        Change of the coordinates over which g bends; differences are taken at a small part of it.
    time_step : float
        Step of differences in time: about 1/50 of the time over which g changes.

    Raises
    ------
    InputError
        What is neither array nor function; a mass that is not symmetric or not finite.

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
        time_dependent: bool = False,
        length: float = 1.0,
        time_step: float = 0.02,
    ) -> None:
        super().__init__(mass, force, constraints, jacobian, curvature, time_dependent, length, time_step)

    def degrees_of_freedom(self, q: ArrayLike, t: float = 0.0) -> int:
        """n - rank G at `q`."""
        q, _ = self._state(q, q, t)
        return len(q) - len(self._place(q, t, None).rows)

    def residuals(self, q: ArrayLike, v: ArrayLike, t: float = 0.0) -> tuple[FloatArray, FloatArray]:
        """g and its time derivative G v + dg/dt, shape (m,) each, in the units that g has."""
        q, v = self._state(q, v, t)
        return self._g(q, t), self._G(q, t) @ v - self._c(q, t)

    def motion(self, q: ArrayLike, v: ArrayLike, t: float = 0.0) -> tuple[FloatArray, FloatArray]:
        """Accelerations, shape (n,), and multipliers, shape (m,), at a state on the constraints."""
        q, v = self._state(q, v, t)
        return self._motion(self._place(q, t, None), v)

    def _motion(self, place: _Place, v: FloatArray) -> tuple[FloatArray, FloatArray]:
        f = self._called("force", (len(v),), place.q, v, place.t)
        a = place.solve(f, self._b(place.q, v, place.t))
        return a, place.multipliers(place.M @ a - f)

    def project(self, q: ArrayLike, v: ArrayLike, t: float = 0.0) -> tuple[FloatArray, FloatArray]:
        """The state on the constraints near (q, v): corrections are the smallest in the metric of M.

        Raises
        ------
        ConvergenceError
            No positions near `q` are on the constraints.
        ContradictionError
            Dependent rows ask for different velocities.
        """
        q, v = self._state(q, v, t)
        place = self._placed(q, t, None)
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
            Times of the result, by the interpolant of the method, also on the constraints; by default the ends of the
            steps.
        method : str
            'DOP853', 'RK45', 'RK23', or 'Radau' or 'BDF' for stiff forces, of SciPy.
        rtol, atol : float
            Allowed error of a step, of (q, v); `atol` may have shape (2n,).
        options
            max_step, first_step, and what else the method takes.

        Raises
        ------
        InputError
            Wrong shapes, numbers that are not finite, a Jacobian that contradicts the constraints.
        ConstraintError
            The start is off the constraints, or its velocities are.
        ConvergenceError
            Steps became too small, or no positions were found on the constraints; says when.
        ContradictionError
            As `project`.
        SingularGeometryError
            M is not positive along what the constraints leave free, or constraints become dependent on the way.
        NonFiniteError
            A function gave a NaN or infinity.
        """
        solver, (t0, t1), wanted = check_run(
            t_span, t_eval, method, options | {"rtol": rtol, "atol": atol}, 2 * np.size(q)
        )
        q, v = self._state(q, v, t0)
        n, rank = len(q), len(self._start(q, v, t0).rows)
        latest: dict[str, Any] = {}

        def project(t: float, y: FloatArray) -> FloatArray:
            latest["place"] = place = self._placed(lent(y[:n]), t, rank)
            latest["error"] = None
            return np.concatenate([place.q, self._tangent(place, y[n:])])

        def slope(t: float, y: FloatArray) -> FloatArray:
            place = latest["place"]
            q, v = lent(y[:n]), lent(y[n:])
            if not np.isfinite(y).all():
                return np.full(2 * n, np.nan)
            try:
                if place.t != t or not np.array_equal(place.q, q):
                    place = self._place(q, t, rank)
                f = self._called("force", (n,), q, v, t)
                return np.concatenate([v, place.solve(f, self._b(q, v, t))])
            except (NonFiniteError, SingularGeometryError) as error:
                # A trial step may go too far, and is then made shorter; what is left is told if the run ends here.
                latest["error"] = error
                return np.full(2 * n, np.nan)

        def counted(t: float, y: FloatArray) -> FloatArray:
            latest["steps"] += 1
            return project(t, y)

        start = project(t0, np.concatenate([q, v]))
        self._motion(latest["place"], lent(start[n:]))  # what is wrong at the start is told at once
        latest["steps"] = 0
        stepper = projecting(solver, counted)
        ode = solve_ivp(slope, (t0, t1), start, stepper, wanted, rtol=rtol, atol=atol, **options)
        if ode.status < 0:
            raise latest["error"] or ConvergenceError(
                f"the run ended at t = {latest['place'].t:.8g}: {ode.message} Stiff forces: method='Radau'; forces "
                "that jump: end the run there; or a larger tolerance"
            )
        states, motions = [], []
        for t, y in zip(ode.t, np.transpose(ode.y), strict=True):
            states.append(y)
            q, v = np.split(lent(y), 2)
            motions.append(self._motion(self._place(q, t, rank), v))
        q, v = np.split(np.array(states).reshape(-1, 2 * n), 2, axis=1)
        a, multipliers = (
            (np.array(part) for part in zip(*motions, strict=True)) if motions else (q, np.zeros((0, self.m or 0)))
        )
        return MultibodySolution(np.asarray(ode.t), q, v, a, multipliers, ode.nfev, latest["steps"])

    def _place(self, q: FloatArray, t: float, rank: int | None) -> _Place:
        """Factors at `q`, with so many independent rows, by default as many as there are."""
        n = len(q)
        M, G = self._M(q), self._G(q, t)
        size = _row_lengths(G)
        Q, R, rows = _factors(G / size[:, None])
        left = np.abs(R.diagonal())
        if rank is None or (rank and not left[rank - 1] > DEPENDENT * left[0]):
            found = int(np.sum(left > DEPENDENT * left[:1]))
            if rank is not None:
                raise SingularGeometryError(
                    f"at t = {t:.8g} only {found} constraints are independent, and {rank} at the start: a singular "
                    f"place of the mechanism, q = {shown(q)}. End the run before, or hold it by other constraints"
                )
            rank = found
        N = Q[:, rank:]
        S = N.T @ M @ N
        W, info = lapack.dpotrf(S) if rank < n else (S, 0)
        if info or (W.diagonal() ** 2 <= MASSLESS * S.diagonal()).any():
            raise SingularGeometryError(
                f"at t = {t:.8g}, q = {shown(q)} the mass matrix is not positive along what the {rank} independent "
                "constraints leave free: give the coordinates that move there a mass, or hold them"
            )
        return _Place(t, q, M, G, size, rows[:rank], Q[:, :rank], R[:rank, :rank], N, W)

    def _start(self, q: FloatArray, v: FloatArray, t: float) -> _Place:
        """The place of a start; refused where that is off the constraints."""
        place, c = self._place(q, t, None), self._c(q, t)
        gained = np.sqrt(largest(self._motion(place, v)[0]) * self.length)
        speed = largest(v) + gained + np.abs(c) / place.size
        for miss, allowed, what in (
            (self._g(q, t), max(self.length, largest(q)) + 0 * place.size, "off"),
            (place.G @ v - c, speed, "left by the velocities, per unit of time,"),
        ):
            off = np.abs(miss) / place.size
            if np.any(off > START * allowed):
                row = int(np.argmax(off - START * allowed))
                raise ConstraintError(
                    f"constraint {row} is {what} by {off[row]:.3g} at the start. Start from body.project(q, v, t), "
                    "which gives the nearest state on the constraints",
                    rows=[row],
                )
        return self._placed(q, t, None)

    def _placed(self, q: FloatArray, t: float, rank: int | None) -> _Place:
        """The place on the constraints near `q`, by Newton's method down to rounding."""
        place, g = self._place(q, t, rank), self._g(q, t)
        off = largest(g / place.size)
        accepted = ACCEPTED * max(self.length, largest(q))
        for _ in range(ITERATIONS):
            if np.all(np.abs(g) <= 2 * _EPS * (np.abs(place.G) @ np.abs(place.q))):
                break
            step = place.solve(np.zeros(len(q)), -g)
            for part in PARTS if off > accepted else PARTS[:1]:
                moved = lent(place.q + part * step)
                there = self._g(moved, t)
                left = largest(there / place.size)
                if left < (1.0 - 0.5 * part) * off:
                    break
            else:
                break
            place, g, off = self._place(moved, t, rank), there, left
        if not off <= accepted:
            row = int(np.argmax(np.abs(g / place.size)))
            raise ConvergenceError(
                f"no positions on the constraints were found near q = {shown(q)} at t = {t:.8g}: constraint {row} "
                f"stays off by {off:.3g}. Start nearer, take smaller steps (rtol, max_step), or see whether the "
                "constraints can be met together",
                residual=off,
                tolerance=accepted,
                row=row,
            )
        return place

    def _tangent(self, place: _Place, v: FloatArray) -> FloatArray:
        """The nearest velocities that stay on the constraints."""
        c, speed = self._c(place.q, place.t), largest(v)
        for _ in range(2):  # the second time for what rounding left
            v = v + place.solve(np.zeros(len(v)), c - place.G @ v)
        off = np.abs(c - place.G @ v) / place.size
        if not np.all(off <= ACCEPTED * (speed + np.abs(c) / place.size)):
            row = int(np.argmax(off))
            raise ContradictionError(
                f"at t = {place.t:.8g} dependent constraints ask for different velocities: row {row} stays off by "
                f"{off[row]:.3g}. Remove one of them or change what it asks for",
                rows=[row],
            )
        return v


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


def _row_lengths(G: FloatArray) -> FloatArray:
    """1 for rows of zeros."""
    size = np.sqrt(np.einsum("ij,ij->i", G, G))
    size[size == 0] = 1.0
    return np.asarray(size)
