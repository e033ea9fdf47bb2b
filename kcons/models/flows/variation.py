"""From a Lagrangian to Lagrange's and Hamilton's equations, numerically (notes section 2).

Lagrangians are functions L(q, v, t) of arrays q, v of shape (f,) and a number t.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import root

from kcons.constraints.arguments import numbers
from kcons.errors import ConvergenceError, InputError
from kcons.models.flows.flow import FloatArray, jacobian_by_differences

Lagrangian = Callable[[FloatArray, FloatArray, float], float]


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
    return jacobian_by_differences(lambda s, w: [lagrangian(q, w, t)], t, v)[0]


def lagrange_residual(
    lagrangian: Lagrangian, q: ArrayLike, v: ArrayLike, a: ArrayLike, t: float = 0.0, step: float = 1e-2
) -> FloatArray:
    """d/dt dL/dv - dL/dq along q, v, a, shape (f,); zero on a true motion (notes eq. 44)."""
    q, v, a = numbers(q, "q"), numbers(v, "v"), numbers(a, "a")

    def along(h: float) -> FloatArray:
        return momentum(lagrangian, q + h * v + 0.5 * h * h * a, v + h * a, t + h)

    first, second = ((along(h) - along(-h)) / (2 * h) for h in (step, step / 2))
    force = jacobian_by_differences(lambda s, x: [lagrangian(x, v, t)], t, q)[0]
    return (4 * second - first) / 3 - force


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
