"""Kicks and drifts in turn: the loop that RATTLE, its compositions and the Runge-Kutta-Nystrom splittings share.

A kick changes velocities by h M^-1 f(x, t), a drift flies h along the constraints (`kcons.steppers.stages.drifts`).
Time passes in the drifts, so that forces and constraints that depend on it are taken at the time of each stage,
also where a stage goes back.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from kcons.constraints.arguments import lent
from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, ImageError, InputError, NonFiniteError
from kcons.motion.certificate import checked_every
from kcons.solvers.fused_distances import Packed
from kcons.steppers.stages.compensated_steps import NO_WORK, Point
from kcons.steppers.stages.drifts import Drift
from kcons.steppers.stages.friction import Friction
from kcons.steppers.stages.fused_stages import BOTH, FLY, UNENDED, Flights
from kcons.steppers.state import State, System, check_finite
from kcons.steppers.stepper import explained, stays

_MAX_ITERATIONS = 50
_EPS = float(np.finfo(float).eps)
_WHOLE = np.ones(1)


class Splitting:
    """Base of the steppers made of kicks and drifts.

    Parameters
    ----------
    kicks, drifts : sequence of float
        Palindromes of fractions of the step. One kick more than drifts: the step begins and ends with a kick, and
        the last force is the first of the next step. One drift more than kicks: it begins and ends with a drift.
    flight : sequence of float
        Each drift is this symmetric composition of RATTLE drifts.
    exact_flight : bool
        Whether to fly along great circles instead where every row allows it.
    """

    order: int = 2
    reversible = True
    symplectic = True

    def __init__(
        self,
        kicks: Sequence[float],
        drifts: Sequence[float],
        flight: Sequence[float] = (1.0,),
        exact_flight: bool = False,
    ) -> None:
        self.kicks = tuple(kicks)
        self.drifts = tuple(drifts)
        self.flight = tuple(flight)
        self.exact_flight = exact_flight
        self.kick_first = len(self.kicks) > len(self.drifts)
        self._stages = _stages(self.drifts, self.flight)
        self._whole_stages = _stages(self.drifts, (1.0,))
        self._fractions = [np.array(stage.fractions) for stage in self._stages]
        self._many = len(self.drifts) * len(self.flight) > 1
        self._no_kicks = (0.0,) * len(self.kicks)

    @property
    def force_evaluations(self) -> int:
        return min(len(self.kicks), len(self.drifts))

    def __repr__(self) -> str:
        return f"{type(self).__name__}()"

    def check(self, system: System) -> None:
        """Raise `UnsupportedError` where the stepper may not be used: here, nowhere."""

    # As a decorator this costs half of a `with`. What overflows is looked for, and named with the step's number.
    @np.errstate(over="ignore", invalid="ignore")
    def step(self, system: System, state: State, dt: float) -> State:
        """Advance by `dt`; negative steps go back, 0 changes nothing.

        Raises
        ------
        ConvergenceError
            No solution (the step is too large); carries `step`.
        NonFiniteError
            A force, position or velocity became NaN or infinite; carries `step`.
        InputError
            `dt` is not finite; the force function returned a wrong shape.
        UnsupportedError
            The stepper may not be used with this system.
        """
        self.check(system)
        still = stays(state, dt) if dt == 0 or not math.isfinite(dt) else None
        if still is not None:
            return still
        start = system.with_forces(state) if self.kick_first and state.forces is None else state
        flights = self._flights(system)
        return self._piecewise(system, start, dt) if flights is None else self._compiled(system, start, dt, flights)

    @np.errstate(over="ignore", invalid="ignore")
    def march(self, system: System, state: State, dt: float, steps: int, *, check_every: int | None = None) -> State:
        """The state after so many steps, the same to the last bit as by `step`.

        Nobody looks at the states between: where all is compiled, the end of a step and the beginning of the next are
        one call. `check_every` is as for `run`.

        Raises
        ------
        KconsError
            As `step`; `error.step` says which one.
        CertificateError
            As `run`.
        """
        self.check(system)
        check_every, spare = checked_every(check_every if dt != 0 else 0)
        while steps > 0:
            n = system.schedule.within(steps, check_every)
            state = self._unseen(system, state, dt, n)
            system.schedule.made(n, check_every, state, dt, spare=spare)
            steps -= n
        return state

    def _unseen(self, system: System, state: State, dt: float, steps: int) -> State:
        flights = None
        if type(self).step is Splitting.step and dt != 0 and math.isfinite(dt):
            flights = self._flights(system)
        while steps > 0:
            if flights is not None and steps > 1 and state.remainder is None:
                state, made = self._marched(system, system.with_forces(state), dt, steps, flights)
                steps -= made
            if steps > 0:
                # What is out of the ordinary: here it is done, or said what it is.
                state = self.step(system, state, dt)
                steps -= 1
        return state

    def _flights(self, system: System) -> Flights | None:
        """Compiled stages, where steps are made of them."""
        flights = system.flights
        if flights is None or system.velocity_dependent or system.friction is not None or not self.kick_first:
            return None
        return None if self.exact_flight and system.great_circles is not None else flights

    def _marched(self, system: System, start: State, dt: float, steps: int, flights: Flights) -> tuple[State, int]:
        """As many of the steps as the kernels can do without the engine: the state after them, and their number."""
        force, kicks, number = system.force, self.kicks, start.step
        x, v, f = system.taken(start)
        if force is None or f is None:
            kicks, f = self._no_kicks, system.weights
        shape, first, last = x.shape, kicks[0] * dt, kicks[-1] * dt
        work, fractions = np.empty((3, *shape)), self._fractions[0]
        later = list(zip(kicks[1:], self._stages, self._fractions[1:], strict=False)) if self._many else None
        time, left_over, what, found = start.time, start.time_remainder, FLY, 0
        # Where this step begins and where the last one did. Nobody else knows their velocities, so that the arrays are
        # used again.
        here = before = x, v, time, left_over
        u, spare, next_spare = np.empty(shape), np.empty(shape), np.empty(shape)
        # A step of few atoms takes a microsecond in the kernel: each line here can be seen in the time of a run.
        new, array, double = np.empty, np.ndarray, np.dtype(np.float64)
        tables, (given, held) = flights.tables(), system.motion.sources
        cell = held.lattice
        one = many = flights.many if self._many else flights.one
        try:
            for made in range(steps):
                if held.lattice is not cell or given.lattice is not cell:
                    # The force function is a barostat, too.
                    tables, cell = flights.tables(), held.lattice
                out = new(shape)
                if later is None:
                    found = one(what, dt, x, v, u, last, first, f, out, *tables)
                else:
                    found = many(what, fractions, dt, 0, x, v, u, work, last, first, f, True, out, *tables)
                if found == UNENDED:
                    return _at(before, start, made - 1), made - 1
                here = x, v, time, left_over
                if later is not None:
                    for kick, stage, its_fractions in later:
                        if found < 0:
                            break
                        if force is not None:
                            now = time + (stage.ends[-1] * dt + left_over)
                            out.setflags(False)  # type: ignore[call-arg]
                            f = system.accepted(force(out, now), number + made + 1, False)
                        x, out = out, new(shape)
                        found = many(FLY, its_fractions, dt, 0, x, u, u, work, 0.0, kick * dt, f, False, out, *tables)
                if found < 0:
                    return _at(here, start, made), made
                # As State.later.
                change = dt + left_over
                then = time + change
                part = then - time
                left_over = (time - (then - part)) + (change - part)
                time = then
                if force is not None:
                    # The function can neither write to it nor will anybody else: it may keep what it sees.
                    out.setflags(False)  # type: ignore[call-arg]
                    raw: Any = force(out, time)
                    # What System.accepted finds most often.
                    if type(raw) is array and raw.dtype is double and raw.shape == shape and raw.flags.carray:
                        f = raw
                    else:
                        f = system.accepted(raw, number + made + 1, False)
                x, v, u, spare, next_spare, before, what = out, u, spare, next_spare, u, here, BOTH
        except InputError:
            return _at(here, start, made), made
        x = x.copy()  # other kernels are compiled for arrays that can be written to
        if flights.end(dt, x, v, work if self._many else NO_WORK, last, f, flights.tables()):
            return _at(before, start, steps - 1), steps - 1
        if found != flights.took:
            flights.took = found
            flights.motion.took(found)
        forces = start.forces if force is None else f.copy()
        state = system.last = State(x, v, time, forces, number + steps, None, left_over)
        return state, steps

    def _piecewise(self, system: System, start: State, dt: float) -> State:
        step = _Step(system, start, dt, self._many, self.exact_flight)
        # With rates of its own for each atom, friction and flight are only composed as RATTLE flights are.
        whole = step.exact and (system.friction is None or system.friction.uniform)
        stages = self._whole_stages if whole else self._stages
        if step.flights is not None:
            step.fractions = self._fractions
            step.tables = step.flights.tables()
        try:
            if system.velocity_dependent:
                step.with_velocities(self.drifts, stages)
            elif self.kick_first:
                step.kick_first(self.kicks, stages)
            else:
                step.drift_first(self.kicks, stages)
        except ConvergenceError as error:
            step.refuse_unsound()
            raise explained(error, system, start, dt, step.number) from error
        except ImageError as error:
            error.step = step.number
            raise
        except (InputError, NonFiniteError):
            step.refuse_overflow()
            raise
        return step.end()

    def _compiled(self, system: System, start: State, dt: float, flights: Flights) -> State:
        """K D K ... D K in few calls, each of which costs as much as its work on a few molecules."""
        x, before, forces = system.taken(start)
        shape, number = x.shape, start.step + 1
        time, time_remainder = start.later(dt)
        shift: FloatArray | None = None
        if start.remainder is not None:
            shift = x[system.anchor]
            x = (x - shift) + start.remainder
        force, kicks, f = system.force, self.kicks, forces
        if force is None or f is None:
            kicks, f = self._no_kicks, system.weights
        v, work, many, tables = np.empty(shape), NO_WORK, self._many, flights.tables()
        fly = flights.many if many else flights.one
        if many:
            work = np.empty((3, *shape))
        out, left = x, len(self._stages)
        try:
            for kick, stage, fractions in zip(kicks, self._stages, self._fractions, strict=False):
                left -= 1
                out = np.empty(shape)
                now = start.time + (stage.ends[-1] * dt + start.time_remainder) if left else time
                if many:
                    found = fly(
                        FLY, fractions, dt, 0, x, before, v, work, 0.0, kick * dt, f, before is not v, out, *tables
                    )
                else:
                    found = fly(FLY, dt, x, before, v, 0.0, kick * dt, f, out, *tables)
                if found != flights.took:
                    bad = flights.landed(found, fractions, dt, x, v, work, f, out, now, tables)
                    if bad:
                        check_finite(f, bad, number)
                x, before = out, v
                if force is not None:
                    f = system.accepted(force(lent(x if shift is None else x + shift), now), number, not left)
            bad = ""
            found = flights.end(dt, x, v, work, kicks[-1] * dt, f, tables)
            if found:
                bad = flights.ended(found, x, v, time, tables)
                if bad and bad != "far":
                    check_finite(f if bad == "force" else x if bad == "position" else v, bad, number)
        except ConvergenceError as error:
            raise explained(error, system, start, dt, number) from error
        except InputError:
            for array, item in ((out, "position"), (v, "velocity"), (work[1] if many else v, "velocity")):
                check_finite(array, item, number)
            raise
        if force is not None:
            forces = f
        remainder = None
        if shift is not None:
            out = x + shift
            remainder = x - (out - shift)
        elif bad:  # far by now: from here on relative to one atom
            remainder = work[0].copy() if many else np.zeros(shape)
        last = system.last = State(out, v, time, forces, number, remainder, time_remainder)
        return last


def _at(begin: tuple[FloatArray, FloatArray, float, float], start: State, made: int) -> State:
    """Where a step began, `made` steps after `start`; its forces have been forgotten since."""
    x, v, time, left_over = begin
    return State(x, v.copy(), time, None, start.step + made, None, left_over) if made else start


class Stage(NamedTuple):
    """A drift, as the RATTLE drifts that it consists of."""

    number: int
    #: Fractions of the step.
    fractions: tuple[float, ...]
    #: Fractions of the step at which they end.
    ends: tuple[float, ...]


def _stages(drifts: Sequence[float], flight: Sequence[float]) -> list[Stage]:
    flat = [a * w for a in drifts for w in flight]
    nodes = [math.fsum(flat[:k]) for k in range(1, len(flat))] + [1.0]
    n = len(flight)
    return [Stage(k // n, tuple(flat[k : k + n]), tuple(nodes[k : k + n])) for k in range(0, len(flat), n)]


class _Step:
    """The arrays of one step on its way."""

    def __init__(self, system: System, start: State, dt: float, many: bool, exact_flight: bool) -> None:
        self.system, self.start, self.dt = system, start, dt
        self.number = start.step + 1
        self.time, self.time_remainder = start.later(dt)
        circles = system.great_circles if exact_flight else None
        self.exact = circles is not None
        self.flight: Drift = system.drift if circles is None else circles
        #: Where stages are compiled: the fractions of the step that their flights take, and what the kernels need.
        self.flights = None if self.exact else system.flights
        self.fractions: Sequence[FloatArray] = ()
        self.tables: Packed = (NO_WORK, None, None, None)
        #: Where positions are far from the origin they are taken relative to one atom.
        self.shift: FloatArray | None = None
        x, v, self.forces = system.taken(start)
        if start.remainder is not None:
            self.shift = x[system.anchor]
            x = (x - self.shift) + start.remainder
        self.point = Point(x, v, system.weights, exact=many or self.exact)
        self.out = x
        self.now = start.time

    # -- stages ---------------------------------------------------------------------------------

    def kick_first(self, kicks: Sequence[float], stages: list[Stage]) -> None:
        """K D K ... D K."""
        self.kick(kicks[0])
        for fraction, stage in zip(kicks[1:-1], stages[:-1], strict=True):
            self.drift(stage)
            self.evaluate()
            self.kick(fraction)
        self.drift(stages[-1])
        self.evaluate(keep=True)
        self.kick(kicks[-1])
        self.project()

    def drift_first(self, kicks: Sequence[float], stages: list[Stage]) -> None:
        """D K D ... K D; the forces of the last kick are not those of the end."""
        self.drift(stages[0])
        for fraction, stage in zip(kicks, stages[1:], strict=True):
            self.evaluate()
            self.kick(fraction)
            self.drift(stage)
        self.forces = None
        self.project()

    def with_velocities(self, weights: Sequence[float], stages: list[Stage]) -> None:
        """Forces depend on v: half a kick with f(x0, v0), and half a one with f(x1, v1), solved for v1.

        Step and adjoint in one: symmetric, so that compositions keep their order.
        """
        for weight, stage in zip(weights, stages, strict=True):
            self.kick(0.5 * weight)
            self.drift(stage)
            self.settle(0.5 * weight)
        check_finite(self.point.v, "velocity", self.number)

    def kick(self, fraction: float) -> None:
        if self.system.force is None:
            return
        assert self.forces is not None
        self.point.kick(fraction * self.dt, self.forces)

    def drift(self, stage: Stage) -> None:
        dt, point = self.dt, self.point
        if self.system.friction is not None:
            self.damped_drift(stage, self.system.friction)
            return
        # Positions that the force function has seen are never written to again.
        self.out = out = np.empty_like(point.x)
        if self.flights is not None:
            self.now = now = self.ended(stage.ends[-1])
            bad = self.flights.move(point, self.fractions[stage.number], dt, out, now, self.tables)
            if bad:
                self.refuse(bad)
            return
        left = len(stage.ends)
        for fraction, end in zip(stage.fractions, stage.ends, strict=True):
            then, self.now = self.now, self.ended(end)
            left -= 1
            self.flight.move(point, point.work[2] if left % 2 else out, then, self.now, fraction * dt)
        self.refuse_unsound()

    def damped_drift(self, stage: Stage, friction: Friction) -> None:
        """Each flight between two halves of the friction."""
        point = self.point
        for fraction, end in zip(stage.fractions, stage.ends, strict=True):
            then, self.now = self.now, self.ended(end)
            h = fraction * self.dt
            self.damp(friction, 0.5 * h, then)
            self.out = out = np.empty_like(point.x)
            if self.flights is None:
                self.flight.move(point, out, then, self.now, friction.flight(h))
            else:
                bad = self.flights.move(point, _WHOLE, friction.flight(h), out, self.now, self.tables)
                if bad:
                    self.refuse(bad)
            self.damp(friction, 0.5 * h, self.now)

    def damp(self, friction: Friction, h: float, time: float) -> None:
        self.point.land()
        self.refuse_unsound()
        friction.damp(self.point.x, self.point.v, h, time)

    def ended(self, end: float) -> float:
        """The time at the fraction `end` of the step."""
        return self.time if end == 1.0 else self.start.time + (end * self.dt + self.start.time_remainder)

    def evaluate(self, *, keep: bool = False) -> None:
        """Forces where the step is now; to be kept, or for the next kick only."""
        if self.system.force is None:
            return
        point = self.point
        # The kick looks for NaN.
        self.forces = self.system.forces(self.positions, point.v, self.now, self.number, copy=keep, finite=False)

    def settle(self, fraction: float) -> None:
        """v = projected(v + h M^-1 f(x, v)), by iteration."""
        system, positions, now, point = self.system, self.positions, self.now, self.point
        half_kick = (fraction * self.dt) * system.inverse_masses
        point.land()
        drifted = point.v
        start = float(np.abs(drifted).max(initial=0.0))
        v, change = drifted, math.inf
        for _ in range(_MAX_ITERATIONS):
            forces = system.forces(positions, v, now, self.number)
            push = half_kick * forces
            following = system.motion.project_velocities(point.x, drifted + push, time=now)
            last, change = change, float(np.abs(following - v).max(initial=0.0))
            v = following
            # Where the system comes to rest, v is the small difference of what it had and the kick: these are rounded.
            size = max(start, float(np.abs(push).max(initial=0.0)), float(np.abs(v).max(initial=0.0)))
            if change <= 2 * _EPS * size or (change >= last and change <= 1e-13 * size):
                self.forces = system.forces(positions, v, now, self.number)
                point.restart(v)
                return
        raise ConvergenceError(
            f"velocity-dependent forces do not settle: the velocities still change by {change:.3g} "
            f"after {_MAX_ITERATIONS} iterations; time step too large",
            residual=change / max(size, float(np.finfo(float).tiny)),
            tolerance=2 * _EPS,
            iterations=_MAX_ITERATIONS,
        )

    def project(self) -> None:
        point = self.point
        if self.flights is not None:
            kick, force = point.take_kick()
            found = self.flights.end(self.dt, point.x, point.v, point.work, kick, force, self.tables)
            bad = self.flights.ended(found, point.x, point.v, self.now, self.tables)
            if bad and bad != "far":
                self.refuse(bad)
            return
        point.land()
        self.refuse_unsound()
        check_finite(point.x, "position", self.number)
        self.system.motion.project_velocities(point.x, point.v, time=self.now, out=point.v)
        check_finite(point.v, "velocity", self.number)

    # -- the end --------------------------------------------------------------------------------

    @property
    def positions(self) -> FloatArray:
        """Where the atoms are, for the force function."""
        return self.point.x if self.shift is None else self.point.x + self.shift

    def end(self) -> State:
        x, v = self.point.x, self.point.v
        positions, remainder = x, None
        if self.shift is not None:
            positions = x + self.shift
            remainder = x - (positions - self.shift)
        elif self.system.is_far(x):  # by now: from here on relative to one atom
            remainder = np.zeros_like(x) if self.point.x_low is None else self.point.x_low.copy()
        last = State(positions, v, self.time, self.forces, self.number, remainder, self.time_remainder)
        self.system.last = last
        return last

    def refuse(self, item: str) -> None:
        """Raise for what a compiled stage found."""
        point = self.point
        if item == "force":
            point.sound = False
            assert self.forces is not None
            check_finite(self.forces, item, self.number)
        check_finite(point.x if item == "position" else point.v, item, self.number)

    def refuse_unsound(self) -> None:
        """Raise if the force of a kick was not finite."""
        if not self.point.sound:
            self.refuse("force")

    def refuse_overflow(self) -> None:
        """Name overflow as what it is, where the engine met it first."""
        self.refuse_unsound()
        point = self.point
        for array, item in ((self.out, "position"), (point.v, "velocity"), (point.push, "velocity")):
            check_finite(array, item, self.number)
