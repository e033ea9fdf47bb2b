"""Newton's method: what its loops share, whatever the rows are. A step may reuse the factor of the one before."""

from __future__ import annotations

from kcons.constraints.compilation import njit
from kcons.solvers.sparse.elimination import FAST
from kcons.solvers.tolerances import MAX_ITERATIONS, NEWTON_TOLERANCE, ROUNDINGS

# Spliced into the loops: what is called there from them, with arrays, costs small clusters a sixth of their time.


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def hopeless(iteration, error, previous):  # type: ignore[no-untyped-def]
    """Whether Newton runs away, or has had its time."""
    return iteration >= MAX_ITERATIONS or error > 1e6 * max(previous, 1.0)


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def stalled(iteration, error, previous, excess, n_rows):  # type: ignore[no-untyped-def]
    """Whether nothing is to be gained, where the largest residual is `excess` roundings."""
    return iteration > 4 and error > 0.1 * previous and excess * excess <= ROUNDINGS * ROUNDINGS * n_rows


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def factor_serves(factored, error, previous):  # type: ignore[no-untyped-def]
    """Whether a step with the factor there is gains enough for its lower price."""
    ratio = error / previous
    return factored and (error * ratio <= NEWTON_TOLERANCE or ratio < 1e-4)


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def refines(iteration, error, previous, allowed):  # type: ignore[no-untyped-def]
    """Whether one refinement of tangents more is worth it: as long as it helps; the least error is accepted."""
    return not (error <= allowed or iteration > 8 or not (error < 0.5 * previous))
