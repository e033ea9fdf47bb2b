"""An independent check of results: sigma and A v as the constraint set defines them, without the solvers.

The solvers check their own residuals; where a solver and the set do not mean the same, these say nothing. So a run
has its states certified from time to time, by NumPy, row by row, with the measures and gradients of the constraint
objects, as reports have them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from time import perf_counter
from typing import Any

import numpy as np

from kcons.constraints.arguments import whole_number
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import CertificateError

#: Steps from one certificate to the next, if nothing else is asked for ...
CHECK_EVERY = 1000
#: ... and the part of a run's time that certificates may then take: less than the one per cent that is promised, since
#: what the next one takes is not known. Where steps take microseconds, they come later.
SHARE = 0.009
#: A certificate that is due is put off by this many intervals at most, and then looked at again.
MOST = 100
#: |A v - c| that counts as held, in parts of what the atoms of the row, or of the fastest row, move with: so many times
#: the part of its scale that |sigma| may be, since gradients at rounded positions are no better known.
SPEED = 10.0


def certify(
    held: ConstraintSet,
    x: FloatArray,
    v: FloatArray | None = None,
    time: float = 0.0,
    *,
    slack: float = 0.0,
    still: float = 0.0,
    moved: bool = True,
) -> None:
    """Raise unless `x` (and `v`) fulfil every row of `held`.

    Parameters
    ----------
    held : ConstraintSet
    x, v : ndarray, shape (n_atoms, 3)
    time : float
    slack : float
        Added to what |sigma| may be, in parts of the rows' scale, and to what |A v - c| may be.
    still : float
        Speed that is no more than rounding: of a kick much larger than what the constraints leave of it.
    moved : bool
        Whether a solver put the positions where they are; otherwise only `v` is looked at.

    Raises
    ------
    CertificateError
        Names the worst row. NaN counts as worst.
    """
    found = held.residuals(x, v, time)
    if moved:
        _refuse(held, np.abs(found.sigma), found.allowed + slack * held.scale, "positions", "sigma")
    if found.rates is not None and found.speeds is not None:
        size = found.speeds + 0.1 * np.max(found.speeds, initial=0.0)
        part = SPEED * found.allowed / held.scale + slack
        _refuse(held, np.abs(found.rates), part * size + still * found.sizes, "velocities", "A v - c")


def _refuse(held: ConstraintSet, miss: FloatArray, allowed: FloatArray, what: str, residual: str) -> None:
    row = off_row(miss, allowed)
    if row < 0:
        return
    raise CertificateError(
        f"the {what} are off row {held.row_name(row)}: {residual} is {miss[row]:.3g}, allowed {allowed[row]:.3g}. "
        "The solver reported success; this is an error of kcons, or something changed the arrays, the cell or the "
        "targets behind its back",
        row=row,
        residual=float(miss[row]),
        atoms=held.row_atoms(row),
    )


def off_row(miss: FloatArray, allowed: FloatArray) -> int:
    """The row that is off by most, in parts of what is allowed; -1 if none is. NaN counts as most."""
    bad = ~(miss <= allowed)
    if not bad.any():
        return -1
    with np.errstate(divide="ignore", invalid="ignore"):
        return int(np.argmax(np.where(bad, np.nan_to_num(miss / allowed, nan=np.inf), -1.0)))


def checked_every(check_every: int | None) -> tuple[int, bool]:
    """The number of steps that `check_every` asks for, and whether it was left open.

    Raises
    ------
    InputError
        Less than 0.
    """
    return (CHECK_EVERY, True) if check_every is None else (whole_number(check_every, "check_every", 0), False)


class Schedule:
    """When the states of a run are certified: the first, then every so many, over one run or several.

    Parameters
    ----------
    certify : callable
        Takes positions, velocities, time and the time step; raises `CertificateError`.

    Attributes
    ----------
    last : Any
        The last state that was certified, or None.
    """

    def __init__(self, certify: Callable[[FloatArray, FloatArray, float, float], None]) -> None:
        self._certify = certify
        self._left = 1
        self._ended, self._cost = -math.inf, 0.0
        self.last: Any = None

    def within(self, steps: int, every: int) -> int:
        """How many of `steps` may be made before the next certificate; `every` 0 stands for never."""
        if not every:
            return steps
        self._left = min(self._left, every)
        return min(steps, self._left)

    def made(self, steps: int, every: int, state: Any, dt: float, *, spare: bool = False) -> None:
        """`state` is what so many steps led to: certify it if that is due.

        With `spare` it waits while it would take more than `SHARE` of the time.

        Raises
        ------
        CertificateError
            With the last certified state, and the number of the step.
        """
        if not every:
            return
        self._left -= steps
        if self._left > 0:
            return
        self._left = every
        begun = perf_counter()
        passed = SHARE * (begun - self._ended)
        if spare and self._cost > passed:
            self._left = math.ceil(every * min(self._cost / passed - 1, MOST))
            return
        try:
            self._certify(state.positions, state.velocities, state.time, dt)
        except CertificateError as error:
            error.step, error.state = state.step, self.last
            where = (
                "none was certified before" if self.last is None else f"the last certified is of step {self.last.step}"
            )
            error.add_note(f"at step {state.step}; error.state is the last certified state: {where}")
            raise
        self.last = state
        self._ended = perf_counter()
        self._cost = self._ended - begun
