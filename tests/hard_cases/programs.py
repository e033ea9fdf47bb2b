"""The programs side by side: the core of kcons, its parts for ASE and OpenMM, and ASE and OpenMM by themselves.

All take the same `Problem`, run it, and show every frame to a watcher. Peers run at the settings that are best for
them: ASE's FixBondLengths at its tolerance of 1e-13, OpenMM on the Reference platform (double precision) at 1e-12.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hard_cases.problem import Array, Problem
from kcons.comparison.runs import InAse, InOpenMM, OnArrays, Run
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import KconsError
from kcons.motion.motion import Motion
from kcons.steppers import Rattle, Stepper, System


class CannotExpressError(Exception):
    """The program has no means to state the problem; the message says which are missing."""


@dataclass(frozen=True)
class Frame:
    """What is seen of a run: positions, velocities, energies; NaN where a program does not tell."""

    x: Array
    v: Array
    kinetic: float
    potential: float

    @property
    def energy(self) -> float:
        return self.kinetic + self.potential


Watch = Callable[[Frame], Any]


def together(*watches: Watch) -> Watch:
    """A watcher that tells several."""

    def watch(frame: Frame) -> None:
        for one in watches:
            one(frame)

    return watch


class NotIntactError(AssertionError):
    """A call that failed has changed its input."""


class Program:
    """Something that can run a problem; its name is one of `SYSTEMS`."""

    name = ""
    #: How long runs may be, as a part of what a case asks for.
    pace = 1.0

    def length(self, quick: bool, short: int, full: int) -> int:
        """Steps to run: `short` for a quick look, else `full`; fewer for slow programs."""
        return max(10, round(self.pace * (short if quick else full)))

    def run(
        self,
        problem: Problem,
        dt: float,
        steps: int,
        watch: Watch | None = None,
        *,
        every: int = 1,
        project: bool = False,
        wrap: bool = False,
        stepper: Stepper | None = None,
    ) -> Frame:
        """Run and return the last frame; `watch` sees the start and every `every` steps.

        `project` brings the start onto the constraints by the means the program offers for it, `wrap` puts atoms back
        into the cell after each step, `stepper` is for the core only.
        """
        run = self.begin(problem, dt, project, stepper)

        def frame() -> Frame:
            x, v = run.observe()
            return Frame(x, v, self.kinetic(problem, run, v), problem.potential(x))

        if watch:
            watch(frame())
        done = 0
        while done < steps:
            block = 1 if wrap else min(every, steps - done)
            run.advance(block)
            done += block
            if wrap:
                put(run, wrapped(run.observe()[0], problem.cell))
            if watch and done % every == 0:
                watch(seen := frame())
                if not np.all(np.isfinite(seen.x)):
                    return seen
        return frame()

    def begin(self, problem: Problem, dt: float, project: bool, stepper: Stepper | None) -> Run:
        """The engine, at the start."""
        raise NotImplementedError

    def kinetic(self, problem: Problem, run: Any, v: Array) -> float:
        """Kinetic energy of a run, at velocities v."""
        return problem.kinetic(v)

    def degrees_of_freedom(self, problem: Problem) -> int:
        """As the program counts them."""
        raise NotImplementedError


def wrapped(x: Array, cell: Any) -> Array:
    """Atoms put into the cell one by one; those inside are not touched."""
    lattice = np.asarray(cell, dtype=float)
    return np.asarray(x - np.floor(x @ np.linalg.inv(lattice)) @ lattice)


def put(run: Run, x: Array) -> None:
    """Other positions, such as those wrapped into a cell, and the velocities as they are."""
    if isinstance(run, OnArrays):
        run.state = replace(run.state, positions=x)
    elif isinstance(run, InAse):  # as atoms.wrap() does it: not through the constraints
        run.atoms.arrays["positions"][:] = x
    elif isinstance(run, InOpenMM):
        run.context.setPositions(x * run.length)
    else:
        raise TypeError(type(run).__name__)


# -- kcons on arrays -------------------------------------------------------------------------------------


class Core(Program):
    """`kcons.steppers`."""

    name = "kcons"

    def system(self, problem: Problem, **options: Any) -> System:
        held = ConstraintSet(problem.rows(), problem.x, np.asarray(problem.masses), cell=problem.cell)
        motion = Motion(held, problem.x, **options)
        return System(
            motion,
            (lambda x, t: problem.forces(x)) if problem.has_forces else None,
            potential=(lambda x, t: problem.potential(x)) if problem.has_forces else None,
        )

    def run(self, problem: Problem, *args: Any, **options: Any) -> Frame:
        given = (np.asarray(problem.positions), np.asarray(problem.masses))
        before = [a.tobytes() for a in given]
        try:
            return super().run(problem, *args, **options)
        finally:
            if [a.tobytes() for a in given] != before:
                raise NotIntactError("input arrays were changed")

    def begin(self, problem: Problem, dt: float, project: bool, stepper: Stepper | None) -> Run:
        system = self.system(problem)
        stepper = Rattle() if stepper is None else stepper
        stepper.check(system)
        return _Intact(system, system.initial_state(problem.x, problem.v, project=project), stepper, dt)

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

    def atoms(self, problem: Problem, *, project: bool = False) -> Any:
        """Atoms with a calculator and all that is held."""
        from ase import Atoms

        atoms = Atoms(
            "X" * problem.n_atoms,
            positions=problem.positions,
            masses=problem.masses,
            cell=problem.cell,
            pbc=problem.cell is not None,
        )
        atoms.calc = _calculator(problem)
        if project:
            # As a person does who attaches constraints to a structure that is off them.
            atoms.set_velocities(problem.v)
        self.hold(atoms, problem)
        if project:
            self.put(atoms)
        else:
            atoms.set_velocities(problem.v)
        return atoms

    def hold(self, atoms: Any, problem: Problem) -> None:
        if problem.others:
            raise CannotExpressError(f"ASE has no {', '.join(sorted({c.family for c in problem.others}))}")
        from ase.constraints import FixAtoms, FixBondLengths, FixInternals

        held: list[Any] = [FixAtoms(list(problem.fixed))] if len(problem.fixed) else []
        pairs, lengths = np.asarray(problem.pairs).tolist(), np.asarray(problem.held_lengths).tolist()
        degrees, triples = np.degrees(problem.held_angles).tolist(), np.asarray(problem.triples).tolist()
        if degrees:
            bonds, angles = zip(lengths, pairs, strict=True), zip(degrees, triples, strict=True)
            rows = [list(map(list, bonds)) or None, list(map(list, angles))]
            held.append(FixInternals(bonds=rows[0], angles_deg=rows[1], epsilon=1e-10))
        elif pairs:
            held.append(FixBondLengths(pairs, bondlengths=lengths))
        atoms.set_constraint(held)

    def dynamics(self, atoms: Any, dt: float) -> Any:
        """What makes steps."""
        from ase.md.verlet import VelocityVerlet

        return VelocityVerlet(atoms, timestep=dt)

    def put(self, atoms: Any) -> None:
        """Onto the constraints: setting positions and momenta applies them."""
        atoms.set_positions(atoms.get_positions())
        atoms.set_momenta(atoms.get_momenta())

    def begin(self, problem: Problem, dt: float, project: bool, stepper: Stepper | None) -> Run:
        if stepper is not None:
            raise CannotExpressError("one scheme only")
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

    def __init__(self, own_dynamics: bool = True, thermostat: Callable[[Any, float], Any] | None = None) -> None:
        #: False for ASE's VelocityVerlet.
        self.own_dynamics = own_dynamics
        #: Dynamics of atoms and time step, instead of `ConstrainedDynamics`.
        self.thermostat = thermostat

    def dynamics(self, atoms: Any, dt: float) -> Any:
        from kcons.ase import ConstrainedDynamics

        if self.thermostat is not None:
            return self.thermostat(atoms, dt)
        return ConstrainedDynamics(atoms, dt) if self.own_dynamics else super().dynamics(atoms, dt)

    def hold(self, atoms: Any, problem: Problem) -> None:
        from kcons.ase import Constraints

        atoms.set_constraint(Constraints(problem.rows()))

    def put(self, atoms: Any) -> None:
        atoms.constraints[0].restore(atoms)


def _calculator(problem: Problem) -> Any:
    from ase.calculators.calculator import Calculator, all_changes

    class Forces(Calculator):
        implemented_properties = ["energy", "forces"]

        def calculate(
            self, atoms: Any = None, properties: Any = ("energy",), system_changes: Any = all_changes
        ) -> None:
            super().calculate(atoms, properties, system_changes)
            x = np.asarray(atoms.get_positions())
            self.results = {"energy": problem.potential(x), "forces": problem.forces(x)}

    return Forces()


# -- OpenMM -------------------------------------------------------------------------------------------


class PlainOpenMM(Program):
    """OpenMM: addConstraint and VerletIntegrator (leapfrog) on the Reference platform."""

    name = "OpenMM"
    tolerance = 1e-12

    def bare_system(self, problem: Problem) -> Any:
        """Particles and forces, nothing held."""
        import openmm

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
        import openmm

        system = self.bare_system(problem)
        if problem.others:
            raise CannotExpressError(f"OpenMM has no {', '.join(sorted({c.family for c in problem.others}))}")
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
        import openmm

        return openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))

    def start(self, problem: Problem, context: Any, part: Any, dt: float, project: bool) -> None:
        context.setPositions(problem.x)
        v = problem.v
        if project:
            context.setVelocities(v)
            context.applyConstraints(self.tolerance)
            context.applyVelocityConstraints(self.tolerance)
        else:
            # Velocities of the leapfrog belong to half a step earlier.
            free = not np.any(v) and not problem.has_forces
            try:
                back = np.zeros_like(v) if free else 0.5 * dt * problem.acceleration(problem.x, v)
            except (KconsError, np.linalg.LinAlgError):
                back = np.zeros_like(v)
            context.setVelocities(v - back)

    def begin(self, problem: Problem, dt: float, project: bool, stepper: Stepper | None) -> Run:
        if stepper is not None:
            raise CannotExpressError("one scheme only")
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
        #: For `ProjectedIntegrator`.
        self.ensemble = ensemble

    def build(self, problem: Problem, dt: float) -> tuple[Any, Any, Any]:
        from openmm import unit

        from kcons.openmm import ProjectedIntegrator, hold

        system, step = self.bare_system(problem.but(fixed=()) if len(problem.fixed) else problem), dt * unit.picosecond
        rows = problem.rows()
        if not rows:
            return system, ProjectedIntegrator(step, ensemble=self.ensemble), None
        part = hold(system, rows, problem.x, take="all", keep_water=False)
        return system, ProjectedIntegrator(step, parts=[part], ensemble=self.ensemble), part

    def start(self, problem: Problem, context: Any, part: Any, dt: float, project: bool) -> None:
        context.setPositions(problem.x)
        context.setVelocities(problem.v)
        if part is not None:
            if project:
                part.apply_positions(context)
                part.apply_velocities(context)
            else:
                part.check(context)

    def degrees_of_freedom(self, problem: Problem) -> int:
        system, integrator, _ = self.build(problem, 0.001)
        context = self.context(system, integrator)
        context.setPositions(problem.x)
        return int(integrator.degrees_of_freedom(context))


PROGRAMS: dict[str, type[Program]] = {
    program.name: program for program in (Core, KconsInAse, KconsInOpenMM, PlainAse, PlainOpenMM)
}


def quiet(function: Callable[[], Any]) -> tuple[Any, str]:
    """What a call returns, and the text of the first warning that is not NumPy's about arithmetic."""
    with warnings.catch_warnings(record=True) as seen, np.errstate(all="ignore"):
        warnings.simplefilter("always")
        found = function()
    told = [w for w in seen if not issubclass(w.category, (RuntimeWarning, DeprecationWarning, FutureWarning))]
    return found, " ".join(str(told[0].message).split()) if told else ""
