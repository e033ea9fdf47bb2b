"""The contract of a cluster solver: what it is asked to do, and what it reports back."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray


class Request(NamedTuple):
    """One projection, in place on the whole local arrays.

    Attributes
    ----------
    changed : ndarray, shape (n_atoms, 3)
        What is changed in place: positions, or vectors to be made tangent (velocities, forces per mass).
    reference : ndarray, shape (n_atoms, 3)
        Positions on the constraints, whose gradients give the directions.
    wanted : ndarray, shape (n_rows,), optional
        Targets, or rates, by row of the set; None for the targets found at set-up, and for no motion of the surface.
    lattice : ndarray, shape (2, 3, 3), optional
        Cell and its inverse; None without periodicity.
    time, reference_time : float
        Times of `changed` and `reference`; of tangents only `time` counts.
    velocities : ndarray, shape (n_atoms, 3), optional
        Changed by the displacement of positions times `inv_dt`.
    inv_dt : float
    flight : bool
        Whether `reference` is where a flight began that ends in `changed`: rows of velocities then hold at its middle,
        at the middle of the times, and `wanted` has what they are held at times the length of the flight. Otherwise
        rows of velocities do not count in positions.
    moved : ndarray, shape (n_atoms, 3), optional
        Whole cells by which positions were moved from where they are stored. Rows with a place in space take them off.
    """

    changed: FloatArray
    reference: FloatArray
    wanted: FloatArray | None = None
    lattice: FloatArray | None = None
    time: float = 0.0
    reference_time: float = 0.0
    velocities: FloatArray | None = None
    inv_dt: float = 0.0
    flight: bool = False
    moved: FloatArray | None = None


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
    """A solver of one kind for all clusters of one shape; `rank` counts independent rows at the reference.

    The first two methods touch only the atoms of their rows, and leave everything as it was when the outcome is not
    converged. `multipliers`, in the order of `rows`, receive those of unit steps in what a row measures.
    """

    name: str
    rows: IntArray

    def positions(self, request: Request, multipliers: FloatArray | None = None) -> Outcome:
        """Solve sigma(x + M^-1 A(reference)^T Lambda, time) = 0; `multipliers` receive Lambda."""
        ...

    def tangents(self, request: Request, multipliers: FloatArray | None = None) -> Outcome:
        """y - M^-1 A^T mu with A y = rates; `multipliers` receive mu."""
        ...

    def rank(self, here: Request) -> int: ...
