"""A system whose cell can change."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kcons.constraints.arguments import as_array, check_call
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, NonFiniteError, UnsupportedError
from kcons.motion.motion import Motion
from kcons.steppers import State, System

#: A function of positions, time and cell (vectors as rows, shape (3, 3)).
InCellFunction = Callable[[FloatArray, float, FloatArray], ArrayLike]


class CellSystem(System):
    """Constraints, masses and forces in a periodic cell that a barostat changes.

    Parameters
    ----------
    motion : Motion
        Of a `ConstraintSet` made with a cell.
    force, potential : callable, optional
        Forces, shape (n_atoms, 3), and potential energy as functions of positions, time and cell. Both or neither.
    stress : callable, optional
        The derivative of the potential by a strain of all atoms and the cell, over the volume, shape (3, 3): positive
        where the system pulls its walls together. For `CellRescaling`.
    far : float
        As for `System`.

    Attributes
    ----------
    cell : ndarray, shape (3, 3)
        Vectors as rows; a unit vector normal to the others where it is not periodic, so that a pressure is an energy
        over an area there. That of the last state that a step began or ended with, or whose energy was asked for.
    periodic : ndarray of bool, shape (3,)

    Raises
    ------
    InputError
        The constraint set has no cell; a force without a potential.
    """

    def __init__(
        self,
        motion: Motion,
        force: InCellFunction | None = None,
        potential: Callable[[FloatArray, float, FloatArray], float] | None = None,
        stress: InCellFunction | None = None,
        *,
        far: float = 8.0,
    ) -> None:
        lattice = motion.lattice
        if lattice is None:
            raise InputError("the constraint set has no cell: give ConstraintSet(..., cell=) one", item="cell")
        if (force is None) != (potential is None):
            raise InputError(
                "give force and potential, or neither: a change of the cell is judged by the energy", item="potential"
            )
        for name, function in (("force", force), ("potential", potential), ("stress", stress)):
            check_call(name, function, ("x", "t", "cell"))
        self._matrix = lattice[0].copy()
        self.periodic: NDArray[np.bool_] = lattice[1].any(axis=0)
        self._pbc: bool | list[bool] = True if self.periodic.all() else self.periodic.tolist()
        self.stress_of = stress
        super().__init__(
            motion,
            None if force is None else (lambda x, t: force(x, t, self.cell)),
            potential=None if potential is None else (lambda x, t: potential(x, t, self.cell)),
            far=far,
        )

    @property
    def cell(self) -> FloatArray:
        return self._matrix

    @property
    def volume(self) -> float:
        """What the pressure acts on; `InputError` where a vector of the cell is zero."""
        found = float(abs(np.linalg.det(self.cell)))
        if not found > 0:
            raise InputError(
                "the cell has no volume for a pressure to act on: give its vector along which it is not periodic a "
                "length",
                item="cell",
            )
        return found

    def set_cell(self, cell: FloatArray, positions: FloatArray) -> None:
        """Change the cell; `positions` are those in it.

        Forces and energies that states carry are of the cell that was, which steps take again: go on with
        `dataclasses.replace(state, positions=positions, forces=None, barostat=None)`.

        Raises
        ------
        InputError, ImageError
            As `Motion.set_cell`; nothing was changed.
        """
        self.motion.set_cell(cell, self._pbc, positions)
        lattice = self.motion.lattice
        assert lattice is not None  # some direction is periodic
        self._matrix = lattice[0].copy()

    def initial_state(
        self,
        positions: ArrayLike,
        velocities: ArrayLike | None = None,
        *,
        time: float = 0.0,
        project: bool = False,
    ) -> State:
        """As `System.initial_state`; the state knows the present cell."""
        state = super().initial_state(positions, velocities, time=time, project=project)
        return replace(state, barostat=self.cell.flatten())

    def enter(self, state: State) -> None:
        """Take the cell of a state that knows one; errors as of `set_cell`."""
        cell = state.cell
        if cell is not None and not (cell == self.cell)[self.periodic].all():
            self.set_cell(cell.copy(), state.positions.copy())  # arrays of a state that is shown cannot be written to

    def kernel_arrays(self, state: State) -> tuple[FloatArray, FloatArray, FloatArray | None]:
        """As `System.kernel_arrays`, in the cell of the state."""
        self.enter(state)
        return super().kernel_arrays(state)

    def total_energy(self, state: State) -> float:
        """As `System.total_energy`, in the cell of the state."""
        self.enter(state)
        return super().total_energy(state)

    def energy(self, x: FloatArray, time: float, step: int) -> float:
        """The potential energy, infinite where atoms overlap; `NonFiniteError` if it is NaN, or minus infinity."""
        found = self.potential_energy(x, time)
        if not found > -np.inf:
            error = NonFiniteError(
                f"the potential energy is {found} at step {step}, by which no trial cell can be judged: look at what "
                "the force field returned"
            )
            error.step = step
            raise error
        return found

    def stress(self, x: FloatArray, time: float) -> FloatArray:
        """Shape (3, 3), symmetric; `UnsupportedError` where nobody knows it, `NonFiniteError` if it is not finite."""
        if self.stress_of is None:
            if self.force is None:
                return np.zeros((3, 3))
            raise UnsupportedError(
                "this System has no stress; give stress=, or use MonteCarloBarostat, which needs none"
            )
        found = as_array(self.stress_of(x, time, self.cell), (3, 3), "stress")
        if not np.isfinite(found).all():
            raise NonFiniteError("the stress is not finite: look at what the force field returned")
        return 0.5 * (found + found.T)
