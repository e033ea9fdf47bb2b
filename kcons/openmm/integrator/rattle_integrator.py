"""RATTLE at the speed of OpenMM's own Verlet: compiled leapfrog steps, with velocities at the positions on both ends.

n steps of velocity Verlet are half a kick and a drift, n - 1 leapfrog steps, and half a kick, which ends with
velocities tangent to the constraints. OpenMM interprets the steps of a CustomIntegrator and has compiled those of its
VerletIntegrator; so the ends are a CustomIntegrator here, and what lies between is OpenMM's own. The forces of the last
half kick are those of the first of the next call: n steps cost n evaluations, in however many calls.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import openmm
from openmm import unit

from kcons.constraints.arguments import whole_number
from kcons.errors import InputError, UnsupportedError
from kcons.openmm.integrator.guard import Guard, velocities_of
from kcons.openmm.integrator.lean_step_writer import LeanStepWriter
from kcons.openmm.integrator.projected import ProjectedIntegrator
from kcons.openmm.integrator.states.copies import settings_of
from kcons.openmm.integrator.states.serialization import note_of
from kcons.openmm.integrator.states.settings import picoseconds
from kcons.openmm.integrator.states.states_on_constraints import StatesOnConstraints

#: What one execution of the program of `Ends` does.
_STEP, _BEGIN, _END, _LOOK = 0.0, 1.0, 2.0, 3.0
#: Shorter calls are made by the program itself.
FEW = 2
_CLOSED = "a RattleIntegrator has its integrators; make a CompoundIntegrator with a ProjectedIntegrator in it"


class EndWriter(LeanStepWriter):
    """A whole step; or, to order, what begins and what ends a row of leapfrog steps made by others."""

    def write(self) -> None:
        p = self.program
        p.control("end", "0 for a step, 1 to begin leapfrog steps, 2 to end them, 3 to do neither")
        with p.when("end = 0", "a step"):
            super().write()
        with p.when("end = 1", "leapfrog steps follow"):
            p.let_others_act()
            p.each("v", "v+0.5*dt*f/m", "the applied forces act (half a kick)")
            p.each("x", "x+dt*v", "move freely (drift)")
            p.each("xu", "x", "where that leads")
            p.hold_positions("back onto the constraints of the System")
            p.each("v", "v+(x-xu)/dt", "the constraint forces act on v as well")
        with p.when("end = 2", "leapfrog steps were made"):
            p.each("x", "x", "tells OpenMM that forces are old")
            p.each("v", "v+0.5*dt*f/m", "the applied forces act (half a kick)")
            p.hold_velocities("tangent to the constraints of the System")


class Ends(ProjectedIntegrator):
    """RATTLE by a program, which also makes the ends of leapfrog steps."""

    _check_every = 1000
    _writer = EndWriter

    def settle(self) -> None:
        """End the leapfrog steps that were made."""
        if self._take_owed():
            assert self._guard is not None
            context = self._guard.context
            time, count = context.getTime(), context.getStepCount()
            with self.way_back(count):
                self.execute(_END)
            context.setTime(time)
            context.setStepCount(count)
            self._guard.count(0, ends=self.spare)

    @contextmanager
    def way_back(self, first: int) -> Iterator[None]:
        """Leapfrog steps are made; where that fails, v is that of half a step before, and the last check holds."""
        try:
            yield
        except BaseException as error:
            guard = self._watch()
            guard.put_back()
            if isinstance(error, openmm.OpenMMException) and "NaN" in str(error):
                raise guard.explosion(str(error), first) from error
            raise

    def execute(self, end: float) -> None:
        """Begin or end leapfrog steps; OpenMM takes that for a step, and moves its clock."""
        self.program.write("end", end)
        try:
            openmm.CustomIntegrator.step(self, 1)
        finally:
            self.program.write("end", _STEP)


class RattleIntegrator(StatesOnConstraints, openmm.CompoundIntegrator):
    """Velocity Verlet on the constraints of the System, to order 2, about as fast as openmm.VerletIntegrator.

    The motion is that of ``ProjectedIntegrator(timestep, "rattle")``, up to rounding and the tolerance: positions and
    velocities belong to the same time, velocities are tangent, all is checked. Within a call of `step` there are
    leapfrog steps that OpenMM has compiled; a call costs as many force evaluations as it has steps. Call it with many
    steps all the same: what begins and ends a call runs as slowly as ProjectedIntegrator.

    For parts, thermostats and orders 4 and 6 take `ProjectedIntegrator`.

    Parameters
    ----------
    timestep : Quantity or float
        In ps if a float; more than 0.
    tolerance : float, optional
        Relative tolerance of the System's constraints; see `ProjectedIntegrator`.
    check_every : int, optional
        Steps between two checks that OpenMM's solvers did converge; 0 for none but the first. Left open, 1000 and at
        the end of each call, and later where checks would take more than a hundredth of the time. One that is due
        shortly before the end of a call is made there, up to half as many steps late: to stop on the way costs more.

    Raises
    ------
    InputError
        A time step, tolerance or interval that is none.

    Notes
    -----
    K_{h/2} D_h (K_h D_h)^{n-1} K_{h/2}, where the leapfrog step K_h D_h is a kick and a drift along the constraints
    (Andersen, J. Comput. Phys. 52, 24 (1983)). What the projection at the end takes out of
    v lies along gradients at x, where the next drift absorbs it: into how many calls steps are divided does not change
    the motion, up to rounding.

    An AndersenThermostat draws velocities between steps; with one, all steps are those of ProjectedIntegrator.
    """

    def __init__(
        self, timestep: unit.Quantity | float, *, tolerance: float | None = None, check_every: int | None = None
    ) -> None:
        super().__init__()
        self._ends = Ends(
            picoseconds(timestep) * unit.picosecond, "rattle", tolerance=tolerance, check_every=check_every
        )
        self._verlet = openmm.VerletIntegrator(self._ends.getStepSize())
        self._verlet.setConstraintTolerance(self._ends.getConstraintTolerance())
        # The first is the one that answers what OpenMM asks: its velocities belong to x.
        super().addIntegrator(self._ends)
        super().addIntegrator(self._verlet)

    def __repr__(self) -> str:
        return f"<RattleIntegrator: {self._dt * 1e3:g} fs>"

    #: Others may not change which integrator is in use.
    closed = True

    # -- running --------------------------------------------------------------------------------

    @property
    def check_every(self) -> int:
        """Steps between two checks."""
        return self._ends.check_every

    @property
    def context(self) -> openmm.Context:
        """The Context that this integrator belongs to; found by itself, set it where this fails."""
        return self._ends.context

    @context.setter
    def context(self, context: openmm.Context) -> None:
        self._ends.context = context

    def _watch(self, context: openmm.Context | None = None) -> Guard:
        guard = self._ends._watch(context)
        self._verlet.setConstraintTolerance(self._ends.getConstraintTolerance())  # the Context may have decided
        return guard

    def step(self, steps: int) -> None:
        """Make `steps` steps.

        Raises
        ------
        ConvergenceError, NonFiniteError
            A check failed, or a NaN appeared: positions, velocities, time and step count are those of the last check.
        InputError, UnsupportedError
            `steps` is no whole number. At the first step: the System cannot be propagated, or the start is not on the
            constraints.
        """
        steps, ends = whole_number(steps, "steps", 0), self._ends
        begun = bool(ends._take_owed())
        guard = self._watch()
        if not begun:
            guard.meet_others()
        if guard.disturbed:
            guard.begin()
        while steps > 0:
            block = steps
            if ends.check_every and steps > (due := ends.check_every - guard.since_check) + ends.check_every // 2:
                block = due
            check_is_due = 0 < ends.check_every <= guard.since_check + block
            goes_on = ends.unseen and block == steps and not check_is_due and guard.undisturbed
            if begun or goes_on or (block >= FEW and guard.undisturbed):
                self._leap(guard, block, begun, goes_on, block == steps)
            else:
                ends._run(guard, block, block == steps)
            steps -= block
            guard.count(block, ends=ends.spare and not steps and not goes_on)
            begun = goes_on
        guard.leave()
        ends._owe(int(begun))

    def _leap(self, guard: Guard, steps: int, begun: bool, goes_on: bool, last: bool) -> None:
        """Leapfrog steps, which others may have begun, and others may end; the last of a call are looked at."""
        context = guard.context
        time, first = context.getTime()._value, context.getStepCount()
        with self._ends.way_back(first):
            if not begun:
                self._ends.execute(_BEGIN)
            self._verlet.step(steps if begun else steps - 1)
            summed = last and guard.sums
            with self._ends.ending() if summed else nullcontext():
                if summed or not goes_on:
                    self._ends.execute(_LOOK if goes_on else _END)
        context.setTime(time + steps * self._dt)
        context.setStepCount(first + steps)
        if last:
            guard.look()

    def refresh(self) -> None:
        """Compute the forces anew at the next step: to be called after `updateParametersInContext`."""
        context = self.context
        context.setVelocities(velocities_of(context))

    def check(self, context: openmm.Context | None = None) -> None:
        """Whether all is well: the System and its constraints, at the present state.

        Raises
        ------
        KconsError
            What is wrong.
        """
        self._ends.check(context)

    # -- constraints, temperature ---------------------------------------------------------------

    def applyConstraints(self, context: openmm.Context | None = None, tolerance: float | None = None) -> None:
        """As `ProjectedIntegrator.applyConstraints`."""
        self._ends.applyConstraints(context, tolerance)

    def applyVelocityConstraints(self, context: openmm.Context | None = None, tolerance: float | None = None) -> None:
        """As `ProjectedIntegrator.applyVelocityConstraints`."""
        self._ends.applyVelocityConstraints(context, tolerance)

    def kinetic_energy(self, context: openmm.Context | None = None) -> unit.Quantity:
        """Of the velocities at x; no forces are computed."""
        return self._ends.kinetic_energy(context)

    def computeSystemTemperature(self) -> unit.Quantity:
        """2 K/(g k), with g the degrees of freedom that constraints leave; StateDataReporter asks for it."""
        return self._ends.computeSystemTemperature()

    # -- settings -------------------------------------------------------------------------------

    @property
    def _dt(self) -> float:
        return float(self._ends.getStepSize()._value)

    def setStepSize(self, size: unit.Quantity | float) -> None:
        """Change the time step.

        Raises
        ------
        InputError
            It is no positive number.
        """
        self._ends.setStepSize(picoseconds(size) * unit.picosecond)
        self._verlet.setStepSize(self._dt)

    def setConstraintTolerance(self, tol: float) -> None:
        """Change the relative tolerance of the System's constraints.

        Raises
        ------
        InputError
            It is not between 0 and 1.
        """
        self._ends.setConstraintTolerance(tol)
        self._verlet.setConstraintTolerance(tol)

    def setIntegrationForceGroups(self, groups: Any) -> None:
        """Choose the force groups that act, before the Context is made.

        Parameters
        ----------
        groups : int or iterable of int
            A bit mask or group numbers.

        Raises
        ------
        UnsupportedError
            The Context exists; it has read the groups and would ignore the change.
        """
        self._ends.setIntegrationForceGroups(groups)
        self._verlet.setIntegrationForceGroups(self._ends.getIntegrationForceGroups())

    def addIntegrator(self, integrator: openmm.Integrator) -> int:
        """Refused.

        Raises
        ------
        UnsupportedError
            Always: make a CompoundIntegrator with a ProjectedIntegrator in it.
        """
        raise UnsupportedError(_CLOSED)

    def setCurrentIntegrator(self, index: int) -> None:
        """Refused.

        Raises
        ------
        UnsupportedError
            Always: make a CompoundIntegrator with a ProjectedIntegrator in it.
        """
        raise UnsupportedError(_CLOSED)

    # -- copies ---------------------------------------------------------------------------------

    def _making(self) -> tuple[Any, ...]:
        every = None if self._ends.spare else self.check_every
        return self._ends.getStepSize(), self._ends.asked_tolerance, every, settings_of(self._ends)

    def _note(self) -> dict[str, Any]:
        return {**note_of(self._ends), "class": "RattleIntegrator"}

    @classmethod
    def _of_note(cls, plain: openmm.Integrator, note: dict[str, Any]) -> RattleIntegrator:
        if not isinstance(plain, openmm.CompoundIntegrator) or plain.getNumIntegrators() != 2:
            raise InputError(f"{type(plain).__name__} is no program of a {cls.__name__}", item="integrator")
        ends = plain.getIntegrator(0)
        settings = {"groups": ends.getIntegrationForceGroups()}
        return _remade(ends.getStepSize(), note["tolerance"], note["check_every"], settings)

    def __reduce__(self) -> tuple[Any, ...]:
        return _remade, self._making()

    def __copy__(self) -> RattleIntegrator:
        """Without the Context."""
        return _remade(*self._making())

    def __deepcopy__(self, memo: dict[int, Any]) -> RattleIntegrator:
        return self.__copy__()


def _remade(
    dt: unit.Quantity, tolerance: float | None, check_every: int | None, settings: dict[str, Any]
) -> RattleIntegrator:
    made = RattleIntegrator(dt, tolerance=tolerance, check_every=check_every)
    made.setIntegrationForceGroups(settings["groups"])
    return made
