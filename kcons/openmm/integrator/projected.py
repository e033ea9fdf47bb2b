"""The integrator: kicks and constrained drifts in turn, to order 2, 4 or 6."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from copy import deepcopy
from typing import Any, ClassVar, Self, cast

import numpy as np
import openmm
from openmm import unit

from kcons.constraints.arguments import Rng, positive, seed_from, whole_number
from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, InputError, KconsError, MissingSettingError, NonFiniteError, UnsupportedError
from kcons.openmm.integrator.guard import Guard, check_finite, find_context, require_context, warn_of_barostat
from kcons.openmm.integrator.part import TOLERANCES, Part, Precision
from kcons.openmm.integrator.program import ConstantEnergy, Ensemble, Program, to_scheme, write_step
from kcons.openmm.quantities import (
    forces_at,
    kelvins,
    masses_of,
    motion_of,
    number,
    positions_of,
    relative_tolerance,
    velocities_of,
)
from kcons.steppers.operations import Operation
from kcons.steppers.splitting import Splitting

#: A time step in ps without a unit that is longer may be one in fs.
_LONG = 0.02
#: Longest way of a particle in one step of a minimization, nm.
_STRIDE = 0.01
#: What `failed` is where others have moved x between two calls.
_MOVED = -1


class ProjectedIntegrator(openmm.CustomIntegrator):
    """Dynamics at constant energy on the constraints of the System, and on more where asked.

    One step is that of the same stepper in `kcons.steppers`: kicks v += h f/m, drifts along the constraints, and a
    projection of v at the end. The System's own constraints are solved by OpenMM (SETTLE, CCMA, SHAKE): its
    `constrainVelocities` is the projector M_par^+ M, its `constrainPositions` the drift's solve. Only the tolerance
    limits the accuracy.

    At the first step the integrator looks at the System and its Context: what it cannot propagate it refuses, and
    velocities are made tangent to the constraints. Later it checks at every `check_every` steps that positions and
    velocities are on all that is held, by the constraints of the System and the rows themselves: whether its solvers
    did converge OpenMM does not tell.

    Parameters
    ----------
    timestep : Quantity or float
        In ps if a float; more than 0. OpenMM refuses negative steps: to go back, turn the velocities round.
    scheme : str or Splitting
        'rattle' (velocity Verlet), 'geodesic', 'suzuki4', 'yoshida4', 'kahan-li6', 'blanes-moan4', 'blanes-moan6',
        'blanes-moan6a', 'isokinetic4', 'isokinetic6', or a splitting of kcons.steppers.
    parts : sequence of Part
        What else to hold: collective variables, surfaces, constraint objects of kcons.
    tolerance : float, optional
        Relative tolerance of the System's constraints. Left open, what the platform of the Context can hold: 1e-10 in
        double, 1e-8 in mixed and 1e-5 in single precision.
    check_every : int, optional
        Steps between two checks; 0 for none but the first. Left open, 100, and later, up to 10,000, where checks would
        take more than a hundredth of the time.
    ensemble : Ensemble, optional
        How velocities change between drifts; constant energy by default.
    device : bool, optional
        Whether a compiled plugin makes the steps, see `kcons.openmm.device`: True demands it, False is the program of a
        CustomIntegrator. None takes the plugin if it has this step, and OpenMM has a platform for GPUs here (CUDA, HIP,
        OpenCL), the plugin was compiled already, or nothing else makes such a step; `listing` says why not.

    Attributes
    ----------
    scheme : Splitting
    parts : tuple of Part
    row_groups : frozenset of int
        Force groups that carry rows, not forces.
    program : Program

    Raises
    ------
    InputError, UnsupportedError
        A time step that is no positive number, an unknown scheme, parts that do not go together.

    Warns
    -----
    UserWarning
        A time step above 20 fs that has no unit.

    Notes
    -----
    What the integrator was made with and was told since is written into its program at each call of `step`. Without
    Python, as a member of a CompoundIntegrator or read from XML, the program makes the same steps without checks.
    """

    #: Steps between two checks, if nothing else is asked for, ...
    _check_every = 100
    #: ... when checks come later where they would take more than a hundredth of the time.
    spare = True
    #: Of the System's constraints; None where the platform decides.
    asked_tolerance: float | None = None
    _guard: Guard | None = None
    #: Chooses the class, and says why it is not that whose steps are made on the device; of `kcons.openmm.device`.
    _on_device: ClassVar[Callable[..., tuple[type[ProjectedIntegrator], str]]]
    #: Why steps are not made on the device, where that was asked.
    _refused = ""

    def __new__(cls, *args: Any, device: bool | None = None, **kwargs: Any) -> ProjectedIntegrator:
        """Of this class, or of the one that runs on the device."""
        kind, why = cls, ""
        if len(args) > 2:
            right = "ProjectedIntegrator(0.002, ensemble=Langevin(300, 1.0))"
            raise InputError(f"{len(args)} numbers without names; give the thermostat as {right}", item="scheme")
        if "_on_device" in vars(cls) and device is not False:
            kind, why = cls._on_device(device, *args, **kwargs)
        made = object.__new__(kind)
        made._refused = why
        return made

    def __init__(
        self,
        timestep: unit.Quantity | float,
        scheme: str | Splitting = "rattle",
        *,
        parts: Sequence[Part] = (),
        tolerance: float | None = None,
        check_every: int | None = None,
        ensemble: Ensemble | None = None,
        device: bool | None = None,
    ) -> None:
        self._make(picoseconds(timestep))
        self.asked_tolerance = None if tolerance is None else relative_tolerance(tolerance)
        openmm.CustomIntegrator.setConstraintTolerance(self, self.asked_tolerance or TOLERANCES["double"])
        if check_every is not None:
            self.check_every = check_every
        self.scheme = to_scheme(scheme)
        self._ensemble = ConstantEnergy() if ensemble is None else ensemble
        if not isinstance(self._ensemble, Ensemble):
            raise InputError(
                f"ensemble is {ensemble!r}; give one of kcons.openmm, such as Langevin(temperature, friction)",
                item="ensemble",
            )
        self._ensemble.check(self.scheme)
        self.parts = self._held(parts)
        self.row_groups: frozenset[int] = frozenset().union(*(part.groups for part in self.parts))
        if self.row_groups:
            openmm.Integrator.setIntegrationForceGroups(self, set(range(32)) - self.row_groups)
        self.program = self._write()
        self.program.hand_over()
        for part in self.parts:
            part.program = self.program

    def _held(self, parts: Any) -> tuple[Part, ...]:
        """Parts, or a single one, as a tuple; refused are others, and parts each of which would undo what others do."""
        given = tuple(parts) if isinstance(parts, Iterable) else (parts,)
        known: set[int] = set()
        for part in given:
            if not isinstance(part, Part):
                raise InputError(
                    f"parts has {part!r:.80}, which is no part of an integrator; kcons.openmm.hold(system, "
                    "constraints, positions) makes one of constraints, CollectiveRows of Forces",
                    item="parts",
                )
            atoms = {int(a) for held in getattr(part, "atoms", ()) for a in np.ravel(held)}
            if known & atoms:
                raise UnsupportedError(
                    f"two parts hold particle {min(known & atoms)}; give all rows that share particles to one call of "
                    "kcons.openmm.hold"
                )
            known |= atoms
        if sum(part.meets_system for part in given) > 1:
            raise UnsupportedError("only one part may share atoms with the constraints of the System")
        return given

    def _make(self, dt: float) -> None:
        """Make the integrator of OpenMM."""
        super().__init__(dt)

    def _write(self) -> Program:
        """Write the program, of which parts keep what they need to know."""
        for k, part in enumerate(self.parts, start=1):
            part.code = k
        program = Program(self, self.scheme, self.parts, self._ensemble)
        write_step(program)
        return program

    def __repr__(self) -> str:
        held = "".join(f", {part!r}" for part in self.parts)
        return f"<ProjectedIntegrator: {self.scheme!r}, {self._dt * 1e3:g} fs{held}>"

    def __str__(self) -> str:
        return f"{self!r}\n{self.listing()}"

    def listing(self) -> str:
        """What is held and how closely, the variables, and the steps of the integrator, in words."""
        held = f"constraints of the System to {self.getConstraintTolerance():g} (relative)"
        if self._guard is not None:
            held += f", {self._guard.precision}"
        elif self.asked_tolerance is None:
            held += ", or what the precision of the Context allows"
        step = "\n".join(f"  {operation}" for operation in self.operations())
        refused = f"not on the device: {self._refused}\n" if self._refused else ""
        return f"{held}\na step of {self!r}\n{step}\n{refused}{self.program.listing()}"

    def operations(self) -> tuple[Operation, ...]:
        """What a step consists of, as for steppers on arrays; `listing` adds how OpenMM computes it."""
        return self.program.operations

    # -- the Context ----------------------------------------------------------------------------

    @property
    def context(self) -> openmm.Context:
        """The Context that this integrator belongs to.

        Raises
        ------
        UnsupportedError
            There is none.
        """
        context = None if self._guard is None else self._guard.alive
        if context is None and (context := find_context(self)) is None:
            raise UnsupportedError(
                "this integrator belongs to no Context: create one with it first. Where it has one that is not found, "
                "as a member of a CompoundIntegrator, call integrator.attach(context)"
            )
        return context

    def attach(self, context: openmm.Context) -> None:
        """Look at this Context, and at its System anew; done by itself but for members of a CompoundIntegrator.

        Raises
        ------
        InputError
            It is no Context, or that of another integrator.
        """
        require_context(context)
        owner = context.getIntegrator()
        compound = isinstance(owner, openmm.CompoundIntegrator)
        members = [owner.getIntegrator(k) for k in range(owner.getNumIntegrators())] if compound else []
        if owner is not self and all(int(member.this) != int(self.this) for member in members):
            raise InputError(
                f"the Context was made with another integrator than {self!r}; give the Context of this one",
                item="context",
            )
        self._guard = Guard(context, self)

    def _watch(self, context: openmm.Context | None = None) -> Guard:
        """The guard of the Context, which is a new one where the Context or its System is another."""
        self._take_parts()
        guard = self._guard
        if guard is None or not guard.knows or (context is not None and context is not guard.alive):
            self.attach(self.context if context is None else context)
        assert self._guard is not None
        return self._guard

    def _take_parts(self) -> None:
        """Parts that have served another integrator since serve this one again."""
        if all(part.program is self.program for part in self.parts):
            return
        self._write()  # the same as the program that the integrator has
        for part in self.parts:
            part.program = self.program
        if self._guard is not None:
            self.take_precision(self._guard.precision)
            self._guard.started = False

    def take_precision(self, precision: Precision) -> None:
        """The Context is known: tolerances that were left open become those of its platform."""
        if self.asked_tolerance is None:
            openmm.CustomIntegrator.setConstraintTolerance(self, precision.tolerance)
        for part in self.parts:
            part.take_precision(self.program, precision)

    # -- running --------------------------------------------------------------------------------

    @property
    def check_every(self) -> int:
        """Steps between two checks; 0 for none but the first."""
        return self._check_every

    @check_every.setter
    def check_every(self, steps: int) -> None:
        self._check_every, self.spare = whole_number(steps, "check_every", 0), False

    def step(self, steps: int) -> None:
        """Make `steps` steps.

        Raises
        ------
        KconsError
            A solve of one of the parts failed: positions, velocities, time and step count are those before that
            step, `error.step` is its number. (What barostats and CMMotionRemover did at its beginning stays.) Or a
            check failed, or a NaN appeared: they are those of the last check.
        InputError, UnsupportedError
            `steps` is no whole number. At the first step: the System cannot be propagated, or the start is not on the
            constraints.
        """
        steps = whole_number(steps, "steps", 0)
        guard = self._watch()
        guard.enter()
        self.program.push()
        try:
            if "call" in self.program.numbers:
                self.program.write("call", 1.0)
            while steps > 0:
                # At least one: `check_every` may have become less than what was made since the last check.
                block = min(steps, max(self.check_every - guard.since_check, 1)) if self.check_every else steps
                self._run_block(guard, block, block == steps)
                guard.count(block)
                steps -= block
        finally:
            if "call" in self.program.numbers:
                self.program.write("call", 0.0)
        guard.leave()

    def _run_block(self, guard: Guard, steps: int, ends: bool) -> None:
        """Make steps, with the shorter program for those after which the state is not read."""
        unseen = steps - 1 if self.program.lazy and not guard.in_parts else 0
        if unseen > 0 and guard.undisturbed and not (self.program.joined and guard.moving):
            with self._control("between"):
                self._run(guard, unseen, False)
            steps -= unseen
        self._run(guard, steps, ends)

    @contextmanager
    def _control(self, name: str, value: float = 1.0) -> Iterator[None]:
        """A control of the program has another value for a while."""
        self.program.write(name, value)
        try:
            yield
        finally:
            self.program.write(name, self.program.idle[name])

    def _run(self, guard: Guard, steps: int, ends: bool) -> None:
        """Make steps; with the last of them a call may end."""
        context, dt = guard.context, self._dt
        time, first = context.getTime()._value, context.getStepCount()
        before = self.getGlobalVariableByName("good_steps") if self.parts else 0.0
        try:
            for part in self.parts:
                part.begin_run()
            summed = int(ends and guard.sums)
            self._execute(guard, steps - summed)
            if summed:
                with self._control("ending"):
                    self._execute(guard, 1)
        except openmm.OpenMMException as error:
            guard.put_back()
            if "NaN" not in str(error):
                raise
            raise guard.explosion(str(error), first) from error
        finally:
            for part in self.parts:
                part.end_run()
        code = int(self.getGlobalVariableByName("failed")) if self.parts else 0
        done = int(self.getGlobalVariableByName("good_steps") - before) if code else steps
        # OpenMM's clock goes on with the first step size after setStepSize.
        if code or abs(context.getTime()._value - (time + done * dt)) > 1e-6 * dt:
            context.setTime(time + done * dt)
        if code:
            context.setStepCount(first + done)
            self.program.write("failed", 0.0)
            if code == _MOVED:
                guard.begin()
                self._run(guard, steps, ends)
                return
            guard.since_check += done
            failure = self._failure(code, first + done + 1)
            if isinstance(failure, NonFiniteError) and not np.isfinite(motion_of(context)).all():
                guard.put_back()  # a force is seen in the step after the one whose velocities it has spoilt
            elif "loose" in self.program.numbers and self.getGlobalVariableByName("loose"):
                self.program.write("between", 0.0)
                self.applyVelocityConstraints(context)
            guard.leave()
            raise failure
        if ends:
            guard.look()

    def _execute(self, guard: Guard, steps: int) -> None:
        """Run the program; each step in several executions, of which `phase` is the number, where forces need them.

        OpenMM takes each execution for a step; clock and step count are put right.
        """
        if not guard.in_parts:
            openmm.CustomIntegrator.step(self, steps)
            return
        context, dt = guard.context, self._dt
        for _ in range(steps):
            time, count = context.getTime()._value, context.getStepCount()
            with self._control("phase"):
                openmm.CustomIntegrator.step(self, self.program.phases)
            context.setTime(time + dt)
            context.setStepCount(count + 1)

    def _failure(self, code: int, step: int) -> KconsError:
        return self.parts[code - 1].failure(self, step)

    def refresh(self) -> None:
        """Compute what is kept of positions anew at the next step."""
        if "stale" in self.program.numbers:
            self.program.write("stale", 1.0)

    def check(self, context: openmm.Context | None = None) -> None:
        """Whether all is well: the System, its constraints and the parts, at the present state.

        Nothing is returned where it is; `kcons.openmm.worst_length` tells how well lengths are kept.

        Raises
        ------
        KconsError
            What is wrong. Also a failure in a step that ran within a CompoundIntegrator.
        """
        guard = self._watch(context)
        code = int(self.getGlobalVariableByName("failed")) if self.parts else 0
        if code > 0:
            self.program.write("failed", 0.0)
            raise self._failure(code, int(self.getGlobalVariableByName("good_steps")) + 1)
        for part in self.parts:
            part.check(guard.context)
        guard.check()

    # -- states on constraints ------------------------------------------------------------------

    def applyConstraints(self, context: openmm.Context | None = None, tolerance: float | None = None) -> None:
        """Bring positions onto all constraints, those of the parts as well.

        Raises
        ------
        KconsError
            They cannot be reached from here; positions are unchanged.
        """
        guard = self._watch(context)
        context = guard.context
        start, velocities = motion_of(context)
        tolerance = self._tolerance(tolerance)
        check_finite(start, start, context.getStepCount(), guard.rows.n_rows > 0)
        try:
            guard.hold_positions(tolerance)
            for part in self.parts:
                part.apply_positions(context)
            guard.check_lengths(positions_of(context), None)
            for part in self.parts:
                guard.certify(part.worst_violation(context, velocities=False))
        except KconsError:
            context.setPositions(start)
            raise
        finally:
            context.setVelocities(velocities)

    def applyVelocityConstraints(self, context: openmm.Context | None = None, tolerance: float | None = None) -> None:
        """Make velocities tangent to all constraints, those of the parts as well.

        Raises
        ------
        KconsError
            A part, or the solver of OpenMM, cannot do it; velocities are unchanged.
        """
        guard = self._watch(context)
        context = guard.context
        velocities, tolerance = velocities_of(context), self._tolerance(tolerance)
        try:
            context.applyVelocityConstraints(tolerance)
            for part in self.parts:
                part.apply_velocities(context)
            check_finite(*motion_of(context), context.getStepCount(), guard.rows.n_rows > 0)
        except KconsError:
            context.setVelocities(velocities)
            raise

    def _tolerance(self, given: float | None) -> float:
        return relative_tolerance(self.getConstraintTolerance() if given is None else given)

    def setVelocitiesToTemperature(
        self, context: openmm.Context, temperature: unit.Quantity | float, rng: Rng = None
    ) -> None:
        """Draw velocities for a temperature (K if a float) and make them tangent to all constraints.

        Context.setVelocitiesToTemperature does it for the System's own constraints, to 1e-5 only.

        Raises
        ------
        InputError
            A temperature below zero; a number for `rng` outside 0 to 2^31 - 1.
        """
        temperature = kelvins(temperature)
        seed, context = seed_from(rng, bits=31), self._watch(context).context  # refuse before velocities are changed
        velocities = velocities_of(context)
        context.setVelocitiesToTemperature(temperature, seed)
        try:
            self.applyVelocityConstraints(context)
        except KconsError:
            context.setVelocities(velocities)
            raise

    def minimizeEnergy(
        self,
        context: openmm.Context | None = None,
        tolerance: unit.Quantity | float = 10.0,
        maxIterations: int = 0,
    ) -> None:
        """Minimize the energy with all constraints kept.

        Without parts this is OpenMM's LocalEnergyMinimizer, followed by `applyConstraints`; OpenMM's minimizer knows
        nothing of parts.

        Parameters
        ----------
        tolerance : Quantity or float
            Root mean square of the force components along the constraints, in kJ/mol/nm if a float.
        maxIterations : int
            0 for no limit.

        Raises
        ------
        InputError
            A tolerance that is not above zero, a number of iterations that is none.
        """
        context = self._watch(context).context
        tolerance = positive(number(tolerance, unit.kilojoule_per_mole / unit.nanometer, "tolerance"), "tolerance")
        maxIterations = whole_number(maxIterations, "maxIterations", 0)
        if self.parts:
            _descend(self, context, tolerance, maxIterations)
        else:
            openmm.LocalEnergyMinimizer.minimize(context, tolerance, maxIterations)
            self.applyConstraints(context)

    # -- temperature that is found --------------------------------------------------------------

    def degrees_of_freedom(self, context: openmm.Context | None = None) -> int:
        """Three for each particle with a mass, less the rank of all constraints.

        Also less three where a CMMotionRemover keeps the center of mass at rest. Found at the first call.
        """
        return self._watch(context).degrees_of_freedom()

    def independent_momenta(self, context: openmm.Context | None = None) -> int:
        """Three for each particle with a mass, less the rank of all constraints, whatever happens to total momentum."""
        return self._watch(context).independent_momenta()

    def kinetic_energy(self, context: openmm.Context | None = None) -> unit.Quantity:
        """As a State has it: of the velocities at x; with a bath that has noise, of those in the middle of the step.

        With such a bath the next step computes forces anew, as after any State with energies.
        """
        guard = self._watch(context)
        if self.ensemble.noisy:
            return guard.context.getState(energy=True, groups=0).getKineticEnergy()
        v = velocities_of(guard.context)
        return 0.5 * float(masses_of(guard.system) @ np.einsum("ij,ij->i", v, v)) * unit.kilojoule_per_mole

    def computeSystemTemperature(self) -> unit.Quantity:
        """2 K/(g k), with g the degrees of freedom that constraints leave; StateDataReporter asks for it.

        With `Isokinetic`, whose K does not fluctuate, the temperature of the configurations.

        Raises
        ------
        InputError
            No degree of freedom is left.
        """
        freedom = self.degrees_of_freedom()
        if freedom <= 0:
            raise InputError("the constraints leave no degree of freedom: there is no temperature", item="constraints")
        warmth = self.ensemble.warmth(self)
        return (2 * warmth * self.kinetic_energy() / (freedom * unit.MOLAR_GAS_CONSTANT_R)).in_units_of(unit.kelvin)

    # -- settings -------------------------------------------------------------------------------

    @property
    def ensemble(self) -> Ensemble:
        """How velocities change between drifts, as it is now; see `setTemperature`, `setFriction`."""
        return self._ensemble

    @property
    def thermostatted(self) -> bool:
        """Whether velocities change by more than forces and constraints."""
        return not isinstance(self.ensemble, ConstantEnergy)

    # As integrators of OpenMM do, this one has such a method where there is what it is about: programs ask by hasattr.

    @property
    def setTemperature(self) -> Callable[[unit.Quantity | float], None]:
        """Method that changes the temperature (K if a float) of the ensemble; `MissingSettingError` at constant energy.

        The method raises `InputError` if it is below zero; with `Isokinetic`, zero.
        """
        if not hasattr(self.ensemble, "temperature"):
            self._given("temperature")
        return self._set_temperature

    def _set_temperature(self, temperature: unit.Quantity | float) -> None:
        self._take(self.ensemble.replaced(temperature=kelvins(temperature)))
        guard = self._guard
        if guard is not None and guard.alive is not None and guard.started:
            warn_of_barostat(guard.context, self._given("temperature"), stacklevel=3)

    @property
    def getTemperature(self) -> Callable[[], unit.Quantity]:
        """Method that returns the temperature of the ensemble; `MissingSettingError` where it has none."""
        value = self._given("temperature")
        return lambda: value * unit.kelvin

    @property
    def setFriction(self) -> Callable[[unit.Quantity | float], None]:
        """Method that changes the friction (1/ps if a float) of the ensemble; `MissingSettingError` where it has none.

        The method raises `InputError` if it is below zero.
        """
        self._given("friction")
        return lambda friction: self._take(self.ensemble.replaced(friction=friction))

    @property
    def getFriction(self) -> Callable[[], unit.Quantity]:
        """Method that returns the friction of the ensemble; `MissingSettingError` where it has none."""
        value = self._given("friction")
        return lambda: value / unit.picosecond

    def _given(self, what: str) -> float:
        value = getattr(self.ensemble, what, None)
        if not isinstance(value, float):
            name = "constant energy" if not self.thermostatted else repr(self.ensemble)
            raise MissingSettingError(f"there is no {what} at {name}; give ensemble=Langevin(temperature, friction)")
        return value

    def _take(self, ensemble: Ensemble) -> None:
        ensemble.follow(self)  # first, as it may refuse
        self._ensemble = ensemble
        for name, value in ensemble.settings().items():
            self.program.set(name, value)

    @property
    def _dt(self) -> float:
        return float(self.getStepSize()._value)

    def setStepSize(self, size: unit.Quantity | float) -> None:
        """Change the time step.

        Raises
        ------
        InputError
            It is no positive number, or more than the ensemble can follow.

        Warns
        -----
        UserWarning
            It is above 20 fs and has no unit.
        """
        dt = picoseconds(size)
        self.ensemble.check_timestep(dt)
        super().setStepSize(dt)

    def setConstraintTolerance(self, tol: float) -> None:
        """Change the relative tolerance of the System's constraints.

        One that was left open stays so where it is set to what an integrator without a Context, or this one, has.

        Raises
        ------
        InputError
            It is not between 0 and 1.
        """
        wanted = relative_tolerance(tol)
        if self.asked_tolerance is None and wanted in (TOLERANCES["double"], self.getConstraintTolerance()):
            return
        self.asked_tolerance = wanted
        super().setConstraintTolerance(wanted)

    def setGlobalVariableByName(self, name: str, value: float) -> None:
        """Set a variable of the program.

        Raises
        ------
        UnsupportedError
            It is a setting, which has a method of its own.
        """
        if name in self.program.settings:
            raise UnsupportedError(
                f"{name} is a setting of the integrator: use setTemperature, setFriction, or set_target of a part"
            )
        self.program.write(name, float(value))

    def setIntegrationForceGroups(self, groups: int | Iterable[int]) -> None:
        """Choose the force groups that act; groups that carry rows never do.

        Parameters
        ----------
        groups : int or iterable of int
            A bit mask or group numbers. -1 and all 32 groups mean: all but the groups of rows.

        Raises
        ------
        InputError
            Groups that carry rows are among those given; what is no number of a group.
        UnsupportedError
            The Context exists; it has read the groups and would ignore the change.
        """
        if self._guard is not None or find_context(self) is not None:
            raise UnsupportedError("the Context has read the force groups already; set them before it is created")
        if isinstance(groups, int | np.integer):
            wanted = {g for g in range(32) if (int(groups) >> g) & 1}
        elif isinstance(groups, Iterable) and not isinstance(groups, str):
            wanted = {whole_number(group, "force group", 0, 31) for group in groups}
        else:
            raise InputError(f"groups is {groups!r}; give numbers of force groups, such as {{0, 1}}", item="groups")
        rows = self.row_groups
        if len(wanted) == 32:
            wanted -= rows
        if wanted & rows:
            raise InputError(
                f"force groups {sorted(wanted & rows)} carry constraint rows, their forces are gradients and must not "
                "act; leave them out",
                item="groups",
            )
        super().setIntegrationForceGroups(sum(1 << group for group in wanted))

    def setRandomNumberSeed(self, seed: int) -> None:
        super().setRandomNumberSeed(whole_number(seed, "seed", -(2**31), 2**31 - 1))

    # -- copies ---------------------------------------------------------------------------------

    def _making(self) -> tuple[Any, ...]:
        every = None if self.spare else self.check_every
        made_with = (self.getStepSize(), self.scheme, self.parts, self.asked_tolerance, every, self.ensemble)
        program = self.program
        # What belongs to a state a copy starts without; clocks of targets that move go by the good steps.
        left = {*program.settings, *program.idle, *program.memory, "stale"}
        kept = [name for name in program.words if name in program.numbers and name not in left]
        run = {name: self.getGlobalVariableByName(name) for name in kept}
        return made_with, program.settings, run, self.getIntegrationForceGroups(), self.getRandomNumberSeed()

    def __reduce__(self) -> tuple[Any, ...]:
        return _remade, (type(self), *self._making())

    def __copy__(self) -> Self:
        """Without the Context, and with copies of the parts; rows of `hold`, which the System has, are shared."""
        return cast(Self, _remade(type(self), *deepcopy(self._making())))

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return self.__copy__()


def _remade(
    kind: type[ProjectedIntegrator],
    made_with: tuple[Any, ...],
    settings: dict[str, float],
    run: dict[str, float],
    groups: int,
    seed: int,
) -> ProjectedIntegrator:
    dt, scheme, parts, tolerance, check_every, ensemble = made_with
    options = {"tolerance": tolerance, "check_every": check_every, "ensemble": ensemble, "device": False}
    made = kind(dt, scheme, parts=parts, **options)
    made.setRandomNumberSeed(seed)
    openmm.Integrator.setIntegrationForceGroups(made, groups)
    for name, value in settings.items():
        made.program.set(name, value)
    made.program.recall(run)
    return made


def picoseconds(timestep: Any) -> float:
    """A time step; a long one without a unit, which may be meant in fs, draws a warning where the caller was called."""
    dt = number(timestep, unit.picosecond, "timestep")
    if not (np.isfinite(dt) and dt > 0):
        raise InputError(
            f"the time step is {timestep}; give a positive one; to go back in time, reverse the velocities",
            item="timestep",
        )
    if dt > _LONG and not unit.is_quantity(timestep):
        warnings.warn(
            f"the time step is {dt:g} ps, that is {dt * 1e3:g} fs: is it meant in fs? Give it with its unit, "
            f"{dt:g} * unit.femtoseconds or {dt:g} * unit.picoseconds",
            stacklevel=3,
        )
    return dt


# -- minima on the constraints --------------------------------------------------------------------


def _descend(integrator: ProjectedIntegrator, context: openmm.Context, tolerance: float, iterations: int) -> None:
    """Fast inertial relaxation along the constraints of the System and of the parts.

    Velocities are the search direction in the mass metric: each step projects f/m, turns v towards it, goes, and
    brings x back onto the constraints. Velocities of the context stay as they were. It ends where the root mean square
    of the projected force components is below a tolerance (kJ/mol/nm), or after so many iterations (0: 50,000);
    `ConvergenceError` where the constraints cannot be reached, however short the steps.

    References
    ----------
    Bitzek et al., Phys. Rev. Lett. 97, 170201 (2006).
    """
    masses = masses_of(context.getSystem())[:, None]
    inverse = np.divide(1.0, masses, out=np.zeros_like(masses), where=masses > 0)
    groups = integrator.getIntegrationForceGroups()
    kept = velocities_of(context)
    dt, alpha, since_turn = 1e-3, 0.1, 0
    v = np.zeros((len(masses), 3))
    try:
        integrator.applyConstraints(context)
        for _ in range(iterations or 50_000):
            pull = _tangent(integrator, context, forces_at(context, groups) * inverse)
            if np.sqrt(np.mean((masses * pull) ** 2)) <= tolerance:
                return
            v = _tangent(integrator, context, v + dt * pull)
            if np.sum(masses * v * pull) > 0:
                since_turn += 1
                v = (1 - alpha) * v + alpha * pull * np.sqrt(np.sum(masses * v * v) / np.sum(masses * pull * pull))
                if since_turn > 5:
                    dt, alpha = 1.1 * dt, 0.99 * alpha
            else:
                v[:], alpha, since_turn = 0.0, 0.1, 0
                dt *= 0.5
            dt, v = _move(integrator, context, v, dt)
    finally:
        context.setVelocities(kept)


def _move(
    integrator: ProjectedIntegrator, context: openmm.Context, v: FloatArray, dt: float
) -> tuple[float, FloatArray]:
    x = positions_of(context)
    for _ in range(30):
        stride = dt * v
        longest = float(np.sqrt(np.max(np.sum(stride**2, axis=1))))
        context.setPositions(x + stride * min(1.0, _STRIDE / longest if longest > 0 else 1.0))
        try:
            integrator.applyConstraints(context)
            return dt, v
        except ConvergenceError:
            dt, v = 0.25 * dt, 0.25 * v
    context.setPositions(x)
    raise ConvergenceError("the constraints cannot be kept along the descent, however short the steps")


def _tangent(integrator: ProjectedIntegrator, context: openmm.Context, v: FloatArray) -> FloatArray:
    context.setVelocities(v)
    integrator.applyVelocityConstraints(context)
    return velocities_of(context)
