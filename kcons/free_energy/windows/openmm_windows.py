"""Held coordinates in OpenMM's simulations: reported, and sampled window by window."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, TextIO

import numpy as np
import openmm
from numpy.typing import ArrayLike
from openmm import app, unit

from kcons.constraints import Constraint
from kcons.constraints.arguments import whole_number
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet, same_rows
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError
from kcons.free_energy.held_coordinates import HeldCoordinates, named
from kcons.free_energy.series import Series
from kcons.free_energy.windows.driver import Sampler, Settings, Window, digest_of
from kcons.openmm import CollectiveRows, DeviceIntegrator, Isokinetic, Langevin, ProjectedIntegrator, hold
from kcons.openmm.callback_rows import CarriedConstraints, constraints_about, refuse_virtual_sites
from kcons.openmm.device.device_integrator import choose
from kcons.openmm.quantities import (
    cell_of,
    masses_of,
    nanometers,
    positions_of,
    velocities_of,
    with_massless_atoms,
)
from kcons.openmm.topology import bonds_of

#: What a relaxation leaves of the forces, kJ/mol/nm.
_FORCE = 50.0
#: Part of the box by which files round it.
_SAME_BOX = 1e-3


def _beside(system: openmm.System, rows: Sequence[Constraint], masses: FloatArray) -> list[Constraint]:
    """What a System holds in the clusters of the atoms of some rows: its constraints, and particles without mass."""
    touched = np.unique(np.concatenate([row.atoms.ravel() for row in rows]))
    refuse_virtual_sites(system, touched, masses)
    return [*constraints_about(system, touched), *with_massless_atoms(tuple(rows), masses)[len(rows) :]]


def _turning(system: openmm.System, bonds: IntArray, masses: FloatArray) -> IntArray | None:
    """The bonds by which groups may be turned: all that is free to move must move with them.

    Forces on virtual sites are in those of the particles that they depend on: sites belong to no group.
    """
    virtual = np.array([system.isVirtualSite(k) for k in range(len(masses))])
    return bonds[~virtual[bonds].any(axis=1)] if np.all((masses > 0) | virtual) else None


class HeldCoordinatesReporter:
    """Writes held coordinates, their multipliers and ln det Z, in the manner of `openmm.app.StateDataReporter`.

    However a coordinate is held (by the System, by `CollectiveRows`, by `hold`), it is named by the constraint of kcons
    that measures it. What else is held on its atoms counts too: constraints of the System and those of `hold` are
    found, other rows of `CollectiveRows` have to be named, or given as `beside`.

    Parameters
    ----------
    file : path or text file
        Comma-separated columns: step, time in ps, then value and multiplier of each coordinate in kJ/mol, nm and
        radian, and ln det Z.
    reportInterval : int
        Steps from one report to the next.
    coordinates : mapping of str to Constraint
        Their numbers are of nm, ps, dalton, radian.
    beside : iterable of Constraint
        Other rows that are held on the same atoms.

    Attributes
    ----------
    series : Series
        All that was reported.

    Raises
    ------
    InputError
        At the first report: rows of `CollectiveRows` that are neither named nor given as `beside`.
        A report of another simulation than the first.
    UnsupportedError
        At the first report: a coordinate of a virtual site; a member of a CompoundIntegrator that may hold rows.

    Notes
    -----
    Velocities of the integrators of kcons belong to the positions. Those of OpenMM's leapfrog integrators are half a
    step off, and the part of the multipliers that is quadratic in them is then of first order only.
    """

    def __init__(
        self,
        file: str | PathLike[str] | TextIO,
        reportInterval: int,
        coordinates: Mapping[str, Constraint],
        *,
        beside: Iterable[Constraint] = (),
    ) -> None:
        self._interval = whole_number(reportInterval, "reportInterval")
        names = list(named(coordinates))
        self._coordinates = dict(zip(names, coordinates.values(), strict=True))
        self._beside = list(beside)
        self._own = not hasattr(file, "write")
        self._file: TextIO = open(file, "w", encoding="utf-8") if self._own else file  # type: ignore[arg-type, assignment] # noqa: SIM115
        self._held: HeldCoordinates | None = None
        self.series = Series(names)

    def describeNextReport(self, simulation: Any) -> tuple[int, bool, bool, bool, bool, bool]:
        """Steps to the next report, and that it takes positions, velocities and forces, not wrapped."""
        return (self._interval - simulation.currentStep % self._interval, True, True, True, False, False)

    def report(self, simulation: Any, state: openmm.State) -> None:
        """Write a line."""
        x, v, f, time = _state(state)
        if self._held is None:
            self._begin(simulation, x, time)
        elif simulation.context is not self._context:
            raise InputError("this reporter belongs to another simulation; make a new one for this", item="simulation")
        assert self._held is not None
        if self._set.lattice is not None:
            self._set.with_cell(cell_of(state.getPeriodicBoxVectors()))
        ensemble = getattr(simulation.integrator, "ensemble", None)
        if isinstance(ensemble, Isokinetic):
            self.series.isokinetic_degrees_of_freedom = ensemble.count(simulation.integrator)
        sample = self._held.sample(x, v, f, time)
        self.series.append(sample)
        numbers = [time, *np.stack([sample.value, sample.multiplier], axis=1).ravel(), sample.log_det_z]
        self._file.write(",".join([str(simulation.currentStep), *(f"{number:.12g}" for number in numbers)]) + "\n")
        self._file.flush()

    def _begin(self, simulation: Any, x: np.ndarray, time: float) -> None:
        system, integrator = simulation.system, simulation.integrator
        members = [integrator.getIntegrator(k) for k in range(getattr(integrator, "getNumIntegrators", int)())]
        if not {openmm.Integrator, openmm.CustomIntegrator}.isdisjoint(map(type, members)):
            raise UnsupportedError("a CompoundIntegrator does not tell what is held; simulate with its member alone")
        masses = masses_of(system)
        rows = [*self._beside, *self._coordinates.values()]
        parts = getattr(integrator, "parts", ())
        collective = sum(part.n_rows for part in parts if isinstance(part, CollectiveRows))
        carried = [c for p in parts if isinstance(p, CarriedConstraints) for c in p.motion.sources[0].constraints]
        if collective > (mine := sum(row.n_rows for row in rows)):
            raise InputError(
                f"CollectiveRows holds {collective} rows, and {mine} are named here; name them all, or give the "
                "others as beside: what is held beside a coordinate changes its mean force",
                item="beside",
            )
        # Those of `hold` know how their targets move.
        for row in rows:
            if new := [k for k in range(row.n_rows) if not any(same_rows(item, row, k).any() for item in carried)]:
                carried.append(row.select(new))
        lengths = {frozenset(pair) for row in carried if row.holds_length for pair in row.atoms.tolist()}
        for item in _beside(system, carried, masses):
            if new := [k for k, atoms in enumerate(item.atoms.tolist()) if frozenset(atoms) not in lengths]:
                carried.insert(0, item.select(new))
        wraps = system.usesPeriodicBoundaryConditions()
        cell = cell_of(simulation.context.getState().getPeriodicBoxVectors()) if wraps else None
        self._set = ConstraintSet(carried, x, np.where(masses > 0, masses, 1.0), cell=cell, time=time)
        known = all(isinstance(part, CollectiveRows | CarriedConstraints) for part in parts)
        bonds = _turning(system, bonds_of(system, x), masses) if known else None
        self._held = HeldCoordinates(self._set, self._coordinates, x, time=time, bonds=bonds)
        self._context = simulation.context
        self.series = Series(self._held.names, self._held.periods)
        titles = [title for name in self._held.names for title in (name, f"multiplier of {name}")]
        self._file.write("#" + ",".join(f'"{title}"' for title in ("Step", "Time (ps)", *titles, "ln det Z")) + "\n")

    def __del__(self) -> None:
        if getattr(self, "_own", False) and hasattr(self, "_file"):
            self._file.close()


class OpenMMWindows(Sampler):
    """Windows of an OpenMM System.

    Parameters
    ----------
    topology : openmm.app.Topology
        Of the same number of atoms, and the same box, as the System.
    system : openmm.System
        Without a barostat; its constraints are kept.
    positions : Quantity or array_like, shape (n_particles, 3)
        The structure that all windows start from, in nm if without unit.
    coordinates : mapping of str to Constraint
        What they are held at is set by the windows, in angstrom and radian; of a `Formula` in the unit that its text
        gives from positions in nm.
    platform : str, optional
    properties : mapping of str to str
        Of the platform.

    Raises
    ------
    InputError
        A Topology of another number of atoms, or of another box.
    UnsupportedError
        A barostat; a coordinate of virtual sites, or of several rows.
    KconsError
        A coordinate that is undefined at the structure or depends on the constraints of the System.
    """

    kJ = 1.0

    def __init__(
        self,
        topology: app.Topology,
        system: openmm.System,
        positions: unit.Quantity | ArrayLike,
        coordinates: Mapping[str, Constraint],
        *,
        platform: str | None = None,
        properties: Mapping[str, str] | None = None,
    ) -> None:
        if (atoms := topology.getNumAtoms()) != (particles := system.getNumParticles()):
            said = f"the Topology has {atoms} atoms and the System {particles} particles"
            raise InputError(f"{said}; give those of one structure", item="topology")
        wraps, box = system.usesPeriodicBoundaryConditions(), topology.getPeriodicBoxVectors()
        cell = cell_of(system.getDefaultPeriodicBoxVectors()) if wraps else None
        if box is not None and cell is not None and np.abs(cell_of(box) - cell).max() > _SAME_BOX * np.abs(cell).max():
            raise InputError(
                f"the box of the Topology is {cell_of(box).tolist()} nm, and that of the System, which windows are "
                f"sampled in, {cell.tolist()}; give it by "
                "system.setDefaultPeriodicBoxVectors(*topology.getPeriodicBoxVectors()), or take the structure that "
                "the System was made for",
                item="topology",
            )
        if barostats := [type(f).__name__ for f in system.getForces() if "Barostat" in type(f).__name__]:
            raise UnsupportedError(f"the System has a {barostats[0]}; windows are sampled in a box at rest: remove it")
        self.platform, self.properties = platform, dict(properties or {})
        self._system = openmm.XmlSerializer.serialize(system)
        x, masses = nanometers(positions, particles).copy(), masses_of(system)
        bonds, others = bonds_of(system, x), _beside(system, list(named(coordinates).values()), masses)
        where = (x, np.where(masses > 0, masses, 1.0), cell, True)
        super().__init__(coordinates, others, *where, bonds, _turning(system, bonds, masses), angstrom=10.0)

    @property
    def digest(self) -> str:
        return digest_of(self._system, self.positions, list(self.coordinates.values()))

    def system(self) -> openmm.System:
        """A copy."""
        return openmm.XmlSerializer.deserialize(self._system)

    def simulation(self, window: Window, settings: Settings) -> _Simulation:
        return _Simulation(self, window, settings)


def read_system(path: Path, item: str) -> openmm.System:
    """The System of an XML file; refuses one with a `PythonForce`, whose code would run while it is read."""
    if not path.is_file():
        raise InputError(f"there is no file {path}", item=item)
    text = path.read_text(encoding="utf-8", errors="replace")
    if "PythonForce" in text:
        raise InputError(
            f"{path} has a PythonForce in it, whose code would run while the file is read; make the System in Python "
            "where you trust it (OpenMMWindows)",
            item=item,
        )
    try:
        system = openmm.XmlSerializer.deserialize(text)
    except (ValueError, openmm.OpenMMException) as error:
        raise InputError(f"{path} is no System of OpenMM: {error}", item=item) from error
    if not isinstance(system, openmm.System):
        raise InputError(f"{path} has a {type(system).__name__} in it, no System", item=item)
    return system


class _Simulation:
    """A run in OpenMM."""

    def __init__(self, sampler: OpenMMWindows, window: Window, settings: Settings) -> None:
        self._sampler, self._settings = sampler, settings
        self._x, self._v = sampler.placed(window.start)[1], np.zeros_like(sampler.positions)
        self._seen = sampler.measured(window.target).seen
        if settings.relax:
            self.hold(window.start, window.start, window.seed, None)
            self._integrator.minimizeEnergy(self._context, _FORCE, settings.relax)
            self._x = positions_of(self._context)

    def hold(self, begin: Sequence[float], end: Sequence[float], seed: int, velocities: int | None) -> None:
        settings, sampler, dt = self._settings, self._sampler, self._settings.timestep / 1000
        system = sampler.system()
        ensemble = Langevin(settings.temperature, settings.friction)
        parts: list[Any] = list(sampler.towards(begin, end, settings.pull * dt))
        self._on_device = choose(None, dt, parts=parts, ensemble=ensemble)[0] is DeviceIntegrator
        if not self._on_device:
            parts = [hold(system, parts, self._x)]
        integrator: Any = ProjectedIntegrator(dt * unit.picosecond, parts=parts, ensemble=ensemble)
        if self._on_device:
            integrator.record(self._seen)
        integrator.setRandomNumberSeed(seed % 2**31 + 1)
        platform = sampler.platform
        chosen = [] if platform is None else [openmm.Platform.getPlatformByName(platform), sampler.properties]
        context = openmm.Context(system, integrator, *chosen)
        self._context, self._integrator = context, integrator
        context.setPositions(self._x)
        integrator.applyConstraints()
        if velocities is None:
            context.setVelocities(self._v)
            integrator.applyVelocityConstraints()
        else:
            integrator.setVelocitiesToTemperature(context, settings.temperature, velocities % 2**31)

    def step(self, steps: int) -> None:
        self._integrator.step(steps)
        self._x, self._v = positions_of(self._context), velocities_of(self._context)

    def run(self, steps: int, every: int, take: Callable[..., None]) -> None:
        if not self._on_device:
            for _ in range(steps // every):
                self._integrator.step(every)
                take(*self.state())
            return
        whole: FloatArray = np.zeros((3, *self._x.shape))
        for *seen, time in self._integrator.records(steps // every * every, every):
            whole[:, self._seen] = seen
            take(*whole, time)

    def state(self) -> tuple[FloatArray, FloatArray, FloatArray, float]:
        groups = self._integrator.getIntegrationForceGroups()
        return _state(self._context.getState(positions=True, velocities=True, forces=True, groups=groups))


def _state(state: openmm.State) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Positions, velocities, forces and time in nm and ps; Quantities take longer to make than the sample."""
    arrays = [np.empty((state._getNumParticles(), 3)) for _ in range(3)]
    for kind, array in zip((openmm.State.Positions, openmm.State.Velocities, openmm.State.Forces), arrays, strict=True):
        state._getVectorAsNumpy(kind, array)
    return arrays[0], arrays[1], arrays[2], state.getTime()._value
