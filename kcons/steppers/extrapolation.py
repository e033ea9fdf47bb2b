"""Steps that choose their own size and order: RATTLE extrapolated to many digits.

A symmetric scheme of order 2 that makes n steps in place of one misses by a series in (H/n)^2. Results for n = 1, 2, 3,
... are therefore extrapolated to infinitely many steps (Gragg, Bulirsch and Stoer), each column of the table two orders
higher than the one before; the difference of the last two is the estimate of the error.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, InputError, NonFiniteError, UnsupportedError
from kcons.steppers.rattle import Rattle
from kcons.steppers.state import State, System, check_finite
from kcons.steppers.stepper import Stepper

#: Columns of the table: order 2 k - 1 of the estimate. Beyond, rounding grows faster than the error shrinks.
FEWEST, MOST = 3, 9
#: A step is aimed at this share of the tolerance, and made somewhat shorter than that (Hairer, Norsett, Wanner II.9).
AIM, SAFETY = 0.65, 0.94
#: Bounds for the change of the size from one step to the next.
SHRINK, GROW = 0.1, 8.0
#: After a failure, such as no solution at so large a step.
FAILED = 0.25
#: An order is raised or lowered where it takes less than this share of the work for the same time.
LOWER, RAISE = 0.8, 0.9


@dataclass(frozen=True)
class _Plan:
    """How the next step is to be made."""

    size: float
    columns: int


class Extrapolation:
    """A symmetric stepper of order 2, extrapolated: step size and order as the tolerance demands.

    For a few bodies under smooth forces, where many digits count or where quiet stretches take turns with collisions.
    Constraints hold exactly at the end of every step, but the steps are neither reversible nor symplectic: energy is
    kept to the tolerance, not better, and drifts. Not for long runs of many atoms, nor for forces with a cutoff.

    Parameters
    ----------
    tolerance : float
        Allowed error of a step, root mean square over coordinates: of positions relative to `length`, of velocities
        relative to `speed`.
    length, speed : float, optional
        What is measured against; by default 1, and the root mean square of the velocities at the start (1 if all rest).
    base : Stepper, optional
        Reversible, of order 2; by default `Rattle`.

    Raises
    ------
    InputError
        A number that is not positive, or a tolerance that rounding cannot reach (below 1e-14).
    UnsupportedError
        The base is not reversible or not of order 2.

    References
    ----------
    Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, II.9 (control of order and step size);
    Hairer, Lubich and Wanner, Geometric Numerical Integration, IV.4 (projection) and VII.1.4 (RATTLE).
    """

    def __init__(
        self,
        tolerance: float = 1e-8,
        *,
        length: float = 1.0,
        speed: float | None = None,
        base: Stepper | None = None,
    ) -> None:
        if not (math.isfinite(tolerance) and tolerance >= 1e-14):
            raise InputError(f"tolerance is {tolerance}; give a number of 1e-14 or more", item="tolerance")
        for value, item in ((length, "length"), (speed, "speed")):
            if value is not None and not (math.isfinite(value) and value > 0):
                raise InputError(f"{item} is {value}; give a positive number", item=item)
        self.base: Stepper = Rattle() if base is None else base
        if not self.base.reversible or self.base.order != 2:
            raise UnsupportedError(
                f"{self.base!r} is no reversible stepper of order 2, whose errors are a series in dt^2; "
                "use Rattle or Geodesic"
            )
        self.tolerance, self.length, self.speed = float(tolerance), float(length), speed

    def __repr__(self) -> str:
        return f"Extrapolation({self.tolerance:g}, base={self.base!r})"

    def states(self, system: System, state: State, until: float, *, first_step: float | None = None) -> Iterator[State]:
        """The states at the ends of the steps, the last one at `until`.

        Parameters
        ----------
        system : System
        state : State
            Where to start, for example from `System.initial_state`.
        until : float
            Time of the last state; may be earlier than that of the first.
        first_step : float, optional
            Size of the first attempt; by default from velocities and accelerations.

        Yields
        ------
        state : State
            `step` counts the steps that were accepted.

        Raises
        ------
        InputError
            `until` or `first_step` is not finite; the force function returned a wrong shape.
        UnsupportedError
            A thermostat's state; the base may not be used with this system.
        ConvergenceError, NonFiniteError
            What the base raised at steps too small to be made smaller. The last state that came is intact.
        """
        if not math.isfinite(until):
            raise InputError(f"until is {until}", item="until")
        if first_step is not None and not (math.isfinite(first_step) and first_step > 0):
            raise InputError(f"first_step is {first_step}; give a positive number", item="first_step")
        if state.thermostat is not None:
            raise UnsupportedError("Extrapolation knows no thermostats; use a stepper with equal steps")
        self.base.check(system)
        return self._states(system, state, until, first_step)

    def _states(self, system: System, state: State, until: float, first_step: float | None) -> Iterator[State]:
        state = system.with_forces(state)
        speed = self.speed or float(np.sqrt(np.mean(state.velocities**2))) or 1.0
        plan = _Plan(first_step or self._first_size(system, state, speed, until), self._first_columns())
        while state.time != until:
            state, plan = self._advanced(system, state, until, plan, speed)
            yield state

    def _first_columns(self) -> int:
        # Hairer, Norsett, Wanner II.9, eq. 9.35 in spirit: two digits a column.
        return int(np.clip(round(-0.6 * math.log10(self.tolerance) + 0.5), FEWEST, MOST - 1))

    def _first_size(self, system: System, state: State, speed: float, until: float) -> float:
        assert state.forces is not None
        v = state.velocities
        a = system.motion.acceleration(state.positions, v, state.forces, state.time)
        rate = math.sqrt(float(np.mean(v * v))) / self.length + math.sqrt(float(np.mean(a * a))) / speed
        return min(0.1 / rate, abs(until - state.time)) if rate > 0 else abs(until - state.time)

    def _advanced(self, system: System, start: State, until: float, plan: _Plan, speed: float) -> tuple[State, _Plan]:
        """The state after one step, and how to make the next one."""
        smallest = 16 * float(np.spacing(max(abs(start.time), abs(until))))
        failed = False
        while True:
            left = until - start.time
            last = plan.size >= abs(left)
            size = left if last else math.copysign(plan.size, left)
            try:
                table = _Table(self, system, start, size, speed)
                fits = table.fill(plan.columns)
                if fits:
                    state = self._landed(system, start, table, until if last else None)
                    return state, table.following(grow=not failed)
            except (ConvergenceError, NonFiniteError):
                if abs(size) <= smallest:
                    raise
                plan = _Plan(FAILED * abs(size), max(FEWEST, plan.columns - 1))
            else:
                plan = table.following(grow=False)
                if abs(size) <= smallest:
                    raise ConvergenceError(
                        f"step {start.step + 1} at time {start.time:g}: the error stays above the tolerance "
                        f"{self.tolerance:g} at steps of {abs(size):.3g}; forces that jump, or a tolerance that "
                        "rounding does not allow",
                        residual=table.error * self.tolerance,
                        tolerance=self.tolerance,
                        step=start.step + 1,
                    )
            failed = True

    def _landed(self, system: System, start: State, table: _Table, until: float | None) -> State:
        """The extrapolated point, brought onto the constraints."""
        number = start.step + 1
        time, time_remainder = (until, 0.0) if until is not None else start.later(table.size)
        shift = None
        x = start.positions
        if start.remainder is not None:
            shift = x[system.anchor]
            x = (x - shift) + start.remainder
        x = x + table.best[0]
        v = start.velocities + table.best[1]
        check_finite(x, "position", number)
        check_finite(v, "velocity", number)
        motion = system.motion
        x = motion.project_positions(x, x, time=time, reference_time=time)
        v = motion.project_velocities(x, v, time=time)
        positions, remainder = x, None
        if shift is not None:
            positions = x + shift
            remainder = x - (positions - shift)
        elif system.is_far(x):
            remainder = np.zeros_like(x)
        f = system.forces(positions, v, time, number)
        return State(positions, v, time, f, number, remainder, time_remainder)


class _Table:
    """The table of one step: changes of positions and velocities, line by line.

    Attributes
    ----------
    best : ndarray, shape (2, n_atoms, 3)
        The last entry of the last line.
    error : float
        Its estimated error, in units of the tolerance.
    """

    def __init__(self, scheme: Extrapolation, system: System, start: State, size: float, speed: float) -> None:
        self.scheme, self.system, self.start, self.size = scheme, system, start, size
        self._scale = np.array([scheme.length, speed])[:, None, None] * scheme.tolerance
        self._line: list[FloatArray] = []
        self._errors: list[float] = []

    def fill(self, aim: int) -> bool:
        """Compute lines up to the one that is good enough, near `aim`; False if there is none to be expected.

        Hairer, Norsett and Wanner II.9: three chances, the first two of which look ahead.
        """
        for columns in range(1, min(aim + 1, MOST) + 1):
            self._add(columns)
            if columns < max(2, aim - 1):
                continue
            if self.error <= 1.0:
                return True
            # What the lines that are still to come can at most be expected to gain.
            ahead = range(columns + 1, min(aim + 1, MOST) + 1)
            if self.error > math.prod(n**2 for n in ahead):
                return False
        return False

    @property
    def best(self) -> FloatArray:
        return self._line[-1]

    @property
    def error(self) -> float:
        return self._errors[-1]

    def _add(self, n: int) -> None:
        """Line n: n steps of the base, extrapolated with the lines before (Aitken and Neville)."""
        entry = self._steps(n)
        line = [entry]
        for k, above in enumerate(self._line, 1):
            entry = entry + (entry - above) / ((n / (n - k)) ** 2 - 1.0)
            line.append(entry)
        self._line = line
        off = (line[-1] - line[-2]) / self._scale if n > 1 else np.array(np.inf)
        self._errors.append(float(np.sqrt(np.mean(off**2))))

    def _steps(self, n: int) -> FloatArray:
        """What n steps of the base change."""
        start, base, dt = self.start, self.scheme.base, self.size / n
        march = getattr(base, "march", None)
        state = start
        if march is not None:
            state = march(self.system, state, dt, n)
        else:
            for _ in range(n):
                state = base.step(self.system, state, dt)
        moved = state.positions - start.positions
        if start.remainder is not None and state.remainder is not None:
            moved += state.remainder - start.remainder
        return np.stack([moved, state.velocities - start.velocities])

    def following(self, *, grow: bool) -> _Plan:
        """Size and order of the next step, or of the next attempt: those with the least work for the time."""
        made = len(self._errors)
        sizes, works = {}, {}
        for k in range(2, made + 1):
            error = max(self._errors[k - 1], 1e-30)
            factor = SAFETY * (AIM / error) ** (1.0 / (2 * k - 1))
            sizes[k] = abs(self.size) * min(GROW, max(SHRINK, factor))
            works[k] = _work(k) / sizes[k]
        k = made
        if k > FEWEST and works[k - 1] < LOWER * works[k]:
            k -= 1
        elif grow and k < MOST and works.get(k - 1, math.inf) > works[k] / RAISE:
            sizes[k + 1] = sizes[k] * _work(k + 1) / _work(k)
            k += 1
        return _Plan(sizes[k] if grow else min(sizes[k], abs(self.size)), max(k, FEWEST))


def _work(columns: int) -> int:
    """Force evaluations of a step: those of all lines, and one at its end."""
    return columns * (columns + 1) // 2 + 1
