"""Windows sampled by OpenMM."""

from __future__ import annotations

import io
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import openmm
from numpy.typing import ArrayLike
from openmm import app, unit

from kcons.constraints import Angle, Constraint, Dihedral, Distance, DistanceDifference, Formula
from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError
from kcons.free_energy.held_coordinates import named
from kcons.free_energy.openmm_reporter import HeldCoordinatesReporter
from kcons.free_energy.series import Series
from kcons.free_energy.windows.window import Held, Settings, Window, angles_of, digest_of, scales_of
from kcons.openmm import CollectiveRows, Isokinetic, Langevin, NoseHoover, ProjectedIntegrator, Row
from kcons.openmm.callback_rows.callbacks import cell_of
from kcons.openmm.callback_rows.carried_constraints import refuse_virtual_sites, with_massless_atoms
from kcons.openmm.callback_rows.hold import constraints_about
from kcons.openmm.collective.coordinates import formula_rows
from kcons.openmm.integrator.guard import positions_of, velocities_of
from kcons.openmm.quantities import masses_of, nanometers
from kcons.openmm.topology import bonds_of

#: What a relaxation leaves of the forces, kJ/mol/nm.
_FORCE = 50.0
#: Part of the box by which files round it.
_SAME_BOX = 1e-3


class OpenMMWindows:
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
        A coordinate of another kind, or of virtual sites; a barostat.
    KconsError
        At `begin`: a coordinate that is undefined at the structure or depends on the constraints of the System.
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
        n = system.getNumParticles()
        _refuse_another(topology, system)
        self.positions = nanometers(positions, n)
        self.coordinates = named(coordinates)
        self.names = tuple(self.coordinates)
        self.angles = angles_of(self.coordinates)
        self.scales = scales_of(self.coordinates, 10.0)
        self.platform, self.properties = platform, dict(properties or {})
        self._system = openmm.XmlSerializer.serialize(system)
        self.digest = digest_of(self._system, self.positions, list(self.coordinates.values()))
        self._bonds: IntArray = bonds_of(system, self.positions)
        # A Topology cannot be pickled where its elements are; what a Simulation needs of it is the number of atoms.
        self._n = n
        for name, item in self.coordinates.items():
            _force_of(name, item, system.usesPeriodicBoundaryConditions())

    def _rows(self, system: openmm.System) -> Held:
        masses = masses_of(system)
        given = tuple(self.coordinates.values())
        touched = np.unique(np.concatenate([item.atoms.ravel() for item in given]))
        refuse_virtual_sites(system, touched, masses)
        others = [*constraints_about(system, touched), *with_massless_atoms(given, masses)[len(given) :]]
        wraps = system.usesPeriodicBoundaryConditions()
        return Held(
            self.coordinates,
            others,
            self.positions,
            np.where(masses > 0, masses, 1.0),
            cell_of(system.getDefaultPeriodicBoxVectors()) if wraps else None,
            True,
            lambda: self._bonds,
        )

    def begin(self) -> tuple[FloatArray, FloatArray]:
        return self._rows(openmm.XmlSerializer.deserialize(self._system)).begin()

    def sample(self, window: Window, settings: Settings, file: Path) -> None:
        began = time.process_time()
        dt = settings.timestep / 1000
        langevin = Langevin(settings.temperature, settings.friction)
        held = self._rows(openmm.XmlSerializer.deserialize(self._system))
        simulation = self._simulation(window.start, self._rates(window, settings), langevin, dt, window)
        self._begin(simulation, held, window, settings)
        simulation.step(settings.pull)
        ensemble: Any = langevin
        if settings.thermostat == "nose-hoover":
            ensemble = NoseHoover(settings.temperature, settings.friction)
        elif settings.thermostat == "isokinetic":
            ensemble = Isokinetic(settings.temperature)
        x = positions_of(simulation.context)
        simulation = self._simulation(window.target, [0.0] * len(self.names), ensemble, dt, window)
        simulation.context.setPositions(x)
        integrator: Any = simulation.integrator
        integrator.applyConstraints()
        integrator.setVelocitiesToTemperature(simulation.context, settings.temperature, (window.seed + 1) % 2**31)
        if settings.thermostat != "langevin":
            _without_momentum(simulation.context, held)
        simulation.step(settings.equilibration)
        series = self._recorded(simulation, settings.every, settings.production)
        series.seconds = time.process_time() - began
        series.save(file)

    def pull(self, window: Window, settings: Settings, file: Path) -> None:
        dt = settings.timestep / 1000
        langevin = Langevin(settings.temperature, settings.friction)
        held = self._rows(openmm.XmlSerializer.deserialize(self._system))
        simulation = self._simulation(window.start, [0.0] * len(self.names), langevin, dt, window)
        self._begin(simulation, held, window, settings)
        simulation.step(settings.equilibration)
        x, v = positions_of(simulation.context), velocities_of(simulation.context)
        simulation = self._simulation(window.start, self._rates(window, settings), langevin, dt, window)
        simulation.context.setPositions(x)
        simulation.context.setVelocities(v)
        integrator: Any = simulation.integrator
        integrator.applyVelocityConstraints()
        self._recorded(simulation, 1, settings.pull, start=True).save(file)

    def _begin(self, simulation: app.Simulation, held: Held, window: Window, settings: Settings) -> None:
        """To the start of a window, relaxed, with velocities."""
        simulation.context.setPositions(held.placed(window.start)[1])
        integrator: Any = simulation.integrator
        if settings.relax:
            integrator.minimizeEnergy(simulation.context, _FORCE, settings.relax)
        integrator.setVelocitiesToTemperature(simulation.context, settings.temperature, window.seed % 2**31)

    def _rates(self, window: Window, settings: Settings) -> list[float]:
        """In nm or radian in a ps."""
        duration = max(settings.pull, 1) * settings.timestep / 1000
        return [(b - a) / duration for a, b in zip(window.start, window.target, strict=True)]

    def _recorded(self, simulation: app.Simulation, every: int, steps: int, *, start: bool = False) -> Series:
        simulation.currentStep = 0
        reporter = HeldCoordinatesReporter(io.StringIO(), every, self.coordinates)
        if start:
            groups = simulation.integrator.getIntegrationForceGroups()
            reporter.report(
                simulation, simulation.context.getState(positions=True, velocities=True, forces=True, groups=groups)
            )
        simulation.reporters.append(reporter)
        simulation.step(steps)
        return reporter.series

    def _simulation(
        self, targets: Sequence[float], rates: Sequence[float], ensemble: Any, dt: float, window: Window
    ) -> app.Simulation:
        system = openmm.XmlSerializer.deserialize(self._system)
        wraps = system.usesPeriodicBoundaryConditions()
        rows = [
            Row(_force_of(name, item, wraps), float(target), float(rate), period=item.period, name=name)
            for (name, item), target, rate in zip(self.coordinates.items(), targets, rates, strict=True)
        ]
        part = CollectiveRows(system, rows, positions=self.positions)
        integrator = ProjectedIntegrator(dt * unit.picosecond, parts=[part], ensemble=ensemble)
        integrator.setRandomNumberSeed(window.seed % 2**31 + 1)
        chosen = [] if self.platform is None else [openmm.Platform.getPlatformByName(self.platform), self.properties]
        topology = app.Topology()
        residue = topology.addResidue("X", topology.addChain())
        for _ in range(self._n):
            topology.addAtom("X", None, residue)
        return app.Simulation(topology, system, integrator, *chosen)


def _refuse_another(topology: app.Topology, system: openmm.System) -> None:
    """Refuse a Topology that is not of this System, and Systems whose box would change."""
    if topology.getNumAtoms() != system.getNumParticles():
        raise InputError(
            f"the Topology has {topology.getNumAtoms()} atoms and the System {system.getNumParticles()} particles; "
            "give those of one structure",
            item="topology",
        )
    box = topology.getPeriodicBoxVectors()
    if box is not None and system.usesPeriodicBoundaryConditions():
        mine, its = cell_of(box), cell_of(system.getDefaultPeriodicBoxVectors())
        if np.abs(mine - its).max() > _SAME_BOX * np.abs(its).max():
            raise InputError(
                f"the box of the Topology is {mine.tolist()} nm, and that of the System, which windows are sampled in, "
                f"{its.tolist()}; give it by system.setDefaultPeriodicBoxVectors(*topology.getPeriodicBoxVectors()), "
                "or take the structure that the System was made for",
                item="topology",
            )
    barostats = [type(force).__name__ for force in system.getForces() if "Barostat" in type(force).__name__]
    if barostats:
        raise UnsupportedError(f"the System has a {barostats[0]}; windows are sampled in a box at rest: remove it")


def _without_momentum(context: openmm.Context, held: Held) -> None:
    """Take total momentum out, which thermostats that scale velocities never forget, where no row knows a place."""
    if all(row.translation_invariant for row in [*held.coordinates.values(), *held.others]):
        masses = masses_of(context.getSystem())
        v = velocities_of(context)
        v[masses > 0] -= masses @ v / masses.sum()
        context.setVelocities(v)


def _force_of(name: str, item: Constraint, periodic: bool) -> openmm.Force:
    """The coordinate as a Force of OpenMM."""
    if item.n_rows != 1:
        raise UnsupportedError(f"{name} is {item!r}; a coordinate of windows is one row")
    atoms = item.atoms[0].tolist()
    force: Any
    if isinstance(item, Formula):
        return formula_rows(item)[0].force
    if isinstance(item, Distance):
        force = openmm.CustomBondForce("r")
        force.addBond(*atoms, [])
    elif isinstance(item, Angle):
        force = openmm.CustomAngleForce("theta")
        force.addAngle(*atoms, [])
    elif isinstance(item, Dihedral):
        force = openmm.CustomTorsionForce("theta")
        force.addTorsion(*atoms, [])
    elif isinstance(item, DistanceDifference):
        terms = (f"({w!r})*distance(p{i + 1},p{j + 1})" for (i, j), w in zip(item.slots, item.weights, strict=True))
        force = openmm.CustomCompoundBondForce(item.width, "+".join(terms))
        force.addBond(atoms, [])
    else:
        raise UnsupportedError(
            f"{name} is {item!r}; windows in OpenMM hold a Distance, a DistanceDifference, an Angle, a Dihedral or a "
            "Formula"
        )
    force.setUsesPeriodicBoundaryConditions(periodic)
    return force
