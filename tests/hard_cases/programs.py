"""The programs side by side: the core of kcons, its parts for ASE and OpenMM, and ASE and OpenMM by themselves.

All take the same `Problem`, run it, and show every frame to a watcher. Peers run at the settings that are best for
them: ASE's FixBondLengths at its tolerance of 1e-13, OpenMM on the Reference platform (double precision) at 1e-12.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import openmm
from ase import Atoms
from ase.calculators.calculator import Calculator, all_changes
from ase.constraints import FixAtoms, FixBondLengths, FixInternals
from ase.md.verlet import VelocityVerlet
from openmm import unit

from hard_cases.problem import Array, Problem
from kcons.ase import ConstrainedDynamics, Constraints
from kcons.comparison.runs import InAse, InOpenMM, OnArrays, Run
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import KconsError
from kcons.motion.motion import Motion
from kcons.openmm import ProjectedIntegrator, hold
from kcons.steppers import Rattle, Stepper, System


class CannotExpressError(Exception):
    """The program has no means to state the problem; the message says which are missing."""


class Frame(NamedTuple):
    """What is seen of a run: positions, velocities, energies; NaN where a program does not tell."""

    x: Array
    v: Array
    kinetic: float
    potential: float

    energy = property(lambda self: self.kinetic + self.potential)


class Seen:
    """A watcher that keeps the largest residual, NaN once anything is, all energies, and the last frame."""

    def __init__(self, problem: Problem) -> None:
        self.problem, self.residual, self.end = problem, 0.0, Frame(problem.x, problem.v, np.nan, np.nan)
        self.energies: list[float] = []

    def __call__(self, frame: Frame) -> None:
        self.residual = float(np.maximum(self.residual, self.problem.residual(frame.x)))
        self.energies.append(frame.energy)

    @property
    def energy_off(self) -> float:
        """Largest relative change from the second on: the first of a leapfrog is of velocities half a step earlier."""
        return float(np.max(np.abs(np.array(self.energies[1:]) / self.energies[1] - 1)))


class NotIntactError(AssertionError):
    """A call that failed has changed its input."""


class Program:
    """Something that can run a problem; its name is one of `SYSTEMS`."""

    name: str
    #: The engine of a problem, by time step, at its start or, if so, once it was brought onto the constraints.
    begin: Callable[[Problem, float, bool], Run]
    #: Gives a run other positions, such as those wrapped into a cell, and leaves the velocities as they are.
    put: Callable[[Any, Array], None]
    #: Of a problem, as the program counts them.
    degrees_of_freedom: Callable[[Problem], int]
    #: How long runs may be, as a part of what a case asks for.
    pace = 1.0

    def length(self, quick: bool, short: int, full: int) -> int:
        """Steps to run: `short` for a quick look, else `full`; fewer for slow programs."""
        return max(10, round(self.pace * (short if quick else full)))

    def seen(self, problem: Problem, dt: float, steps: int, *watches: Callable[[Frame], Any], **how: Any) -> Seen:
        """Run and say what was seen of it."""
        seen = Seen(problem)
        seen.end = self.run(problem, dt, steps, seen, *watches, **how)
        return seen

    def run(
        self,
        problem: Problem,
        dt: float,
        steps: int,
        *watches: Callable[[Frame], Any],
        every: int = 1,
        project: bool = False,
        wrap: bool = False,
    ) -> Frame:
        """Run and return the last frame; `watches` see the start and every `every` steps.

        `project` brings the start onto the constraints by the means the program offers for it, `wrap` puts atoms back
        into the cell after each step.
        """
        run = self.begin(problem, dt, project)

        def frame() -> Frame:
            x, v = run.observe()
            return Frame(x, v, self.kinetic(problem, run, v), problem.potential(x))

        done = 0
        while True:
            if watches and done % every == 0:
                told = frame()
                for watch in watches:
                    watch(told)
                if done and not np.all(np.isfinite(told.x)):
                    return told
            if done == steps:
                return frame()
            block = 1 if wrap else min(every, steps - done)
            run.advance(block)
            done += block
            if wrap:
                self.put(run, wrapped(run.observe()[0], problem.cell))

    def kinetic(self, problem: Problem, run: Any, v: Array) -> float:
        """Kinetic energy of a run, at velocities v."""
        return problem.kinetic(v)


def wrapped(x: Array, cell: Any) -> Array:
    """Atoms put into the cell one by one; those inside are not touched."""
    lattice = np.asarray(cell, dtype=float)
    return np.asarray(x - np.floor(x @ np.linalg.inv(lattice)) @ lattice)


# -- kcons on arrays -------------------------------------------------------------------------------------


class Core(Program):
    """`kcons.steppers`."""

    name = "kcons"

    def __init__(self, stepper: Stepper | None = None) -> None:
        self.stepper = stepper or Rattle()

    def system(self, problem: Problem) -> System:
        held = ConstraintSet(problem.rows(), problem.x, np.asarray(problem.masses), cell=problem.cell)
        forces = (problem.forces, problem.potential) if problem.has_forces else (None, None)
        return System(Motion(held, problem.x), forces[0], potential=forces[1])

    def run(self, problem: Problem, *args: Any, **options: Any) -> Frame:
        given = (np.asarray(problem.positions), np.asarray(problem.masses))
        before = [a.tobytes() for a in given]
        try:
            return super().run(problem, *args, **options)
        finally:
            if [a.tobytes() for a in given] != before:
                raise NotIntactError("input arrays were changed")

    def put(self, run: Any, x: Array) -> None:
        run.state = replace(run.state, positions=x)

    def begin(self, problem: Problem, dt: float, project: bool) -> Run:
        system = self.system(problem)
        self.stepper.check(system)
        return _Intact(system, system.initial_state(problem.x, problem.v, project=project), self.stepper, dt)

    def kinetic(self, problem: Problem, run: Any, v: Array) -> float:
        return run.system.kinetic_energy(v)

    def degrees_of_freedom(self, problem: Problem) -> int:
        return self.system(problem).motion.degrees_of_freedom


class _Intact(OnArrays):
    """Each step by itself; one that fails must leave the state before it as it was."""

    def advance(self, steps: int = 1) -> None:
        for _ in range(steps):
            x, v = self.observe()
            kept = (x.tobytes(), v.tobytes()) if len(x) < 100 else None
            try:
                super().advance()
            except KconsError as error:
                if kept and (x.tobytes(), v.tobytes()) != kept:
                    raise NotIntactError(f"the state before step {self.done + 1} was changed") from error
                raise


# -- ASE ----------------------------------------------------------------------------------------------


class PlainAse(Program):
    """ASE: FixBondLengths, FixInternals where angles are held, FixAtoms; VelocityVerlet."""

    name = "ASE"
    pace = 0.1
    #: What makes steps, of atoms and a time step.
    dynamics: Callable[[Any, float], Any] = VelocityVerlet

    def atoms(self, problem: Problem, *, project: bool = False) -> Any:
        """Atoms with a calculator and all that is held."""
        how = {"masses": problem.masses, "cell": problem.cell, "pbc": problem.cell is not None}
        atoms = Atoms("X" * problem.n_atoms, positions=problem.positions, **how)
        atoms.calc = Forces(problem)
        if project:  # as a person does who attaches constraints to a structure that is off them
            atoms.set_velocities(problem.v)
        self.hold(atoms, problem)
        self.restore(atoms) if project else atoms.set_velocities(problem.v)
        return atoms

    def hold(self, atoms: Any, problem: Problem) -> None:
        _refuse_others("ASE", problem)
        held: list[Any] = [FixAtoms(list(problem.fixed))] if len(problem.fixed) else []
        pairs, lengths = np.asarray(problem.pairs).tolist(), problem.held_lengths.tolist()
        degrees = zip(np.degrees(problem.held_angles).tolist(), np.asarray(problem.triples).tolist(), strict=True)
        if angles := [list(row) for row in degrees]:
            bonds = [list(row) for row in zip(lengths, pairs, strict=True)]
            held.append(FixInternals(bonds=bonds or None, angles_deg=angles, epsilon=1e-10))
        elif pairs:
            held.append(FixBondLengths(pairs, bondlengths=lengths))
        atoms.set_constraint(held)

    def restore(self, atoms: Any) -> None:
        """Onto the constraints: setting positions and momenta applies them."""
        atoms.set_positions(atoms.get_positions())
        atoms.set_momenta(atoms.get_momenta())

    def put(self, run: Any, x: Array) -> None:
        run.atoms.arrays["positions"][:] = x  # as atoms.wrap() does it: not through the constraints

    def begin(self, problem: Problem, dt: float, project: bool) -> Run:
        atoms = self.atoms(problem, project=project)
        return _AsRun(atoms, self.dynamics(atoms, dt), dt)

    def degrees_of_freedom(self, problem: Problem) -> int:
        return int(self.atoms(problem).get_number_of_degrees_of_freedom())


class _AsRun(InAse):
    """As a person does who looks at every step."""

    def advance(self, steps: int = 1) -> None:
        for _ in range(steps):
            self.dynamics.run(1)
        self.done += steps


class KconsInAse(PlainAse):
    """The constraint object of kcons on ASE's atoms, run by `ConstrainedDynamics`."""

    name = "kcons in ASE"
    pace = 1.0

    def __init__(self, dynamics: Callable[[Any, float], Any] = ConstrainedDynamics) -> None:
        self.dynamics = dynamics

    def hold(self, atoms: Any, problem: Problem) -> None:
        atoms.set_constraint(Constraints(problem.rows()))

    def restore(self, atoms: Any) -> None:
        atoms.constraints[0].restore(atoms)


class Forces(Calculator):
    implemented_properties = ["energy", "forces"]

    def __init__(self, problem: Problem) -> None:
        super().__init__()
        self.problem = problem

    def calculate(self, atoms: Any = None, properties: Any = ("energy",), system_changes: Any = all_changes) -> None:
        super().calculate(atoms, properties, system_changes)
        x = np.asarray(atoms.get_positions())
        self.results = {"energy": self.problem.potential(x), "forces": self.problem.forces(x)}


def _refuse_others(program: str, problem: Problem) -> None:
    if problem.others:
        raise CannotExpressError(f"{program} has no {', '.join(sorted({c.family for c in problem.others}))}")


# -- OpenMM -------------------------------------------------------------------------------------------


class PlainOpenMM(Program):
    """OpenMM: addConstraint and VerletIntegrator (leapfrog) on the Reference platform."""

    name = "OpenMM"
    tolerance = 1e-12

    def bare_system(self, problem: Problem) -> Any:
        """Particles and forces, nothing held."""
        system = openmm.System()
        for k, mass in enumerate(problem.m):
            system.addParticle(0.0 if k in problem.fixed else float(mass))
        if problem.cell is not None:
            system.setDefaultPeriodicBoxVectors(*np.asarray(problem.cell, dtype=float))
            # Something must know of the box for the System to be periodic.
            periodic = openmm.CustomBondForce("0")
            periodic.setUsesPeriodicBoundaryConditions(True)
            system.addForce(periodic)
        alone = problem.but(springs=())
        if alone.has_forces:

            def forces(state: Any) -> tuple[float, Array]:
                x = np.asarray(state.getPositions(asNumpy=True)._value)
                return alone.potential(x), alone.forces(x)

            system.addForce(openmm.PythonForce(forces))
        if problem.springs:
            bonds = openmm.HarmonicBondForce()
            for i, j, constant, rest in problem.springs:
                bonds.addBond(i, j, rest, constant)
            system.addForce(bonds)
        return system

    def build(self, problem: Problem, dt: float) -> tuple[Any, Any, Any]:
        """System, integrator, and what applies constraints to a context."""
        system = self.bare_system(problem)
        _refuse_others("OpenMM", problem)
        pairs = dict(zip([(min(p), max(p)) for p in problem.pairs], problem.held_lengths, strict=True))
        for (i, j), length in zip(problem.pairs, problem.held_lengths, strict=True):
            system.addConstraint(int(i), int(j), float(length))
        for (i, j, k), angle in zip(problem.triples, problem.held_angles, strict=True):
            arms = [pairs.get((min(a, j), max(a, j))) for a in (i, k)]
            if None in arms:
                raise CannotExpressError("OpenMM holds an angle only as a third distance between two held bonds")
            a, b = (float(arm) for arm in arms if arm is not None)
            system.addConstraint(int(i), int(k), float(np.sqrt(a * a + b * b - 2 * a * b * np.cos(angle))))
        integrator = openmm.VerletIntegrator(dt)
        integrator.setConstraintTolerance(self.tolerance)
        return system, integrator, None

    def context(self, system: Any, integrator: Any) -> Any:
        return openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))

    def put(self, run: Any, x: Array) -> None:
        run.context.setPositions(x)

    def start(self, problem: Problem, context: Any, part: Any, dt: float, project: bool) -> None:
        context.setPositions(problem.x)
        back = np.zeros_like(v := problem.v)
        # Velocities of the leapfrog belong to half a step earlier.
        if not project and (np.any(v) or problem.has_forces):
            with suppress(KconsError, np.linalg.LinAlgError):
                back = 0.5 * dt * problem.acceleration(problem.x, v)
        context.setVelocities(v - back)
        if project:
            context.applyConstraints(self.tolerance)
            context.applyVelocityConstraints(self.tolerance)

    def begin(self, problem: Problem, dt: float, project: bool) -> Run:
        if dt <= 0:
            raise CannotExpressError("OpenMM takes no steps back and none of zero length")
        system, integrator, part = self.build(problem, dt)
        context = self.context(system, integrator)
        self.start(problem, context, part, dt, project)
        return InOpenMM(context, integrator, dt)

    def kinetic(self, problem: Problem, run: Any, v: Array) -> float:
        return float(run.context.getState(energy=True).getKineticEnergy()._value)

    def degrees_of_freedom(self, problem: Problem) -> int:
        """Three for each particle with a mass less the number of constraints, as StateDataReporter counts."""
        system, integrator, _ = self.build(problem, 0.001)
        self.context(system, integrator)
        moving = sum(system.getParticleMass(k)._value > 0 for k in range(system.getNumParticles()))
        return 3 * moving - int(system.getNumConstraints())


class KconsInOpenMM(PlainOpenMM):
    """`ProjectedIntegrator` with the rows carried by kcons."""

    name = "kcons in OpenMM"

    def __init__(self, ensemble: Any = None) -> None:
        self.ensemble = ensemble

    def build(self, problem: Problem, dt: float) -> tuple[Any, Any, Any]:
        system, step = self.bare_system(problem.but(fixed=())), dt * unit.picosecond
        rows = problem.rows()
        parts = [hold(system, rows, problem.x, take="all", keep_water=False)] if rows else []
        return system, ProjectedIntegrator(step, parts=parts, ensemble=self.ensemble), parts[0] if parts else None

    def start(self, problem: Problem, context: Any, part: Any, dt: float, project: bool) -> None:
        context.setPositions(problem.x)
        context.setVelocities(problem.v)
        if part is not None and not project:
            part.check(context)
        elif part is not None:
            part.apply_positions(context)
            part.apply_velocities(context)

    def degrees_of_freedom(self, problem: Problem) -> int:
        system, integrator, _ = self.build(problem, 0.001)
        context = self.context(system, integrator)
        context.setPositions(problem.x)
        return int(integrator.degrees_of_freedom(context))


PROGRAMS = {program.name: program for program in (Core, KconsInAse, KconsInOpenMM, PlainAse, PlainOpenMM)}


def quiet(function: Callable[[], Any]) -> tuple[Any, str]:
    """What a call returns, and the text of the first warning that is not NumPy's about arithmetic."""
    with warnings.catch_warnings(record=True) as seen, np.errstate(all="ignore"):
        warnings.simplefilter("always")
        found = function()
    told = [w for w in seen if not issubclass(w.category, (RuntimeWarning, DeprecationWarning, FutureWarning))]
    return found, " ".join(str(told[0].message).split()) if told else ""
