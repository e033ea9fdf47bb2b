"""Equilibria of a flow, V(X_s) = 0 (notes eq. 29), and what the flow does around them (eqs. 26-28)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import root

from kcons.constraints.arguments import FloatArray, numbers, whole_number
from kcons.errors import InputError
from kcons.models.flows.flow import Flow
from kcons.models.flows.linear import Classification, classify

#: Equilibria closer than this, in parts of the size of the box, are one.
SAME = 1e-6


class Equilibrium(NamedTuple):
    """A point where V vanishes."""

    position: FloatArray
    jacobian: FloatArray
    #: Of the linear flow around it; it decides about stability only where it is `hyperbolic`.
    classification: Classification
    #: |V| there.
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
    """
    edges, starts, n = numbers(box, "box"), whole_number(starts, "starts"), flow.n
    if edges.shape != (n, 2) or not np.all(np.isfinite(edges)) or np.any(edges[:, 0] >= edges[:, 1]):
        raise InputError(f"the box has shape ({n}, 2), its lower edges first", item="box")
    low, width = edges[:, 0], edges[:, 1] - edges[:, 0]
    corners = np.stack(np.meshgrid(*[[0.0, 1.0]] * n), axis=-1).reshape(-1, n) if n <= 6 else np.zeros((0, n))
    fixed = np.vstack([np.full((1, n), 0.5), corners])
    spread = np.random.default_rng(seed).random((max(starts - len(fixed), 0), n))
    points = low + width * np.vstack([fixed, spread])[:starts]
    found: list[FloatArray] = []
    with np.errstate(all="ignore"):
        speeds = [float(np.linalg.norm(flow.velocity(time, p))) for p in points]
        size = float(np.median([s for s in speeds if np.isfinite(s)] or [1.0])) or 1.0
        for point in points:
            try:
                result = root(
                    lambda X: flow.velocity(time, X),
                    point,
                    jac=lambda X: flow.jacobian(time, X),
                    options={"xtol": 1e-13},
                )
                X = _polished(flow, time, np.asarray(result.x))
                place, left = (X - low) / width, float(np.linalg.norm(flow.velocity(time, X)))
            except InputError:  # the search has left all numbers
                continue
            inside = np.min(place) >= -SAME and np.max(place) <= 1 + SAME and left <= tolerance * size
            if inside and all(np.max(np.abs(X - other) / width) > SAME for other in found):
                found.append(X)
    found.sort(key=lambda X: [round(float(value), 9) for value in X])
    return [equilibrium_at(flow, X, time) for X in found]


def equilibrium_at(flow: Flow, position: ArrayLike, time: float = 0.0) -> Equilibrium:
    """What the flow does around a point where it vanishes.

    The Jacobian counts as known to the accuracy of its differences and of the point. So a center of a flow that is
    given without its Jacobian is a center whose stability cannot be told.
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
        V = flow.velocity(time, X)
        trial = X - np.linalg.lstsq(flow.jacobian(time, X), V, rcond=1e-10)[0]
        if not np.all(np.isfinite(trial)) or np.linalg.norm(flow.velocity(time, trial)) >= np.linalg.norm(V):
            return X
        X = trial
    return X
