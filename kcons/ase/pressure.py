"""Pressure of atoms with constraints: the stress of the constraint forces, and cells that change."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from ase import Atoms
from ase.calculators.calculator import PropertyNotImplementedError
from numpy.typing import ArrayLike

from kcons.ase.respect import require_on_surface
from kcons.ase.topology import velocities_of
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError
from kcons.motion.motion import Motion
from kcons.thermostats.pressure import CellSystem, constraint_virial

#: Places of the Voigt components xx, yy, zz, yz, xz, xy in a 3 x 3 matrix.
VOIGT = ((0, 1, 2, 1, 0, 0), (0, 1, 2, 2, 2, 1))
_BY_ENERGIES = "use MonteCarloBarostat, or virial='difference' of a reporter, which take energies alone"


def virial_of(motion: Motion, atoms: Atoms, forces: FloatArray, time: float = 0.0) -> FloatArray:
    """`constraint_virial` at the present positions and momenta, which are zero where there are none.

    Raises
    ------
    UnsupportedError
        The atoms are off the constraints: what scales atoms with the cell and asks for the stress there, as ASE's
        StrainFilter, does not respect them.
    """
    x = atoms.arrays["positions"]
    try:
        require_on_surface(motion.constraint_set, x, time)
    except InputError as error:
        raise UnsupportedError(
            f"the stress is asked for off the constraints ({error}); StrainFilter and barostats that scale atoms leave "
            "them. Relax cells with FrechetCellFilter, or restore the atoms first"
        ) from error
    return constraint_virial(motion, x, velocities_of(atoms), forces, time)


class AtomsSystem(CellSystem):
    """Constraints and forces of `Atoms`, whose own cell is the one that changes.

    Parameters
    ----------
    motion : Motion
    force, potential : callable
        Of positions and time, in the cell that the atoms have.
    atoms : ase.Atoms
        With a periodic cell.
    stressless : bool
        Whether constraints of ASE add forces, which no stress knows of.
    far : float

    Raises
    ------
    InputError
        The cell is not periodic.
    """

    def __init__(
        self,
        motion: Motion,
        force: Callable[[FloatArray, float], ArrayLike],
        potential: Callable[[FloatArray, float], float],
        atoms: Atoms,
        *,
        stressless: bool = False,
        far: float,
    ) -> None:
        self.atoms = atoms
        if motion.lattice is None:
            raise InputError(
                "the atoms have no periodic cell, and a barostat nothing to change: set atoms.cell and atoms.pbc",
                item="cell",
            )
        self._stressless = stressless
        super().__init__(
            motion, lambda x, t, cell: force(x, t), lambda x, t, cell: potential(x, t), self._stress, far=far
        )

    @property
    def cell(self) -> FloatArray:
        return np.array(self.atoms.cell.array)

    def set_cell(self, cell: FloatArray, positions: FloatArray) -> None:
        super().set_cell(cell, positions)
        self.atoms.cell[...] = cell
        self.atoms.arrays["positions"][...] = positions

    def _stress(self, x: FloatArray, time: float, cell: FloatArray) -> FloatArray:
        if self._stressless:
            raise UnsupportedError(f"forces that constraints of ASE add have no stress; {_BY_ENERGIES}")
        self.atoms.arrays["positions"][...] = x
        try:
            found = self.atoms.get_stress(voigt=False, apply_constraint=False)
        except PropertyNotImplementedError as error:
            raise UnsupportedError(f"the calculator has no stress; {_BY_ENERGIES}") from error
        return np.asarray(found, dtype=float)
