"""Equilibria of a flow, V(X_s) = 0 (notes eq. 29), and what the flow does around them (eqs. 26-28)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import root

from kcons.constraints.arguments import numbers
from kcons.errors import InputError
from kcons.models.flows.flow import FloatArray, Flow
from kcons.models.flows.stability import Classification, classify

#: Equilibria closer than this, in parts of the size of the box, are one.
SAME = 1e-6


class Equilibrium(NamedTuple):
    """A point where V vanishes.

    Attributes
    ----------
    position : ndarray, shape (n,)
    jacobian : ndarray, shape (n, n)
    classification : Classification
        Of the linear flow around it; it decides about stability only where it is `hyperbolic`.
    residual : float
        |V| there.
    """

    position: FloatArray
    jacobian: FloatArray
    classification: Classification
    residual: float


def find_equilibria(
    flow: Flow, box: ArrayLike, *, starts: int = 100, time: float = 0.0, seed: int = 0, tolerance: float = 1e-10
) -> list[Equilibrium]:
    """Search for equilibria within a box, by Powell's method from many starts.

    Parameters
    ----------
    flow : Flow
    box : array_like, shape (n, 2)
        Least and largest value of each variable.
    starts : int
        Starts: the corners and the middle of the box, the rest spread at random.
    time : float
        V is taken at this time.
    seed : int
    tolerance : float
        |V| counts as zero below this part of its size in the box.

    Returns
    -------
    list of Equilibrium
        Sorted by position. A search can miss one; more starts make that less likely.

    Raises
    ------
    InputError
        A box that is not finite or has the wrong shape.
    """
    edges = numbers(box, "box")
    if edges.shape != (flow.n, 2) or not np.all(np.isfinite(edges)) or np.any(edges[:, 0] >= edges[:, 1]):
        raise InputError(f"the box has shape ({flow.n}, 2), its lower edges first", item="box")
    if starts < 1:
        raise InputError("there is at least one start", item="starts")
    low, width = edges[:, 0], edges[:, 1] - edges[:, 0]
    rng = np.random.default_rng(seed)
    fixed = [np.full(flow.n, 0.5)]
    if flow.n <= 6:
        fixed += [np.array([(c >> k) & 1 for k in range(flow.n)], dtype=np.float64) for c in range(2**flow.n)]
    points = np.concatenate([np.array(fixed), rng.random((max(starts - len(fixed), 0), flow.n))])[: max(starts, 1)]
    points = low + width * points
    with np.errstate(all="ignore"):
        speeds = [float(np.linalg.norm(flow.velocity(time, p))) for p in points]
    size = float(np.median([s for s in speeds if np.isfinite(s)] or [1.0])) or 1.0
    found: list[FloatArray] = []
    for point in points:
        try:
            with np.errstate(all="ignore"):
                result = root(
                    lambda X: flow.velocity(time, X),
                    point,
                    jac=lambda X: flow.jacobian(time, X),
                    method="hybr",
                    options={"xtol": 1e-13},
                )
        except InputError:  # the search has left all numbers
            continue
        X = _polished(flow, time, np.asarray(result.x))
        place = (X - low) / width
        if not np.all(np.isfinite(X)) or np.min(place) < -SAME or np.max(place) > 1 + SAME:
            continue
        if float(np.linalg.norm(flow.velocity(time, X))) > tolerance * size:
            continue
        if all(np.max(np.abs(X - other) / width) > SAME for other in found):
            found.append(X)
    found.sort(key=lambda X: [round(float(value), 9) for value in X])
    return [equilibrium_at(flow, X, time) for X in found]


def equilibrium_at(flow: Flow, position: ArrayLike, time: float = 0.0) -> Equilibrium:
    """What the flow does around a point where it vanishes.

    The Jacobian counts as known to the accuracy of its differences and of the point. So a centre of a flow that is
    given without its Jacobian is a centre whose stability cannot be told.
    """
    X = numbers(position, "position")
    A, V = flow.jacobian(time, X), flow.velocity(time, X)
    # One more Newton step says how far the point may be off, and that what the Jacobian would be there; at a root of
    # order k it goes only a k-th part of the way.
    there = X - np.linalg.lstsq(A, V, rcond=1e-10)[0]
    moved = 4.0 * np.abs(flow.jacobian(time, there) - A) if np.all(np.isfinite(there)) else np.zeros_like(A)
    return Equilibrium(X, A, classify(A, moved + flow.jacobian_error(time, X)), float(np.linalg.norm(V)))


def _polished(flow: Flow, time: float, X: FloatArray) -> FloatArray:
    """Two Newton steps of least norm, kept where they help."""
    for _ in range(2):
        if not np.all(np.isfinite(X)) or np.max(np.abs(X), initial=0.0) > 1e100:
            return X
        V = flow.velocity(time, X)
        trial = X - np.linalg.lstsq(flow.jacobian(time, X), V, rcond=1e-10)[0]
        if not np.all(np.isfinite(trial)) or np.linalg.norm(flow.velocity(time, trial)) >= np.linalg.norm(V):
            return X
        X = trial
    return X
