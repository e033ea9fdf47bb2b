"""What a step counts from: positions relative to an atom where they are far from the origin, and the exact time."""

from __future__ import annotations

from weakref import ref

from kcons.constraints.target import FloatArray
from kcons.steppers.state import State, System


class Frame:
    """Where a step begins, and the state that it ends in.

    Attributes
    ----------
    x, v, forces : ndarray, shape (n_atoms, 3)
        Of the start, as kernels can take them; positions near the origin. The forces may be None.
    shift : ndarray, shape (3,), or None
        What was taken from the positions.
    number : int
        Of the state at the end.
    time, left_over : float
        At the end, and what its rounding leaves over.
    """

    __slots__ = ("dt", "forces", "left_over", "number", "shift", "start", "system", "time", "v", "x")

    def __init__(self, system: System, start: State, dt: float) -> None:
        self.system, self.start, self.dt = system, start, dt
        self.number = start.step + 1
        self.time, self.left_over = start.later(dt)
        x, self.v, self.forces = system.taken(start)
        self.shift: FloatArray | None = None
        self.x: FloatArray = x
        remainder = system.remainder_of(start)
        if remainder is not None:
            self.shift = x[system.anchor]
            self.x = (x - self.shift) + remainder

    def at(self, end: float) -> float:
        """The time at the fraction `end` of the step."""
        return self.time if end == 1.0 else self.start.time + (end * self.dt + self.start.time_remainder)

    def whole(self, x: FloatArray) -> FloatArray:
        """Positions as the force function sees them."""
        return x if self.shift is None else x + self.shift

    def closed(
        self,
        x: FloatArray,
        v: FloatArray,
        forces: FloatArray | None,
        thermostat: FloatArray | None = None,
        low: FloatArray | None = None,
    ) -> State:
        """The state at the end of the step, with what rounding takes from its positions.

        `low` is that where positions are whole and have become so large that it counts from here on.
        """
        positions, remainder = x, low
        if self.shift is not None:
            positions = x + self.shift
            remainder = x - (positions - self.shift)
        system, number = self.system, self.number
        origin = ref(system), positions, v, self.time
        more = thermostat, self.start.barostat
        last = State(positions, v, self.time, forces, number, remainder, self.left_over, *more, origin=origin)
        system.last = last
        return last
