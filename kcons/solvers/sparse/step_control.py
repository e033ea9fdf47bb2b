"""Newton's method with step control: what its loops share, whatever the rows are.

A step may reuse the factor of the one before. Where plain Newton does not arrive, the same cluster is done again with
`careful` steps: each of them must make the errors smaller, or is halved until it does.
"""

from __future__ import annotations

from kcons.constraints.compilation import njit
from kcons.solvers.sparse.elimination import FAST
from kcons.solvers.tolerances import MAX_ITERATIONS, NEAR, NEWTON_TOLERANCE, ROUNDINGS

# Spliced into the loops: what is called there from them, with arrays, costs small clusters a sixth of their time.


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def overshot(careful, iteration, error, total, best):  # type: ignore[no-untyped-def]
    """Whether the last step has to be halved: the sum of errors is not below that before it, beyond rounding."""
    return careful and iteration > 0 and not (total < 0.999 * best) and error > NEAR


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
def keep(begin, end, values, kept):  # type: ignore[no-untyped-def]
    """Remember the values from `begin` to `end`, to go back to."""
    for k in range(begin, end):
        kept[k] = values[k]


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def go_back(begin, end, values, kept):  # type: ignore[no-untyped-def]
    """Go half the way back to what was kept."""
    for k in range(begin, end):
        values[k] = kept[k] + 0.5 * (values[k] - kept[k])


@njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
def refines(iteration, error, previous, allowed):  # type: ignore[no-untyped-def]
    """Whether one refinement of tangents more is worth it: as long as it helps; the least error is accepted."""
    return not (error <= allowed or iteration > 8 or not (error < 0.5 * previous))
