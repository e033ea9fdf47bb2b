"""The interpreter of time steps on arrays: programs run in compiled calls, and in Python where no kernel can.

The kernel (`compiled_operations`) makes as many operations as it knows in one call: kicks, flights, great
circles, projections. It comes back for the forces, for operations that have a method of their name here, and for rows
that it cannot solve: those that move, are too many or of kinds that kernels do not know are solved by the engine, as
are those that need more means.
"""

from __future__ import annotations

import math
from typing import Any
from weakref import ref

import numpy as np
from numpy import empty, ndarray

from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, ImageError, InputError
from kcons.solvers.tolerances import EPS, MAX_ITERATIONS
from kcons.steppers.compiled_operations import (
    ENGINE,
    FAR,
    ITERATIONS,
    PYTHON,
    check_finite,
    kernel,
    tangents,
)
from kcons.steppers.operations import Operation, Program, Row
from kcons.steppers.state import State, System
from kcons.steppers.stepper import Listed, explained, stays

_FLOAT = np.dtype(np.float64)
_EMPTY = np.empty(0)


class Interpreted(Listed):
    """Base of the steppers whose steps the interpreter makes."""

    def check(self, system: System) -> None:
        """Raise `UnsupportedError` where the stepper may not be used: unless a stepper says otherwise, nowhere."""

    def program(self, system: System | None) -> Program:
        """A step as the interpreter goes through it; without a System, of forces of positions and time only."""
        raise NotImplementedError

    def operations(self, system: System | None = None) -> tuple[Operation, ...]:
        return self.program(system).operations

    def parts(self, system: System | None = None) -> tuple[Operation, ...]:
        return self.program(system).parts

    def begun(self, system: System, state: State, dt: float, steps: int) -> Interpreter:
        """Steps that are about to be made from a state, as many as can be made at once.

        Raises
        ------
        InputError
            The state carries variables of another thermostat.
        """
        raise NotImplementedError

    def note(self, state: State) -> None:
        """Remember what steps have ended in."""

    def at_once(self, state: State, steps: int) -> int:
        """How many of the steps may be made before `begun` looks at the state again."""
        return steps

    def depends_on(self, system: System, state: State) -> Any:
        """What `begun` looks at besides the state: while it stays the same, steps go on. None: they never do."""
        return system.velocity_dependent

    def _made_from(self, system: System, state: State, dt: float, steps: int) -> tuple[State, int]:
        """The state after steps, and how many they were."""
        kept, system.going = system.going, None
        known = self.depends_on(system, state)
        if kept is not None and kept[0] is state and kept[1] is self and kept[2] == known and kept[3].dt == dt:
            on_their_way = kept[3]
            n = steps if steps == 1 else self.at_once(state, steps)
            on_their_way.resume(state, n, state.positions, state.velocities, state.forces)
        else:
            self.check(system)
            still = stays(state, dt)
            if still is not None:
                return still, 1
            on_their_way = self.begun(system, state, dt, self.at_once(state, steps))
        after = on_their_way.through()
        self.note(after)
        if known is not None:
            system.going = after, self, known, on_their_way
        return after, on_their_way.made

    # As a decorator this costs half of a `with`. What overflows is looked for, and named with the step's number.
    @np.errstate(over="ignore", invalid="ignore", divide="ignore")
    def step(self, system: System, state: State, dt: float) -> State:
        """Advance by `dt`; 0 changes nothing.

        Raises
        ------
        ConvergenceError
            No solution (the step is too large); carries `step`.
        NonFiniteError
            A force, position or velocity became NaN or infinite; carries `step`.
        InputError
            `dt` is not finite, or negative and cannot be taken back; the force function returned a wrong shape; the
            state carries variables of another thermostat.
        UnsupportedError
            The stepper may not be used with this system.
        """
        return self._made_from(system, state, dt, 1)[0]

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")
    def march(self, system: System, state: State, dt: float, steps: int) -> State:
        """The state after so many steps, the same to the last bit as by `step`; errors as of `step`.

        Nobody looks at the states between: where all is compiled, the end of a step and the beginning of the next are
        one call.
        """
        self.check(system)
        alone = type(self).step is not Interpreted.step
        while steps > 0:
            state, made = (self.step(system, state, dt), 1) if alone else self._made_from(system, state, dt, steps)
            steps -= made
        return state


class Interpreter:
    """Steps on their way from one state.

    Parameters
    ----------
    system : System
    start : State
        With its forces, if the program begins with them.
    dt : float
    program : Program
    steps : int
        How many are wanted; one is made if the state has a remainder, since the atom that positions are relative to
        moves, and as many as it takes if the system becomes far from the origin.
    numbers : ndarray, optional
        Those of the functions that the program calls, and of a thermostat.
    """

    __slots__ = (
        *("system", "dt", "program", "start", "steps", "made", "number", "shape", "shift", "begun", "x", "v", "out"),
        *("known", "forces", "low", "push", "spare", "room", "numbers", "time", "left_over", "then", "left_over_then"),
        "unchanging",
    )
    # x, v, forces: where forces were evaluated last (near the origin; where `here` is not 0, positions are in another
    # array), and these, shape (n_groups n_atoms, 3). number: of the step that is made.

    #: Whether forces are those of the System's function, all at once.
    simple = True

    def __init__(
        self,
        system: System,
        start: State,
        dt: float,
        program: Program,
        steps: int = 1,
        numbers: FloatArray = _EMPTY,
    ) -> None:
        self.system, self.dt, self.program = system, dt, program
        x, v, f = system.kernel_arrays(start)
        self.shape = shape = x.shape
        self.known = f is not None
        self.forces: FloatArray = np.zeros(shape) if f is None or system.force is None else f
        self.low: FloatArray | None = None
        begin = len(program.numbers)
        first = begin + (3 * x.size if program.pairs else 0)
        self.room = room = np.zeros(first + len(numbers))
        room[:begin], room[first:] = program.numbers, numbers
        self.numbers = room[first:]
        if program.pairs:
            self.low, self.push, self.spare = room[begin:first].reshape(3, *shape)
        sets, lists = system.motion.sources, (program.rows, program.shown, program.ends, program.flies)
        simple, end = self.simple and not system.velocity_dependent, len(program.rows) - 1
        self.unchanging = kernel(), system, dt, room, shape, *sets, *lists, simple, end
        self.then, self.left_over_then, self.number = start.time, start.time_remainder, start.step
        self.resume(start, steps, x, v, f)

    def resume(self, state: State, steps: int, x: FloatArray, v: FloatArray, forces: FloatArray | None) -> None:
        """Get ready for more steps from a state, that which the last ones have ended in, and its arrays."""
        self.start, self.steps, self.made, self.x, self.shift = state, steps, -1, x, None
        if state.remainder is not None:
            self.steps, (self.x, self.shift) = 1, self.system.near_origin(state)
        self.v, self.out = v.copy(), np.empty(self.shape)
        if self.low is None:
            self.push, self.spare = self.v, self.out
        else:
            self.low.fill(0.0)
        if self.simple and forces is not None and self.system.force is not None:
            self.forces = forces  # those of the function may be in an array that it uses again
        self._next_step()

    # -- the loop -------------------------------------------------------------------------------

    def through(self) -> State:
        """Make the steps; `made` is how many were.

        Raises
        ------
        ConvergenceError, ImageError, NonFiniteError
            With `step`.
        InputError
            As of the force function.
        """
        try:
            here = self._march()
        except ConvergenceError as error:
            before = State(self.whole(self.begun), self.v, self.time)
            raise explained(error, self.system, before, self.dt, self.number) from error
        except ImageError as error:
            error.step = self.number
            raise
        except InputError:
            # Overflow, where the engine met it first.
            for numbers, item in ((self.out, "position"), (self.v, "velocity"), (self.push, "velocity")):
                check_finite(numbers, item, self.number)
            raise
        return self.end(here)

    def _march(self) -> int:
        """Go through the program; where the positions are in the end."""
        # A step of few atoms takes a microsecond in the kernel: each line here can be seen in the time of a run.
        run, system, dt, room, shape, given, held, rows, shown, ends, flies, simple, end = self.unchanging
        v, packed, force, shift, at = self.v, system.packed, system.force, self.shift, 0
        room[ENGINE] = packed is None
        tables = system.tables_without_rows if packed is None else packed.tables
        cell, last = held.lattice, self.steps - 1
        x, out, forces, more = self.x, self.out, self.forces, self.made < last
        while True:
            begun, found = at, run(at, more, dt, x, out, v, forces, room, tables)
            at = found if found >= 0 else -1 - found
            if at < begun:
                self.x = x
                self._next_step()
                more = self.made < last
            if simple and shown[at]:  # `evaluate`, in less time
                x = out
                if force is not None:
                    # The function can neither write to it nor will anybody else: it may keep what it sees.
                    x.setflags(False)  # type: ignore[call-arg]
                    until, there, self.out = ends[at], x, x
                    now = self.then if until == 1.0 else self.time + (until * dt + self.left_over)
                    if shift is not None:
                        there = x + shift
                        there.setflags(False)  # type: ignore[call-arg]
                    raw: Any = force(there, now)
                    # What System.accepted finds most often.
                    usual = type(raw) is ndarray and raw.dtype is _FLOAT and raw.shape == shape and raw.flags.carray
                    forces = raw if usual else system.accepted(raw, self.number, False)
                    self.known = True
                    if held.lattice is not cell or given.lattice is not cell:
                        # It may be a barostat, too.
                        tables, cell = tables if packed is None else packed.tables, held.lattice
                if more or flies[at]:
                    out = empty(shape)
                at += 1
                continue
            self.x, self.out, self.forces = x, out, forces
            row = rows[at]
            if at == end:
                if row.here:
                    self.x = x = self.place(row.here)
                if not more or room[FAR]:
                    break
                # The kernel goes on by itself but where positions are in another array.
                out, at = empty(shape), 0
                if self.low is not None:
                    self.low.fill(0.0)
                self._next_step()
                more = self.made < last
                continue
            if found >= 0 and row.verb != PYTHON:
                check_finite(self.force_of(row), "force", self.number)
            if packed is not None and found < 0:
                packed.refuse()
            getattr(self, row.name)(row, found < 0)
            x, out, forces, at = self.x, self.out, self.forces, at + 1
            if packed is not None:
                tables = packed.tables
        self.made += 1
        if packed is not None and room[ITERATIONS] != packed.iterations:
            packed.took(room[ITERATIONS])
        return row.here

    def _next_step(self) -> None:
        """Begin the next step: its time is that at which the last one ended, and ends as State.later."""
        self.made += 1
        self.number += 1
        self.begun = self.x
        self.time = time = self.then
        self.left_over = left_over = self.left_over_then
        change = self.dt + left_over
        self.then = then = time + change
        part = then - time
        self.left_over_then = (time - (then - part)) + (change - part)

    # -- where it is ----------------------------------------------------------------------------

    def place(self, number: int) -> FloatArray:
        """The array of positions of this number."""
        if number == 0 and not self.x.flags.writeable:
            self.x = self.x.copy()  # the engine's kernels are compiled for arrays that can be written to
        return (self.x, self.out, self.spare)[number]

    def at(self, end: float) -> float:
        """The time at the fraction `end` of the step."""
        if end == 1.0:
            return self.then
        return self.time + (end * self.dt + self.left_over) if end else self.time

    def whole(self, x: FloatArray) -> FloatArray:
        """Positions as the force function sees them."""
        return x if self.shift is None else x + self.shift

    def force_of(self, row: Row) -> FloatArray:
        """The forces of its group."""
        n = len(self.x)
        return self.forces[row.group * n : (row.group + 1) * n]

    def along(self, v: FloatArray, x: FloatArray, time: float) -> FloatArray:
        """v itself, made tangent to the constraints at x."""
        packed = self.system.packed
        if packed is None or not tangents()(x, v, packed.tables):
            if packed is not None:
                packed.refuse()
            self.system.motion.project_velocities(x, v, time=time, out=v)
        return v

    def show(self, row: Row) -> None:
        """Let go of the positions that a force function is going to see: they are not written to again."""
        if row.here:
            self.x = self.place(row.here)
            self.out = np.empty(self.x.shape)

    # -- verbs ----------------------------------------------------------------------------------
    # Each is given its row, and whether the kernel has done all of it but the solve.

    def fly(self, row: Row, begun: bool) -> None:
        """The end of a flight along the constraints, from velocities on them or off by M^-1 A^T times anything.

        x1 = x0 + h u with sigma(x1, t1) = 0, u = v + M^-1 A(x0)^T l: RATTLE without forces, order 2. The impulse takes
        what v has across the constraints, so that kicks need no projection before it. Rows of velocities hold at the
        middle, a((x0 + x1)/2) . u = c((t0 + t1)/2), which is the symmetric choice.

        References
        ----------
        McLachlan and Perlmutter, J. Nonlinear Sci. 16, 283 (2006).
        """
        h, here, there = row.length * self.dt, self.place(row.here), self.place(row.there)
        self.room[ITERATIONS] = -1.0
        self.system.motion.project_positions(
            there, here, time=self.at(row.end), reference_time=self.at(row.begin), velocities=self.push, dt=h, flight=h,
            out=there,
        )  # fmt: skip

    def project(self, row: Row, begun: bool) -> None:
        """Velocities onto the constraints."""
        x = self.place(row.here)
        check_finite(x, "position", self.number)
        self.system.motion.project_velocities(x, self.v, time=self.at(row.end), out=self.v)
        check_finite(self.v, "velocity", self.number)

    def evaluate(self, row: Row, begun: bool) -> None:
        """Forces at the new positions; the kick looks for NaN."""
        self.show(row)
        if self.system.force is not None:
            x = self.whole(self.x)
            self.forces = self.system.forces(x, self.v, self.at(row.end), self.number, copy=False, finite=False)
            self.known = True

    def settle(self, row: Row, begun: bool) -> None:
        """v = projected(v + h M^-1 f(x, v)), by iteration."""
        system, now = self.system, self.at(row.end)
        self.show(row)
        positions, drifted = self.whole(self.x), self.v.copy()
        half_kick = (row.length * self.dt) * system.inverse_masses
        start = float(np.abs(drifted).max(initial=0.0))
        v, change = drifted, math.inf
        for _ in range(MAX_ITERATIONS):
            forces = system.forces(positions, v, now, self.number)
            push = half_kick * forces
            following = system.motion.project_velocities(self.x, drifted + push, time=now)
            last, change = change, float(np.abs(following - v).max(initial=0.0))
            v = following
            # Where the system comes to rest, v is the small difference of what it had and the kick: these are rounded.
            size = max(start, float(np.abs(push).max(initial=0.0)), float(np.abs(v).max(initial=0.0)))
            if change <= 2 * EPS * size or (change >= last and change <= 1e-13 * size):
                self.forces, self.known = system.forces(positions, v, now, self.number), True
                np.copyto(self.v, v)
                check_finite(self.v, "velocity", self.number)
                return
        raise ConvergenceError(
            f"velocity-dependent forces do not settle: the velocities still change by {change:.3g} "
            f"after {MAX_ITERATIONS} iterations; time step too large",
            residual=change / max(size, float(np.finfo(float).tiny)),
            tolerance=2 * EPS,
            iterations=MAX_ITERATIONS,
        )

    # -- the end --------------------------------------------------------------------------------

    def end(self, here: int) -> State:
        """The state, with remainders from here on if it is far from the origin by now."""
        system, start, x, remainder = self.system, self.start, self.x, None
        if self.shift is not None:
            x = self.x + self.shift
            remainder = self.x - (x - self.shift)
        else:
            if not x.flags.writeable:  # lent to a function, which may have kept it
                x = x.copy()
            if self.room[FAR]:
                remainder = np.zeros_like(x) if self.low is None else self.low.copy()
        time, v, forces, variables = self.then, self.v, self.applied(here), self.variables()
        for array in (x, v, remainder, variables, None if system.force is None else forces):
            if array is not None:
                array.setflags(False)  # type: ignore[call-arg]  # write, which by name takes three times as long
        last = time, forces, self.number, remainder, self.left_over_then, variables, start.barostat
        after = system.last = State(x, v, *last, (ref(system), x, v, time))
        return after

    def applied(self, here: int) -> FloatArray | None:
        """The forces at the end, None where a drift came last."""
        if self.system.force is None:
            return self.start.forces if self.known else None
        return self.forces.copy() if self.known and not here else None

    def variables(self) -> FloatArray | None:
        """Those of a thermostat."""
        return None
