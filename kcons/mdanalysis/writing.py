"""Runs written through MDAnalysis: DCD, XTC, TRR, H5MD, NetCDF and what else it writes.

With velocities where the format has them, and in H5MD with residuals and multipliers of the constraints. Every frame is
on disk before the next step, so that a run that is stopped keeps all of them.
"""

from __future__ import annotations

import ctypes
import sys
from contextlib import AbstractContextManager
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any
from weakref import WeakSet

import MDAnalysis
import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import as_array, finite_number, positive, whole_number
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, NonFiniteError, UnsupportedError
from kcons.mdanalysis.loading import quiet
from kcons.mdanalysis.topology import cell_of, check_box, dimensions_of
from kcons.motion.motion import Motion
from kcons.steppers import State

#: The largest number in single precision.
_SINGLE = float(np.finfo(np.float32).max)
#: Of XTC: steps from the origin that an integer counts; range of steps from which on some frames are packed wrongly;
#: atoms up to which there is no packing.
_MOST, _SAFE, _FLOATS = 2**31 - 3, 2**23, 9
#: Writers of which some may still be open.
_ALIVE: WeakSet[TrajectoryWriter] = WeakSet()
_H5MD = {"timeunit": "ps", "lengthunit": "Angstrom", "velocityunit": "Angstrom/ps", "forceunit": "kJ/(mol*Angstrom)"}


@dataclass(frozen=True)
class RunUnits:
    """What 1 is in a run, in the units of MDAnalysis."""

    #: In angstrom, ps, kJ/mol.
    length: float = 1.0
    time: float = 1.0
    energy: float = 1.0
    #: For headers.
    name: str = "Å, ps, kJ/mol"

    def __post_init__(self) -> None:
        for name in ("length", "time", "energy"):
            positive(getattr(self, name), name)


#: ASE: Å, Å √(u/eV), eV. OpenMM: nm, ps, kJ/mol.
ASE_UNITS = RunUnits(1.0, 0.010180505717, 96.4853321233, "Å, Å √(u/eV), eV")
OPENMM_UNITS = RunUnits(10.0, 1.0, 1.0, "nm, ps, kJ/mol")


class TrajectoryWriter(AbstractContextManager["TrajectoryWriter"]):
    """One trajectory file.

    Parameters
    ----------
    path : path
        The ending tells the format.
    n_atoms : int
    units : RunUnits
        Of what is written; default Å, ps, kJ/mol.
    motion : Motion, optional
        The constraints of the run, in its units: for the cell of its states. Into H5MD residuals are written, and
        multipliers where forces are given; both in the units of the run, as `natural_units` says.
    interval : float, optional
        Time between frames in the run's unit; DCD stores this and no times, and so needs it.
    velocities : bool, optional
        Write velocities; by default where the format has them.
    forces : bool
        Write forces, where the format has them; NaN where a state does not know them, as the first of a run.
    **options
        For MDAnalysis' writer, such as ``precision=4`` of XTC.

    Raises
    ------
    InputError
        MDAnalysis does not write this format, or not several frames; another writer has the file open.
    UnsupportedError
        Velocities or forces are asked of a format without them; H5MD without h5py.

    Examples
    --------
    ::

        with TrajectoryWriter("run.h5md", len(x), motion=system.motion, interval=dt) as writer:
            run(system, state, dt, 1000, observers=[writer])
    """

    def __init__(
        self,
        path: str | Path,
        n_atoms: int,
        *,
        units: RunUnits | None = None,
        motion: Motion | None = None,
        interval: float | None = None,
        velocities: bool | None = None,
        forces: bool = False,
        **options: Any,
    ) -> None:
        self.path, self.units, self.motion = Path(path), units or RunUnits(), motion
        self.n_frames, self._expects_forces = 0, False
        self._writer: Any = None
        self._format = self.path.suffix[1:].upper()
        n_atoms = whole_number(n_atoms, "n_atoms")
        self._decimals = options.get("precision", 3) if self._format == "XTC" else None
        if not self.path.parent.is_dir():
            raise InputError(f"there is no folder {self.path.parent} to write {self.path.name} into", item="path")
        if any(other._writer is not None and other.path.resolve() == self.path.resolve() for other in _ALIVE):
            raise InputError(f"{self.path} is open in another TrajectoryWriter; close that first", item="path")
        able = self._format in ("TRR", "H5MD", "NC", "NCDF", "TRZ")
        kept = {"velocities": able if velocities is None else velocities, "forces": forces}
        self._kept = [name for name, stays in kept.items() if stays]
        if self._kept and not able:
            raise UnsupportedError(f"{self._format} has no {self._kept[0]}; write TRR or H5MD")
        self._universe = MDAnalysis.Universe.empty(n_atoms, trajectory=True, **kept)
        if self._format in ("H5MD", "NC", "NCDF"):
            options = {**(_H5MD if self._format == "H5MD" else {}), **options, **kept}
        if interval is not None:
            dt = self._universe.trajectory.ts.dt = abs(finite_number(interval, "interval")) * self.units.time
            if self._format == "DCD":
                options.setdefault("dt", dt)
        elif self._format == "DCD" and "dt" not in options:
            raise InputError(f"{self.path.name} has no times but the interval; give interval=", item="interval")
        try:
            with quiet():
                self._writer = MDAnalysis.Writer(str(self.path), n_atoms, multiframe=True, **options)
        except (TypeError, ValueError) as error:
            raise InputError(
                f"MDAnalysis writes no trajectory {self.path.name} ({error}); use .dcd, .xtc, .trr, .nc or .h5md",
                item="path",
            ) from None
        except RuntimeError as error:
            raise UnsupportedError(f"{self.path.name}: {error}") from None
        _ALIVE.add(self)

    def __call__(self, state: State) -> None:
        """Write a state; for `kcons.steppers.run(..., observers=[writer])`."""
        cell = cell_of(state, self.motion)
        self._expects_forces = True  # at the latest after the first step
        self.write(state.positions, state.velocities, time=state.time, cell=cell, forces=state.forces, step=state.step)

    def write(
        self,
        positions: ArrayLike,
        velocities: ArrayLike | None = None,
        *,
        time: float = 0.0,
        cell: ArrayLike | None = None,
        forces: ArrayLike | None = None,
        step: int | None = None,
    ) -> None:
        """Write one frame, in the units of the run.

        Parameters
        ----------
        positions, velocities, forces : array_like, shape (n_atoms, 3)
            `forces` are the applied ones.
        time : float
        cell : array_like, shape (3, 3), optional
            Cell vectors as rows.
        step : int, optional

        Raises
        ------
        InputError
            A wrong shape; no velocities for a file that has them; numbers that the file cannot hold; a cell that
            MDAnalysis cannot; the writer is closed.
        NonFiniteError
            A NaN or infinity; nothing was written.
        """
        if self._writer is None:
            raise InputError(f"{self.path} is closed", item="path")
        if velocities is None and "velocities" in self._kept:
            remedy = "give them, or make the writer with velocities=False"
            raise InputError(f"{self.path.name} has velocities, and none are given; {remedy}", item="velocities")
        length, energy = self.units.length, self.units.energy
        units = {"positions": length, "velocities": length / self.units.time, "forces": energy / length}
        given = {"positions": positions, "velocities": velocities, "forces": forces}
        arrays = {name: self._array(a, name, units[name]) for name, a in given.items() if a is not None}
        if self._decimals is not None:
            _refuse_beyond_xtc(arrays["positions"] * self.units.length, self._decimals, self.path.name)
        box = None if cell is None else dimensions_of(np.asarray(cell, dtype=np.float64) * length)
        time = finite_number(time, "time")
        extras = self._extras(arrays, time)
        ts = self._universe.trajectory.ts
        for name in ("positions", *self._kept):
            setattr(ts, name, arrays.get(name, np.full_like(arrays["positions"], np.nan)) * units[name])
        ts.time, ts.frame, ts.dimensions = time * self.units.time, self.n_frames, box
        ts.data["step"] = self.n_frames if step is None else step
        ts.data.update(extras)
        with quiet():
            self._writer.write(self._universe.atoms)
        for name in extras:
            self._writer.h5md_file[f"observables/{name}"].attrs.setdefault("run_units", self.units.name)
        self._flush()
        self.n_frames += 1

    def _array(self, values: ArrayLike, name: str, unit: float) -> FloatArray:
        array = as_array(values, (len(self._universe.atoms), 3), name)
        if not np.isfinite(array).all():
            atom = int(np.argmin(np.isfinite(array).all(axis=1)))
            raise NonFiniteError(f"{name} of atom {atom}: {array[atom]}; nothing was written", item=name, atom=atom)
        largest = unit * float(np.abs(array).max())
        if largest > _SINGLE:
            raise InputError(
                f"{name} reach {largest:.3g} in the units of MDAnalysis, beyond single precision; nothing was written",
                item=name,
            )
        return array

    def _extras(self, arrays: dict[str, FloatArray], time: float) -> dict[str, FloatArray]:
        """What belongs to the constraints, in the units of the run."""
        if self.motion is None or self._format != "H5MD":
            return {}
        held, x = self.motion.constraint_set, arrays["positions"]
        v, f = arrays.get("velocities"), arrays.get("forces")
        extras = {"residuals": held.value(x, time)}
        if v is not None:
            extras["velocity_residuals"] = held.jacobian(x, time) @ v.ravel() - held.velocity_target(x, time)
            if f is not None:
                extras["multipliers"] = self.motion.multipliers(x, v, f, time)
            elif self._expects_forces:
                extras["multipliers"] = np.full(held.n_rows, np.nan)
        return extras

    def _flush(self) -> None:
        """Bring everything to the file."""
        if self._format == "H5MD":
            self._writer.h5md_file.flush()
        elif self._format in ("NC", "NCDF"):
            # A file of netCDF4, or of SciPy where that is not installed.
            self._writer.trjfile.sync()
        else:
            # What libraries in C have buffered; their files do not say how.
            library = ctypes.cdll.msvcrt if sys.platform == "win32" else ctypes.CDLL(None)
            library.fflush(None)

    def close(self) -> None:
        """Close the file; more than once does no harm."""
        if self._writer is not None and (self.n_frames or self._format != "H5MD"):
            self._writer.close()
        self._writer = None

    def __exit__(self, *_: object) -> None:
        self.close()


def _refuse_beyond_xtc(x: FloatArray, decimals: int, name: str) -> None:
    """Refuse coordinates, in angstrom, that XTC cannot hold: the library packs something else, and goes on."""
    if len(x) <= _FLOATS:
        return
    steps, spread = (float(reach.max()) * 10.0 ** (decimals - 1) for reach in (np.abs(x), np.ptp(x, axis=0)))
    if steps > _MOST or spread >= _SAFE:
        raise InputError(
            f"{name} cannot hold coordinates up to {np.abs(x).max():.4g} angstrom in steps of "
            f"{10.0 ** (1 - decimals):g}: nothing was written; give a smaller precision, or another format",
            item="positions",
        )


# -- MD engines ------------------------------------------------------------------------------------------


def write_ase(dynamics: Any, path: str | Path, interval: int = 1, **options: Any) -> TrajectoryWriter:
    """Write a run of ASE through MDAnalysis from now on.

    Parameters
    ----------
    dynamics : ase.md.md.MolecularDynamics
        Of kcons or of ASE; constraints are those that it or its atoms hold through kcons.
    path : path
    interval : int
        Steps between frames.
    **options
        For `TrajectoryWriter`.

    Returns
    -------
    TrajectoryWriter
        Attached to the dynamics; close it at the end.

    Raises
    ------
    InputError
        A cell that is not in the form of MDAnalysis; in a run, constraints that are no longer the same rows.

    Warns
    -----
    UserWarning
        A cell that is periodic in some directions only.
    """
    from kcons.ase.binding import applied_forces
    from kcons.ase.topology import velocities_of

    atoms = getattr(dynamics, "atoms", None)
    if atoms is None or not hasattr(dynamics, "dt"):
        raise InputError(f"dynamics is {dynamics!r:.80}; give what makes the steps in time", item="dynamics")
    whole_number(interval, "interval")

    def box() -> FloatArray | None:
        return atoms.cell.array if atoms.pbc.any() and atoms.cell.rank == 3 else None

    if (cell := box()) is not None:
        check_box(cell, atoms.pbc, stacklevel=3)  # before there is a file

    def engine() -> Motion | None:
        found = getattr(dynamics, "motion", None)
        for item in atoms.constraints if found is None else ():
            found = found or (item.engine(atoms) if hasattr(item, "engine") else None)
        return found if isinstance(found, Motion) else None

    usual = {"units": ASE_UNITS, "motion": engine(), "interval": interval * dynamics.dt}
    writer = TrajectoryWriter(path, len(atoms), **{**usual, **options})
    observed = writer.path.suffix.upper() == ".H5MD"

    def report() -> None:
        if observed and "motion" not in options:
            writer.motion = _followed(writer, engine())
        forces = applied_forces(atoms) if (observed and writer.motion is not None) or options.get("forces") else None
        time, v = float(dynamics.get_time()), velocities_of(atoms, dynamics)
        writer.write(atoms.positions, v, time=time, cell=box(), forces=forces, step=dynamics.nsteps)

    dynamics.attach(report, interval=interval)
    return writer


def _followed(writer: TrajectoryWriter, now: Motion | None) -> Motion | None:
    """What is held now. Targets may have changed; the rows may not, nor what the file says they are."""
    held = [[] if m is None else m.constraint_set.constraints for m in (writer.motion, now)]
    if not all(a and b and a.family == b.family and np.array_equal(a.atoms, b.atoms) for a, b in zip_longest(*held)):
        raise InputError(
            f"the constraints are no longer those that {writer.path.name} was begun with; write a new file: close this "
            "writer, take it off (dynamics.observers) and call write_ase again",
            item="constraints",
        )
    return now


class OpenMMReporter:
    """A reporter of OpenMM that writes through MDAnalysis; append it to `simulation.reporters`.

    Parameters
    ----------
    path : path
    interval : int
        Steps between frames.
    **options
        For `TrajectoryWriter`: `motion` in OpenMM's units; ``forces=True`` for forces, and multipliers with them.
    """

    def __init__(self, path: str | Path, interval: int, **options: Any) -> None:
        self.path, self.interval = Path(path), whole_number(interval, "interval")
        self._options, self._forces = options, bool(options.get("forces"))
        self.writer: TrajectoryWriter | None = None

    def describeNextReport(self, simulation: Any) -> tuple[int, bool, bool, bool, bool, bool]:
        """What OpenMM asks reporters for: steps to go, and which data."""
        return self.interval - simulation.currentStep % self.interval, True, True, self._forces, False, False

    def report(self, simulation: Any, state: Any) -> None:
        """Write a frame."""
        x, v = (get(asNumpy=True)._value for get in (state.getPositions, state.getVelocities))  # nm and ps
        f = state.getForces(asNumpy=True)._value if self._forces else None
        periodic = simulation.system.usesPeriodicBoundaryConditions()
        cell = state.getPeriodicBoxVectors(asNumpy=True)._value if periodic else None
        if self.writer is None:
            own = {"units": OPENMM_UNITS, "interval": self.interval * simulation.integrator.getStepSize()._value}
            self.writer = TrajectoryWriter(self.path, len(x), **(own | self._options))
        self.writer.write(x, v, time=state.getTime()._value, cell=cell, forces=f, step=simulation.currentStep)

    def close(self) -> None:
        """Close the file."""
        if self.writer is not None:
            self.writer.close()
