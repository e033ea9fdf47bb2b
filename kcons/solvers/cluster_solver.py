"""The contract of a cluster solver, and what it reports back after one call."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray


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


class ClusterSolver(Protocol):
    """A solver of one kind for all clusters of one shape.

    Both methods work in place on the whole local arrays, touch only the atoms of their rows, and leave
    everything as it was when the outcome is not converged. `targets` and `rates` are indexed by row of
    the set (None: the targets found at set-up; no motion of the surface).
    """

    name: str
    rows: IntArray

    def positions(
        self,
        x_new: FloatArray,
        x_ref: FloatArray,
        targets: FloatArray | None,
        lattice: FloatArray | None,
        velocities: FloatArray | None,
        inv_dt: float,
        multipliers: FloatArray | None,
        time: float,
        reference_time: float,
    ) -> Outcome: ...

    def tangents(
        self,
        x: FloatArray,
        y: FloatArray,
        rates: FloatArray | None,
        lattice: FloatArray | None,
        multipliers: FloatArray | None,
        time: float,
    ) -> Outcome: ...


class DistanceSolver(Protocol):
    """The kernels behind `DistanceClusters`; lengths and rates come in the order of `rows`."""

    name: str
    rows: IntArray

    def positions(
        self,
        x_new: FloatArray,
        x_ref: FloatArray,
        lengths: FloatArray,
        lattice: FloatArray | None,
        velocities: FloatArray | None,
        inv_dt: float,
        multipliers: FloatArray | None,
    ) -> Outcome: ...

    def tangents(
        self,
        x: FloatArray,
        y: FloatArray,
        rates: FloatArray | None,
        lattice: FloatArray | None,
        multipliers: FloatArray | None,
    ) -> Outcome: ...
