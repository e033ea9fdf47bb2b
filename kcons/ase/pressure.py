"""Pressure of atoms in runs of our dynamics: cells that change, and the pressure along a run."""

from __future__ import annotations

from typing import Any

import numpy as np
from ase import units
from ase.calculators.calculator import PropertyNotImplementedError
from numpy.typing import NDArray

from kcons.ase.dynamics import FAR, ConstrainedDynamics
from kcons.constraints.arguments import positive, refuse_other
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError
from kcons.motion.motion import Motion
from kcons.thermostats.cells import (
    BarostatBodies,
    CellSystem,
    Virial,
    find_pieces,
    instantaneous_pressure,
    refuse_virial,
)

_BY_ENERGIES = "use MonteCarloBarostat, or virial='difference' of a reporter, which take energies alone"


class AtomsSystem(CellSystem):
    """Constraints, forces and energy of a dynamics object, whose atoms have the cell that changes."""

    def __init__(self, dynamics: ConstrainedDynamics, motion: Motion) -> None:
        self.atoms = dynamics.atoms
        if motion.lattice is None:
            raise InputError(
                "the atoms have no periodic cell, and a barostat nothing to change: set atoms.cell and atoms.pbc",
                item="cell",
            )
        #: Constraints of ASE add forces, which no stress knows of.
        self._stressless = dynamics._only_forces
        super().__init__(
            motion,
            lambda x, t, cell: dynamics._force(x, t),
            lambda x, t, cell: dynamics._energy(x, t),
            self._stress,
            far=FAR,
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


class PressureReporter:
    """Pressure and volume of a run; attach it: ``dynamics.attach(reporter, interval=10)``.

    Parameters
    ----------
    dynamics : ConstrainedDynamics
        Or any of the thermostats. It needs no barostat.
    virial : {'molecular', 'atomic', 'difference'}
        See `kcons.thermostats.instantaneous_pressure`; 'difference' is for calculators without stress.
    temperature_K : float, optional
        For N kT/V instead of the present kinetic energy of pieces.

    Attributes
    ----------
    values : list of ndarray, shape (3, 3)
        Pressure tensors in eV/A^3.
    volumes : list of float
    """

    def __init__(
        self,
        dynamics: ConstrainedDynamics,
        *,
        virial: Virial = "molecular",
        temperature_K: float | None = None,
    ) -> None:
        refuse_virial(virial, temperature_K)
        refuse_other(dynamics, ConstrainedDynamics, "dynamics", "a dynamics object of kcons.ase")
        self.dynamics, self.virial = dynamics, virial
        self.thermal = None if temperature_K is None else units.kB * positive(temperature_K, "temperature_K")
        self._known: tuple[Any, AtomsSystem, BarostatBodies | None] | None = None
        self.values: list[FloatArray] = []
        self.volumes: list[float] = []

    def __call__(self) -> None:
        dynamics, atoms = self.dynamics, self.dynamics.atoms
        system, pieces = self._system()
        state = dynamics.state.copied()
        self.values.append(
            instantaneous_pressure(system, state, self.virial, pieces=pieces, thermal_energy=self.thermal)
        )
        self.volumes.append(float(atoms.get_volume()))

    @property
    def mean(self) -> float:
        """Of the pressure, in eV/A^3, along the axes that a barostat changes."""
        return float(np.mean([np.diagonal(value)[self._axes] for value in self.values]))

    @property
    def _axes(self) -> NDArray[np.bool_]:
        barostat = self.dynamics.barostat
        return np.ones(3, dtype=bool) if barostat is None else barostat.strains.axes

    def _system(self) -> tuple[AtomsSystem, BarostatBodies | None]:
        dynamics, motion = self.dynamics, self.dynamics.motion
        if self._known is None or self._known[0] is not motion:
            system = AtomsSystem(dynamics, motion)
            x, barostat, pieces = dynamics.atoms.arrays["positions"], dynamics.barostat, None
            if self.virial != "atomic" and barostat is None:
                pieces = find_pieces(system, x, self._axes, None, "refuse", dynamics.time)
            elif self.virial != "atomic" and barostat is not None:
                pieces = barostat.pieces(dynamics._systems(), x, dynamics.time)  # type: ignore[arg-type]
            self._known = motion, system, pieces
        return self._known[1:]
