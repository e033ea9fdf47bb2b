"""RATTLE at the speed of OpenMM's own Verlet: compiled leapfrog steps, with velocities at the positions on both ends.

n steps of velocity Verlet are half a kick and a drift, n - 1 leapfrog steps, and half a kick, which ends with
velocities tangent to the constraints. OpenMM interprets the steps of a CustomIntegrator and has compiled those of its
VerletIntegrator; so the ends are a CustomIntegrator here, and what lies between is OpenMM's own. The forces of the last
half kick are those of the first of the next call: n steps cost n evaluations, in however many calls.
"""

from __future__ import annotations

import weakref
from typing import Any

import openmm
from openmm import unit

from kcons.constraints.arguments import whole_number
from kcons.openmm.integrator.ensemble import Step, use
from kcons.openmm.integrator.guard import Guard
from kcons.openmm.integrator.projected import ProjectedIntegrator, picoseconds
from kcons.openmm.integrator.steps import single_step

#: What one execution of the program of `Ends` does.
_STEP, _BEGIN, _END = 0.0, 1.0, 2.0
#: Shorter calls are made by the program itself.
FEW = 2


def _step_or_end(step: Step) -> bool:
    """A whole step; or, to order, what begins and what ends a row of leapfrog steps made by others."""
    p = step.program
    use(p, "xu")
    p.control("end", "0 for a step, 1 to begin leapfrog steps, 2 to end them")
    with p.when("end = 0", "a step"):
        single_step(step)
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
    return True


class Ends(ProjectedIntegrator):
    """RATTLE by a program, which also makes the ends of leapfrog steps."""

    _check_every = 1000
    _own_step = staticmethod(_step_or_end)
    #: The integrator that the Context has.
    owner: weakref.ReferenceType[openmm.CompoundIntegrator] | None = None

    @property
    def _holder(self) -> openmm.Integrator:
        owner = None if self.owner is None else self.owner()
        return self if owner is None else owner

    def execute(self, end: float) -> None:
        """Begin or end leapfrog steps; OpenMM takes that for a step, and moves its clock."""
        with self._control("end", end):
            openmm.CustomIntegrator.step(self, 1)


class RattleIntegrator(openmm.CompoundIntegrator):
    """Velocity Verlet on the constraints of the System, to order 2, about as fast as openmm.VerletIntegrator.

    The motion is that of ``ProjectedIntegrator(timestep, "rattle")``, up to rounding and the tolerance: positions and
    velocities belong to the same time, velocities are tangent, all is checked. Within a call of `step` there are
    leapfrog steps that OpenMM has compiled; a call costs as many force evaluations as it has steps. Call it with many
    steps all the same: what begins and ends a call runs as slowly as ProjectedIntegrator.

    For parts, thermostats and orders 4 and 6 take `ProjectedIntegrator`. What this has besides steps is here as well:
    `check`, `applyConstraints`, `applyVelocityConstraints`, `setVelocitiesToTemperature`, `minimizeEnergy`,
    `degrees_of_freedom`, `kinetic_energy`, `computeSystemTemperature`, `context`, `attach`, `check_every`.

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
        dt = picoseconds(timestep) * unit.picosecond
        # OpenMM keeps what is compiled of its members only.
        self._ends = Ends(dt, "rattle", tolerance=tolerance, check_every=check_every)
        self._verlet = openmm.VerletIntegrator(self._ends.getStepSize())
        self._verlet.setConstraintTolerance(self._ends.getConstraintTolerance())
        self._ends.owner = weakref.ref(self)
        # The first is the one that answers what OpenMM asks: its velocities belong to x.
        super().addIntegrator(self._ends)
        super().addIntegrator(self._verlet)

    def __repr__(self) -> str:
        return f"<RattleIntegrator: {self._ends._dt * 1e3:g} fs>"

    # -- running --------------------------------------------------------------------------------

    def __getattr__(self, name: str) -> Any:
        """What OpenMM does not ask of every integrator is that of `ProjectedIntegrator`."""
        if name.startswith("_"):
            raise AttributeError(name)
        return getattr(self._ends, name)

    def _watch(self) -> Guard:
        guard = self._ends._watch()
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
        guard = self._watch()
        guard.enter()
        ends.program.push()
        while steps > 0:
            block = steps
            if ends.check_every and steps > (due := ends.check_every - guard.since_check) + ends.check_every // 2:
                block = due
            if block >= FEW and guard.undisturbed:
                self._leap(guard, block, block == steps)
            else:
                ends._run(guard, block, block == steps)
            steps -= block
            guard.count(block, ends=ends.spare and not steps)
        guard.leave()

    def _leap(self, guard: Guard, steps: int, last: bool) -> None:
        """Leapfrog steps; the last of a call are looked at."""
        context, ends = guard.context, self._ends
        time, first = context.getTime()._value, context.getStepCount()
        try:
            ends.execute(_BEGIN)
            self._verlet.step(steps - 1)
            if last and guard.sums:
                with ends._control("ending"):
                    ends.execute(_END)
            else:
                ends.execute(_END)
        except BaseException as error:
            guard.put_back()  # v is that of half a step before
            if isinstance(error, openmm.OpenMMException) and "NaN" in str(error):
                raise guard.explosion(str(error), first) from error
            raise
        context.setTime(time + steps * ends._dt)
        context.setStepCount(first + steps)
        if last:
            guard.look()

    # -- settings -------------------------------------------------------------------------------

    def setStepSize(self, size: unit.Quantity | float) -> None:
        """Change the time step.

        Raises
        ------
        InputError
            It is no positive number.
        """
        self._ends.setStepSize(picoseconds(size) * unit.picosecond)
        self._verlet.setStepSize(self._ends._dt)

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
        """As `ProjectedIntegrator.setIntegrationForceGroups`."""
        self._ends.setIntegrationForceGroups(groups)
        self._verlet.setIntegrationForceGroups(self._ends.getIntegrationForceGroups())

    # -- copies ---------------------------------------------------------------------------------

    def __reduce__(self) -> tuple[Any, ...]:
        ends = self._ends
        every = None if ends.spare else ends.check_every
        return _remade, (ends.getStepSize(), ends.asked_tolerance, every, ends.getIntegrationForceGroups())

    def __copy__(self) -> RattleIntegrator:
        """Without the Context."""
        make, arguments = self.__reduce__()
        return make(*arguments)

    def __deepcopy__(self, memo: dict[int, Any]) -> RattleIntegrator:
        return self.__copy__()


def _remade(dt: unit.Quantity, tolerance: float | None, check_every: int | None, groups: int) -> RattleIntegrator:
    made = RattleIntegrator(dt, tolerance=tolerance, check_every=check_every)
    made.setIntegrationForceGroups(groups)
    return made
