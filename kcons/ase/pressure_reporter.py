"""The pressure of atoms in a run of our dynamics."""

from __future__ import annotations

from pathlib import Path
from typing import IO, Any

import numpy as np
from ase import units
from numpy.typing import ArrayLike, NDArray

from kcons.ase.dynamics import FAR, ConstrainedDynamics
from kcons.ase.pressure import AtomsSystem
from kcons.constraints.arguments import positive, refuse_other
from kcons.constraints.target import FloatArray
from kcons.thermostats.pressure import Pieces, find_pieces, instantaneous_pressure
from kcons.thermostats.pressure.measured import Virial, mean_pressure, refuse_virial
from kcons.thermostats.pressure.pieces import Held


class PressureReporter:
    """Pressure and volume of a run; attach it: ``dynamics.attach(reporter, interval=10)``.

    Parameters
    ----------
    dynamics : ConstrainedDynamics
        Or any of the thermostats. It needs no barostat.
    file : path or text file, optional
        Where to write time (fs), volume (A^3) and pressure (bar, as in `mean`), a line for each call.
    virial : {'molecular', 'atomic', 'difference'}
        See `kcons.thermostats.instantaneous_pressure`; 'difference' is for calculators without stress.
    molecules : array_like of int, shape (n, 2), optional
        Bonds, for pieces; by default those of the barostat.
    temperature_K : float, optional
        For N kT/V instead of the present kinetic energy of pieces.

    Attributes
    ----------
    values : list of ndarray, shape (3, 3)
        Pressure tensors in eV/A^3.
    volumes : list of float

    Raises
    ------
    InputError
        An unknown virial; `temperature_K` with 'atomic'; dynamics of ASE, which do not know all rows.
    """

    def __init__(
        self,
        dynamics: ConstrainedDynamics,
        file: str | Path | IO[str] | None = None,
        *,
        virial: Virial = "molecular",
        molecules: ArrayLike | None = None,
        temperature_K: float | None = None,
    ) -> None:
        refuse_virial(virial, temperature_K)
        refuse_other(dynamics, ConstrainedDynamics, "dynamics", "a dynamics object of kcons.ase")
        self.dynamics, self.virial, self.molecules = dynamics, virial, molecules
        self.thermal = None if temperature_K is None else units.kB * positive(temperature_K, "temperature_K")
        self._own = isinstance(file, str | Path)
        self._file = Path(file).open("w") if isinstance(file, str | Path) else file  # noqa: SIM115
        if self._file is not None:
            print("# time/fs  volume/A^3  pressure/bar", file=self._file)
        self._known: tuple[Any, AtomsSystem, Pieces | None] | None = None
        self.values: list[FloatArray] = []
        self.volumes: list[float] = []

    def __del__(self) -> None:
        if getattr(self, "_own", False) and self._file is not None:
            self._file.close()

    def __call__(self) -> None:
        dynamics, atoms = self.dynamics, self.dynamics.atoms
        system, pieces = self._system()
        state = dynamics.state.copied()
        self.values.append(
            instantaneous_pressure(system, state, self.virial, pieces=pieces, thermal_energy=self.thermal)
        )
        self.volumes.append(float(atoms.get_volume()))
        if self._file is not None:
            bar = mean_pressure(self.values[-1:], self._axes) / units.bar
            line = f"{dynamics.get_time() / units.fs:.3f} {self.volumes[-1]:.6f} {bar:.6g}"
            print(line, file=self._file, flush=True)

    @property
    def mean(self) -> float:
        """Of the pressure, in eV/A^3, along the axes that a barostat changes."""
        return mean_pressure(self.values, self._axes)

    @property
    def _axes(self) -> NDArray[np.bool_]:
        barostat = getattr(self.dynamics, "barostat", None)
        return np.ones(3, dtype=bool) if barostat is None else barostat.strains.axes

    def _system(self) -> tuple[AtomsSystem, Pieces | None]:
        dynamics, motion = self.dynamics, self.dynamics.motion
        if self._known is None or self._known[0] is not motion:
            added = dynamics._only_forces
            system = AtomsSystem(motion, dynamics._force, dynamics._energy, dynamics.atoms, stressless=added, far=FAR)
            barostat, pieces = getattr(dynamics, "barostat", None), None
            if self.virial != "atomic":
                x = dynamics.atoms.arrays["positions"]
                if barostat is not None and self.molecules is None:
                    pieces = barostat.pieces(dynamics._systems(), x, dynamics.time)
                else:
                    held: Held = "refuse" if barostat is None else barostat.held
                    pieces = find_pieces(system, x, self._axes, self.molecules, held, dynamics.time)
            self._known = motion, system, pieces
        return self._known[1:]
