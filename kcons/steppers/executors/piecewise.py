"""The operations of a step one after another, on arrays."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, ImageError, InputError, NonFiniteError
from kcons.steppers.executors.frame import Frame
from kcons.steppers.operations import Damp, Fly, Kick, Operation, Settle
from kcons.steppers.stages.compensated_steps import Point, check_finite
from kcons.steppers.stages.drifts import Drift
from kcons.steppers.stages.fused_stages import END, NO_FRACTIONS
from kcons.steppers.state import State, System
from kcons.steppers.stepper import explained

_MAX_ITERATIONS = 50
_EPS = float(np.finfo(float).eps)
_WHOLE = np.ones(1)


class ArrayStep:
    """One step on its way, for those who have methods of the verbs of its operations.

    Attributes
    ----------
    x, v : ndarray, shape (n_atoms, 3)
        Where it is. Positions that the force function has seen are never written to again.
    now : float
        The time there.
    forces : ndarray, shape (n_atoms, 3), or None
        The last ones that are known.
    """

    def __init__(self, system: System, start: State, dt: float) -> None:
        self.system, self.dt = system, dt
        self.frame = frame = Frame(system, start, dt)
        self.number, self.now = frame.number, start.time
        self.x, self.v, self.forces = frame.x, frame.v, frame.forces

    def through(self, operations: Sequence[Operation]) -> State:
        """Do them all.

        Raises
        ------
        ConvergenceError, ImageError, NonFiniteError
            With `step`.
        InputError
            As of the force function.
        """
        try:
            for operation in operations:
                getattr(self, operation.verb)(operation)
        except ConvergenceError as error:
            self.refuse_unsound()
            raise explained(error, self.system, self.frame.start, self.dt, self.number) from error
        except ImageError as error:
            error.step = self.number
            raise
        except (InputError, NonFiniteError):
            self.refuse_overflow()
            raise
        return self.end()

    def pieces(self, operation: Fly) -> list[tuple[float, float]]:
        """Length of each flight of a drift, and the time at its end."""
        flights = zip(operation.flights, operation.ends, strict=True)
        return [(fraction * self.dt, self.frame.at(end)) for fraction, end in flights]

    def fly(self, operation: Fly) -> None:
        """The drift, from velocities on the constraints; they are then those along its end."""
        system = self.system
        circles = system.great_circles if operation.exact else None
        x, now = self.x, self.now
        point = Point(x, self.v, system.weights, exact=len(operation.flights) > 1 or circles is not None)
        flights = None if operation.exact else system.flights
        if flights is not None:
            now, fractions, dt = self.frame.at(operation.ends[-1]), operation.lengths, self.dt
            if len(fractions) == 1:
                fractions, dt = _WHOLE, fractions[0] * dt
            flights.move(point, fractions, dt, np.empty(x.shape), now, self.number, flights.tables())
        else:
            flight = system.drift if circles is None else circles
            for h, end in self.pieces(operation):
                flight.move(point, np.empty(x.shape), now, end, h)
                now = end
        point.land()
        self.x, self.v, self.now = point.x, point.v, now

    def along(self, v: FloatArray) -> FloatArray:
        """v itself, made tangent to the constraints where the step is now."""
        system, flights, x = self.system, self.system.flights, self.x
        if flights is None:
            return system.motion.project_velocities(x, v, time=self.now, out=v)
        found = flights.one(END, 0.0, x, v, v, 0.0, 0.0, system.weights, x, flights.tables())
        if found:
            flights.ended(found, x, v, system.weights, self.now, self.number, flights.tables())
        return v

    def evaluate(self, operation: Operation) -> None:
        """Forces where the step is now."""
        if self.system.force is not None:
            self.forces = self.system.forces(self.frame.whole(self.x), self.v, self.now, self.number)

    def refuse_unsound(self) -> None:
        """Raise if a force was not finite, for operations that do not look at once."""

    def refuse_overflow(self) -> None:
        """Raise for numbers that are not finite, where the engine met them first."""

    def end(self) -> State:
        """The state that the step ends in."""
        raise NotImplementedError


class SplittingStep(ArrayStep):
    """A step of kicks and drifts.

    Drifts and kicks share a `Point`, which adds up what rounding takes; where the engine's solvers allow it, a drift is
    one compiled call.
    """

    def __init__(self, system: System, start: State, dt: float, *, exact: bool, many: bool) -> None:
        """`exact`: drifts follow great circles; `many`: there are several flights."""
        super().__init__(system, start, dt)
        circles = system.great_circles if exact else None
        self.flight: Drift = system.drift if circles is None else circles
        self.flights = None if exact else system.flights
        self.tables = NO_FRACTIONS if self.flights is None else self.flights.tables()
        self.point = Point(self.x, self.v, system.weights, exact=many or exact)
        self.out = self.x
        #: Whether a drift has come after the last forces.
        self.stale = False

    # -- verbs ----------------------------------------------------------------------------------

    def kick(self, operation: Kick) -> None:
        if self.system.force is None:
            return
        assert self.forces is not None
        self.point.kick(operation.fraction * self.dt, self.forces)

    def fly(self, operation: Fly) -> None:
        dt, point, friction = self.dt, self.point, self.system.friction
        self.out = out = np.empty(point.x.shape)
        self.stale = True
        if self.flights is not None:
            fractions = operation.lengths
            if friction is not None:
                fractions, dt = _WHOLE, friction.flight(operation.flights[0] * dt)
            self.now = self.frame.at(operation.ends[-1])
            self.flights.move(point, fractions, dt, out, self.now, self.number, self.tables)
            return
        left = len(operation.ends)
        for fraction, end in zip(operation.flights, operation.ends, strict=True):
            then, self.now, h = self.now, self.frame.at(end), fraction * dt
            left -= 1
            length = h if friction is None else friction.flight(h)
            self.flight.move(point, point.work[2] if left % 2 else out, then, self.now, length)
        if not point.sound:
            self.refuse_unsound()

    def damp(self, operation: Damp) -> None:
        point, friction = self.point, self.system.friction
        assert friction is not None
        point.land()
        self.refuse_unsound()
        friction.damp(point.x, point.v, operation.fraction * self.dt, self.now)

    def evaluate(self, operation: Operation) -> None:
        self.stale = False
        if self.system.force is None:
            return
        point = self.point
        # Good until the next evaluation. The kick looks for NaN.
        self.forces = self.system.forces(
            self.frame.whole(point.x), point.v, self.now, self.number, copy=False, finite=False
        )

    def settle(self, operation: Settle) -> None:
        """v = projected(v + h M^-1 f(x, v)), by iteration."""
        system, now, point = self.system, self.now, self.point
        positions = self.frame.whole(point.x)
        half_kick = (operation.fraction * self.dt) * system.inverse_masses
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
                self.stale = False
                point.restart(v)
                check_finite(point.v, "velocity", self.number)
                return
        raise ConvergenceError(
            f"velocity-dependent forces do not settle: the velocities still change by {change:.3g} "
            f"after {_MAX_ITERATIONS} iterations; time step too large",
            residual=change / max(size, float(np.finfo(float).tiny)),
            tolerance=2 * _EPS,
            iterations=_MAX_ITERATIONS,
        )

    def project(self, operation: Operation) -> None:
        point = self.point
        if self.flights is not None:
            # The force function may be a barostat, too.
            self.flights.end(point, self.dt, self.now, self.number, self.flights.tables())
            return
        point.land()
        self.refuse_unsound()
        check_finite(point.x, "position", self.number)
        self.system.motion.project_velocities(point.x, point.v, time=self.now, out=point.v)
        check_finite(point.v, "velocity", self.number)

    # -- the end --------------------------------------------------------------------------------

    def end(self) -> State:
        """The state, with remainders from here on if it is far from the origin by now.

        It has no forces where a drift came last.
        """
        system, point = self.system, self.point
        forces = None
        if not self.stale and self.forces is not None:
            forces = self.forces if system.force is None else self.forces.copy()
        low = None
        if self.frame.shift is None and system.is_far(point.x):
            low = np.zeros_like(point.x) if point.x_low is None else point.x_low.copy()
        return self.frame.closed(point.x, point.v, forces, low=low)

    def refuse_unsound(self) -> None:
        """Raise if the force of a kick was not finite."""
        if not self.point.sound:
            assert self.forces is not None
            check_finite(self.forces, "force", self.number)

    def refuse_overflow(self) -> None:
        """Report overflow as such where the engine met it first."""
        self.refuse_unsound()
        point = self.point
        for array, item in ((self.out, "position"), (point.v, "velocity"), (point.push, "velocity")):
            check_finite(array, item, self.number)
