"""Windows sampled by OpenMM."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import openmm
from numpy.typing import ArrayLike
from openmm import app, unit

from kcons.constraints import Angle, Constraint, Dihedral, Distance, DistanceDifference, Formula
from kcons.constraints.constraint import IntArray
from kcons.errors import InputError, UnsupportedError
from kcons.free_energy.openmm_reporter import HeldCoordinatesReporter
from kcons.free_energy.series import Series
from kcons.free_energy.windows.window import Held, Sampler, Settings, Thermostat, Window, digest_of
from kcons.openmm import CollectiveRows, Isokinetic, Langevin, NoseHoover, ProjectedIntegrator, Row
from kcons.openmm.callback_rows.callbacks import cell_of
from kcons.openmm.callback_rows.carried_constraints import refuse_virtual_sites, with_massless_atoms
from kcons.openmm.callback_rows.hold import constraints_about
from kcons.openmm.collective.coordinates import formula_rows
from kcons.openmm.quantities import masses_of, nanometers
from kcons.openmm.states import positions_of, velocities_of
from kcons.openmm.topology import bonds_of

#: What a relaxation leaves of the forces, kJ/mol/nm.
_FORCE = 50.0
#: Part of the box by which files round it.
_SAME_BOX = 1e-3


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
        super().__init__(coordinates, 10.0)
        self.positions = nanometers(positions, n)
        self.platform, self.properties = platform, dict(properties or {})
        self._system = openmm.XmlSerializer.serialize(system)
        self._bonds: IntArray = bonds_of(system, self.positions)
        for name, item in self.coordinates.items():
            _force_of(name, item, system.usesPeriodicBoundaryConditions())

    @property
    def digest(self) -> str:
        return digest_of(self._system, self.positions, list(self.coordinates.values()))

    def system(self) -> openmm.System:
        """A copy."""
        return openmm.XmlSerializer.deserialize(self._system)

    def rows(self) -> Held:
        system = self.system()
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

    def simulation(self, held: Held, window: Window, settings: Settings) -> _Simulation:
        return _Simulation(self, held, window, settings)


class _Simulation:
    """A run in OpenMM."""

    def __init__(self, sampler: OpenMMWindows, held: Held, window: Window, settings: Settings) -> None:
        self._sampler, self._held, self._settings = sampler, held, settings
        self._x, self._v = held.placed(window.start)[1], np.zeros_like(sampler.positions)
        if settings.relax:
            self.hold(window.start, window.start, "langevin", window.seed, None)
            self._integrator.minimizeEnergy(self.simulation.context, _FORCE, settings.relax)
            self._x = positions_of(self.simulation.context)
        self.simulation: app.Simulation

    @property
    def _integrator(self) -> Any:
        return self.simulation.integrator

    def hold(
        self, begin: Sequence[float], end: Sequence[float], thermostat: Thermostat, seed: int, velocities: int | None
    ) -> None:
        settings, sampler, dt = self._settings, self._sampler, self._settings.timestep / 1000
        system = sampler.system()
        duration, wraps = max(settings.pull, 1) * dt, system.usesPeriodicBoundaryConditions()
        rows = [
            Row(_force_of(name, item, wraps), float(a), (float(b) - float(a)) / duration, period=item.period, name=name)
            for (name, item), a, b in zip(sampler.coordinates.items(), begin, end, strict=True)
        ]
        ensemble: Any = Isokinetic(settings.temperature)
        if thermostat != "isokinetic":
            ensemble = (Langevin if thermostat == "langevin" else NoseHoover)(settings.temperature, settings.friction)
        part = CollectiveRows(system, rows, positions=sampler.positions)
        integrator = ProjectedIntegrator(dt * unit.picosecond, parts=[part], ensemble=ensemble)
        integrator.setRandomNumberSeed(seed % 2**31 + 1)
        platform = sampler.platform
        chosen = [] if platform is None else [openmm.Platform.getPlatformByName(platform), sampler.properties]
        topology = app.Topology()  # one with elements cannot be sent to other processes; this is all that is needed
        residue = topology.addResidue("X", topology.addChain())
        for _ in range(system.getNumParticles()):
            topology.addAtom("X", None, residue)
        self.simulation = app.Simulation(topology, system, integrator, *chosen)
        context = self.simulation.context
        context.setPositions(self._x)
        self._integrator.applyConstraints()
        if velocities is None:
            context.setVelocities(self._v)
            self._integrator.applyVelocityConstraints()
        else:
            self._integrator.setVelocitiesToTemperature(context, settings.temperature, velocities % 2**31)
            if thermostat != "langevin" and not self._held.knows_a_place:
                # Thermostats that scale velocities never forget the total momentum.
                masses, v = masses_of(system), velocities_of(context)
                v[masses > 0] -= masses @ v / masses.sum()
                context.setVelocities(v)

    def step(self, steps: int) -> None:
        self.simulation.step(steps)
        self._x, self._v = positions_of(self.simulation.context), velocities_of(self.simulation.context)

    def record(self, steps: int, every: int, *, start: bool = False) -> Series:
        simulation = self.simulation
        simulation.currentStep = 0
        reporter = HeldCoordinatesReporter(io.StringIO(), every, self._sampler.coordinates)
        if start:
            what: dict[str, Any] = {"positions": True, "velocities": True, "forces": True}
            what["groups"] = simulation.integrator.getIntegrationForceGroups()
            reporter.report(simulation, simulation.context.getState(**what))
        simulation.reporters.append(reporter)
        simulation.step(steps)
        return reporter.series


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
