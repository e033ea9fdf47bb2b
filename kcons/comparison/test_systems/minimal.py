"""Solutions in minimal coordinates: equations of motion in which nothing is left to be held.

They share no code with the engine. DOP853 integrates them at the smallest tolerance it accepts.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp

from kcons.comparison.test_systems.system import Reference
from kcons.constraints.target import FloatArray

#: Relative tolerance: the least that SciPy accepts, and a larger one whose difference tells the error.
FINEST, COARSER = 2.3e-14, 1e-13


def integrated(
    rate: Callable[[float, FloatArray], FloatArray],
    start: ArrayLike,
    time: float,
    place: Callable[[FloatArray], FloatArray],
    how: str,
) -> Reference:
    """Positions at `time` of a system with coordinates y, y' = rate(t, y); `place` gives positions, shape (n_atoms, 3).

    `how` names the equations.
    """
    ends = []
    for rtol in (FINEST, COARSER):
        path = solve_ivp(rate, (0.0, time), np.asarray(start, float), method="DOP853", rtol=rtol, atol=0.1 * rtol)
        ends.append(place(path.y[:, -1]))
    error = float(np.sqrt(np.mean(np.sum((ends[0] - ends[1]) ** 2, axis=1))))
    return Reference(ends[0], error, f"{how}, DOP853 at rtol {FINEST:g}")


def spin(q: FloatArray, omega: FloatArray) -> FloatArray:
    """Rate of the quaternion q (scalar last) of a body that turns with `omega`, in its own axes: q (omega, 0)/2."""
    return 0.5 * np.concatenate([q[3] * omega + np.cross(q[:3], omega), [-q[:3] @ omega]])


def turned(q: FloatArray, r: FloatArray) -> FloatArray:
    """Vectors r, shape (n, 3), from body axes to space axes; q need not be normalized."""
    axis, scalar = q[:3] / np.linalg.norm(q), q[3] / np.linalg.norm(q)
    across = np.cross(axis, r)
    return np.asarray(r + 2.0 * (scalar * across + np.cross(axis, across)))
