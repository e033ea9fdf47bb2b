"""Steps that choose their own size and order: RATTLE, or a geodesic splitting, extrapolated to many digits.

A symmetric scheme of order 2 that makes n steps in place of one misses by a series in (H/n)^2. Results for n = 1, 2, 3,
... are therefore extrapolated to infinitely many steps (Gragg, Bulirsch and Stoer), each column of the table two orders
higher than the one before; the difference of the last two is the estimate of the error.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kcons.constraints.target import FloatArray
from kcons.errors import UnsupportedError
from kcons.steppers.adaptive.tolerated import EPS, FAILED, ToTolerance, landed, rms
from kcons.steppers.splitting import Geodesic
from kcons.steppers.state import State, System
from kcons.steppers.stepper import Stepper, require_stepper

#: Columns of the table: order 2 k - 1 of the estimate. Each one nearly doubles what rounding adds.
FEWEST, MOST = 3, 9
#: A step is aimed at this share of the tolerance, and made somewhat shorter than that.
AIM, SAFETY = 0.65, 0.85
#: Bounds for the change of the size from one step to the next.
SHRINK, GROW = 0.1, 8.0
#: An order is raised or lowered where it takes less than this share of the work for the same time.
LOWER, RAISE = 0.8, 0.9


@dataclass(frozen=True)
class _Plan:
    """How the next step is to be made."""

    size: float
    columns: int


class Extrapolation(ToTolerance):
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

    def __init__(
        self,
        tolerance: float = 1e-8,
        *,
        length: float = 1.0,
        speed: float | None = None,
        base: Stepper | None = None,
    ) -> None:
        super().__init__(tolerance, length, speed)
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

    def attempts(self, system: System, start: State, size: float, speed: float) -> _Tables:
        return _Tables(self, system, size, speed)

    def _first_columns(self) -> int:
        # Hairer, Norsett, Wanner II.9: a column for less than two digits.
        return int(np.clip(round(-0.6 * math.log10(self.tolerance) + 0.5), FEWEST, MOST - 1))

    def _landed(self, system: System, start: State, table: _Table, until: float | None) -> State:
        """The extrapolated point, brought onto the constraints."""
        return landed(system, start, table.size, until, table.best, forces=True)


class _Tables:
    """A step after another, each by a table."""

    def __init__(self, scheme: Extrapolation, system: System, size: float, speed: float) -> None:
        self._scheme, self._system, self._speed = scheme, system, speed
        self._plan = _Plan(size, scheme._first_columns())
        self._failed = False
        self.error = math.inf

    @property
    def size(self) -> float:
        return self._plan.size

    def made(self, start: State, size: float, until: float | None) -> State | None:
        table = _Table(self._scheme, self._system, start, size, self._speed)
        if not table.fill(self._plan.columns):
            self._plan, self._failed, self.error = table.following(grow=False), True, table.error
            return None
        state = self._scheme._landed(self._system, start, table, until)
        self._plan, self._failed = table.following(grow=not self._failed), False
        return state

    def failed(self, size: float) -> None:
        self._plan, self._failed = _Plan(FAILED * abs(size), max(FEWEST, self._plan.columns - 1)), True


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
        x, _ = system.near_origin(start)
        self._tolerated = scheme.tolerance * np.array([scheme.length, speed])
        self._rounding = EPS * np.array([rms(x, system), rms(start.velocities, system)])
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
        error = math.inf
        if n > 1:
            # No smaller step mends what rounding leaves.
            allowed = self._tolerated + 2.0 ** (n - 1) * self._rounding
            off = [rms(d, self.system) for d in line[-1] - line[-2]]
            error = float(np.hypot(*(off / allowed))) / math.sqrt(2.0)
        self._errors.append(error)

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
        if state.thermostat is not None:
            raise UnsupportedError("Extrapolation knows no thermostats; use a stepper with equal steps")
        moved = state.positions - start.positions
        if state.remainder is not None:
            moved += state.remainder if start.remainder is None else state.remainder - start.remainder
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
