"""Steps that choose their own size and order: RATTLE, or a geodesic splitting, extrapolated to many digits.

A symmetric scheme of order 2 that makes n steps in place of one misses by a series in (H/n)^2. Results for n = 1, 2, 3,
... are therefore extrapolated to infinitely many steps (Gragg, Bulirsch and Stoer), each column of the table two orders
higher than the one before; the difference of the last two is the estimate of the error.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from kcons.constraints.arguments import Positive, checked, finite_number, positive
from kcons.constraints.target import FloatArray
from kcons.errors import (
    ConvergenceError,
    InputError,
    KconsError,
    NonFiniteError,
    SingularGeometryError,
    UnsupportedError,
)
from kcons.steppers.splitting import Geodesic
from kcons.steppers.stages.compiled_operations import check_finite
from kcons.steppers.state import State, System
from kcons.steppers.stepper import Stepper, require_stepper, retold

#: Columns of the table: order 2 k - 1 of the estimate. Each one nearly doubles what rounding adds.
FEWEST, MOST = 3, 9
#: A step is aimed at this share of the tolerance, and made somewhat shorter than that.
AIM, SAFETY = 0.65, 0.85
#: Bounds for the change of the size from one step to the next; the size after no solution at so large a step.
SHRINK, GROW, FAILED = 0.1, 8.0, 0.5
#: An order is raised or lowered where it takes less than this share of the work for the same time.
LOWER, RAISE = 0.8, 0.9
#: Size of the first step, relative to the time in which the start changes.
FIRST = 0.1
_EPS = float(np.finfo(float).eps)


class _Plan(NamedTuple):
    """How the next step is to be made."""

    size: float
    columns: int


class Extrapolation:
    """A symmetric stepper of order 2, extrapolated: step size and order as the tolerance demands.

    For a few bodies under smooth forces, where many digits count or where quiet stretches take turns with collisions.
    Constraints hold exactly at the end of every step, but the steps are neither reversible nor symplectic: energy is
    kept to the tolerance, not better, and drifts. Not for long runs of many atoms, nor for forces that jump or
    are noisy (a cutoff, single precision), which make steps small.

    Parameters
    ----------
    tolerance : float
        Allowed error of a step, root mean square over the coordinates of all atoms that are not fixed: of positions
        relative to `length`, of velocities relative to `speed`. Rounding is allowed besides, so that below some 1e-13
        little is gained.
    length, speed : float, optional
        What is measured against; by default 1, and the larger of the root mean square of the velocities at the start
        and the speed that accelerations there give along `length`.
    base : Stepper, optional
        Reversible, of order 2; by default `Geodesic(4)`, whose first lines, of long steps, find a
        solution where `Rattle` has none. `Rattle` where projections cost more than forces.

    Raises
    ------
    InputError
        A number that is not positive, or a tolerance that rounding cannot reach (below 1e-14).
    UnsupportedError
        The base is not reversible, or not of order 2.

    References
    ----------
    Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, II.9 (control of order and step size);
    Hairer, Lubich and Wanner, Geometric Numerical Integration, IV.4 (projection) and VII.1.4 (RATTLE).
    """

    @checked
    def __init__(
        self,
        tolerance: Positive = 1e-8,
        *,
        length: Positive = 1.0,
        speed: Positive | None = None,
        base: Stepper | None = None,
    ) -> None:
        if tolerance < 1e-14:
            raise InputError(f"tolerance is {tolerance}; give a number of 1e-14 or more", item="tolerance")
        self.tolerance, self.length, self.speed = tolerance, length, speed
        self.base: Stepper = Geodesic(4) if base is None else base
        require_stepper(self.base, "base")
        if not (self.base.reversible and self.base.order == 2):
            raise UnsupportedError(
                f"{self.base!r} is no reversible stepper of order 2, whose errors are a series in dt^2; use Rattle or "
                "Geodesic"
            )

    def __repr__(self) -> str:
        return f"Extrapolation({self.tolerance:g}, base={self.base!r})"

    def check(self, system: System) -> None:
        """Raise `UnsupportedError` where the base may not be used."""
        self.base.check(system)

    def states(self, system: System, state: State, until: float, *, first_step: float | None = None) -> Iterator[State]:
        """The states at the ends of the steps, the last one at `until`; none if that is the time of the start.

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
        ConvergenceError, NonFiniteError, SingularGeometryError
            What a step raised, or an error above the tolerance, at steps too small to be made smaller. The last
            state that came is intact; the first two carry `step`.
        """
        until = finite_number(until, "until")
        first_step = None if first_step is None else positive(first_step, "first_step")
        if state.thermostat is not None:
            raise UnsupportedError("Extrapolation knows no thermostats; use a stepper with equal steps")
        self.check(system)
        return self._states(system, state, until, first_step)

    def _states(self, system: System, state: State, until: float, first_step: float | None) -> Iterator[State]:
        if state.time == until:
            return
        state = system.with_forces(state)
        speed, rate = self._speed_and_rate(system, state)
        left = abs(until - state.time)
        # Hairer, Norsett, Wanner II.9: a column for less than two digits.
        columns = int(np.clip(round(-0.6 * math.log10(self.tolerance) + 0.5), FEWEST, MOST - 1))
        plan = _Plan(first_step or (min(FIRST / rate, left) if rate > 0 else left), columns)
        while state.time != until:
            state, plan = self._advanced(system, state, until, plan, speed)
            yield state.read_only()

    @np.errstate(over="ignore", invalid="ignore")
    def _speed_and_rate(self, system: System, state: State) -> tuple[float, float]:
        """What velocities are measured against, and how fast the start changes, in units of its scales."""
        assert state.forces is not None
        v = state.velocities
        speed = _rms(v, system)
        forces = system.resisted(state.forces, v)
        a = _rms(system.motion.acceleration(state.positions, v, forces, state.time), system)
        scale = self.speed or max(speed, math.sqrt(a * self.length)) or 1.0
        return scale, speed / self.length + a / scale

    @np.errstate(over="ignore", invalid="ignore")
    def _advanced(self, system: System, start: State, until: float, plan: _Plan, speed: float) -> tuple[State, _Plan]:
        """The state after one step, and the plan for the next."""
        smallest = 16 * float(np.spacing(max(abs(start.time), abs(until))))
        left, grow = (until - start.time) - start.time_remainder, True
        while True:
            last = plan.size >= abs(left)
            size = left if last else math.copysign(plan.size, left)
            if not last and 2 * plan.size > abs(left):
                size = 0.5 * left  # two equal steps rather than a long and a tiny one
            try:
                table = _Table(self, system, start, size, speed)
                if table.fill(plan.columns):
                    return table.landed(until if last else None), table.following(grow=grow)
            except (ConvergenceError, NonFiniteError, SingularGeometryError) as error:  # which a shorter step mends
                if abs(size) <= smallest:
                    raise _given_up(error, start, size) from error
                plan = _Plan(FAILED * abs(size), max(FEWEST, plan.columns - 1))
            else:
                plan = table.following(grow=False)
                if abs(size) <= smallest:
                    raise ConvergenceError(
                        f"step {start.step + 1}, from time {start.time:g}: the error stays above the tolerance "
                        f"{self.tolerance:g} at steps of {abs(size):.3g}. Forces that jump or are noisy: make them "
                        "smooth, give a larger tolerance, or use Rattle with equal steps",
                        residual=table.error * self.tolerance,
                        tolerance=self.tolerance,
                        step=start.step + 1,
                    )
            grow = False


class _Table:
    """The table of one step: changes of positions and velocities, line by line.

    Attributes
    ----------
    line : list of ndarray, shape (2, n_atoms, 3)
        The last line; its last entry is the best.
    errors : list of float
        Estimates for each line, in units of the tolerance.
    """

    def __init__(self, scheme: Extrapolation, system: System, start: State, size: float, speed: float) -> None:
        self.base, self.system, self.start, self.size = scheme.base, system, start, size
        x, _ = system.near_origin(start)
        self._tolerated = scheme.tolerance * np.array([scheme.length, speed])
        self._rounding = _EPS * np.array([_rms(x, system), _rms(start.velocities, system)])
        self.line: list[FloatArray] = []
        self.errors: list[float] = []

    @property
    def error(self) -> float:
        """That of the last line."""
        return self.errors[-1]

    def fill(self, aim: int) -> bool:
        """Compute lines up to the one that is good enough, near `aim`; False if there is none to be expected.

        Hairer, Norsett and Wanner II.9: three chances, the first two of which look ahead.
        """
        for columns in range(1, min(aim + 1, MOST) + 1):
            self.add(columns)
            if columns < max(2, aim - 1):
                continue
            if self.error <= 1.0:
                return True
            # What the lines that are still to come can at most be expected to gain.
            ahead = range(columns + 1, min(aim + 1, MOST) + 1)
            if self.error > math.prod(n**2 for n in ahead):
                return False
        return False

    def add(self, n: int) -> None:
        """Line n: n steps of the base, extrapolated with the lines before (Aitken and Neville)."""
        entry = self._steps(n)
        line = [entry]
        for k, above in enumerate(self.line, 1):
            entry = entry + (entry - above) / ((n / (n - k)) ** 2 - 1.0)
            line.append(entry)
        self.line = line
        error = math.inf
        if n > 1:
            # No smaller step mends what rounding leaves.
            allowed = self._tolerated + 2.0 ** (n - 1) * self._rounding
            off = [_rms(d, self.system) for d in line[-1] - line[-2]]
            error = float(np.hypot(*(off / allowed))) / math.sqrt(2.0)
        self.errors.append(error)

    def _steps(self, n: int) -> FloatArray:
        """What n steps of the base change."""
        start, base, dt = self.start, self.base, self.size / n
        march = getattr(base, "march", None)
        state = start
        if march is not None:
            state = march(self.system, state, dt, n)
        else:
            for _ in range(n):
                state = base.step(self.system, state, dt)
        if state.thermostat is not None:
            raise UnsupportedError("Extrapolation knows no thermostats; use a stepper with equal steps")
        moved = state.positions - start.positions
        if state.remainder is not None:
            moved += state.remainder if start.remainder is None else state.remainder - start.remainder
        return np.stack([moved, state.velocities - start.velocities])

    def landed(self, until: float | None) -> State:
        """The extrapolated point, brought onto the constraints; at time `until` in place of that of rounding."""
        system, start, change = self.system, self.start, self.line[-1]
        (x, shift), number = system.near_origin(start), start.step + 1
        time, left_over = start.later(self.size) if until is None else (until, 0.0)
        x, v = x + change[0], system.kernel_arrays(start)[1] + change[1]
        check_finite(x, "position", number)
        check_finite(v, "velocity", number)
        x = system.motion.project_positions(x, x, time=time, reference_time=time)
        v = system.motion.project_velocities(x, v, time=time)
        f = system.forces(x if shift is None else x + shift, v, time, number)
        return system.ended(start, number, (time, left_over), (x, v, f), shift, far=shift is None and system.is_far(x))

    def following(self, *, grow: bool) -> _Plan:
        """Size and order of the next step, or of the next attempt: those with the least work for the time."""
        made = len(self.errors)
        sizes, works = {}, {}
        for k in range(2, made + 1):
            error = max(self.errors[k - 1], 1e-30)
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


def _rms(values: FloatArray, system: System) -> float:
    """Root mean square over the coordinates of atoms that are not fixed; 0 without any."""
    moving = values[system.inverse_masses[:, 0] > 0]
    return math.sqrt(float(np.mean(moving * moving))) if moving.size else 0.0


def _given_up(error: KconsError, start: State, size: float) -> KconsError:
    """What goes wrong however small the step, with the step's number: the base counts its own."""
    number = start.step + 1
    where = f"step {number}, from time {start.time:g}, at steps down to {abs(size):.3g}"
    if isinstance(error, NonFiniteError):
        message = (
            f"{where}: non-finite {error.item} on atom {error.atom}. The state before this step is intact; check the "
            "geometry and the force function there"
        )
    elif isinstance(error, ConvergenceError):
        message = (
            f"{where}: no solution. Targets that jump or cannot be met, or a start off the constraints (use "
            f"System.initial_state): {error.__cause__ or error}"
        )
    else:
        message = f"{where}: {error}"
    return retold(error, message, type(error), number)
