"""What a cluster solver reports back after one call."""

from typing import NamedTuple


class Outcome(NamedTuple):
    """Result of one solver call; arrays are changed only when `converged` is true.

    Attributes
    ----------
    converged : bool
        Whether the final residual check passed.
    residual : float
        Worst residual: relative to the scale of the row for positions,
        ``|A v - c|`` with unit rows for tangents.
    iterations : int
        Newton iterations (positions) or refinement steps (tangents) used.
    worst_row : int
        Index into the solver's ``rows`` of the worst, or failing, row; -1 if none.
    """

    converged: bool
    residual: float
    iterations: int
    worst_row: int
