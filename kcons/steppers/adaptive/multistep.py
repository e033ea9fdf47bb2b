"""Steps from the accelerations of earlier ones: one force evaluation a step, order and size as the tolerance asks.

The accelerations at the last k times, those that constraints cause among them, are those of a polynomial in time; its
integrals predict positions and velocities (Adams, and Stoermer for positions). There forces are evaluated, once; the
polynomial through this acceleration too corrects the prediction, which is then brought onto the constraints.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from kcons.constraints.target import FloatArray
from kcons.steppers.adaptive.tolerated import EPS, FAILED, ToTolerance, landed
from kcons.steppers.executors.frame import Frame
from kcons.steppers.state import State, System

#: The most accelerations that predict. More of them forbid the steps that they would otherwise allow.
MOST = 10
#: A step is aimed at this share of the tolerance.
AIM = 0.5
#: Steps stay equal until they may grow by this; bounds for those that shrink.
GROW, LEAST, FIRST_CUT = 1.5, 0.5, 0.9
#: Attempts that fail one after another until the past counts no more: something has jumped.
TRIES = 3


class Multistep(ToTolerance):
    """One force evaluation a step, from the accelerations of earlier ones: size and order as the tolerance demands.

    For smooth forces that are dear, at errors of some 1e-6 and less: a third of the evaluations of one-step schemes.
    Constraints hold exactly at the end of every step, but the steps are neither reversible nor symplectic: energy is
    kept to the tolerance, not better, and drifts. Not for long runs, nor for forces that jump or are noisy (a cutoff,
    single precision), after which the past has to be collected again. Forces are evaluated at predicted positions,
    which are off the constraints by about the tolerance; states carry none.

    Parameters
    ----------
    tolerance : float
        Allowed error of a step, root mean square over the coordinates of all atoms that are not fixed: of positions
        relative to `length`, of velocities relative to `speed`. Rounding is allowed besides.
    length, speed : float, optional
        What is measured against; by default 1, and the larger of the root mean square of the velocities at the start
        and the speed that accelerations there give along `length`.

    Raises
    ------
    InputError
        A number that is not positive, or a tolerance that rounding cannot reach (below 1e-14).

    References
    ----------
    Shampine and Gordon, Computer Solution of Ordinary Differential Equations (1975), on the choice of order and size;
    Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, III.1 and III.10 (Adams, Stoermer).
    """

    def __init__(self, tolerance: float = 1e-8, *, length: float = 1.0, speed: float | None = None) -> None:
        super().__init__(tolerance, length, speed)

    def __repr__(self) -> str:
        return f"Multistep({self.tolerance:g})"

    @property
    def first(self) -> float:
        # The first step knows one acceleration.
        return 0.5 * math.sqrt(self.tolerance)

    def attempts(self, system: System, start: State, size: float, speed: float) -> _Steps:
        return _Steps(self, system, start, size, speed)


class _Rule(NamedTuple):
    """Numbers for times of the past and a number k of accelerations, in units of the step.

    Attributes
    ----------
    sums : ndarray, shape (6, m)
        Of the last m accelerations: velocities and positions that k of them predict, and the acceleration that k,
        k - 1, k - 2, k + 1 predict.
    correction : ndarray, shape (2,)
        What the acceleration that is found changes of velocities and positions, times what it is off the k predicted.
    estimates : ndarray, shape (4, 2)
        Errors of what is corrected, of velocities and positions, for k, k - 1, k - 2, k + 1 accelerations, times what
        these are off; NaN where there is no such number.
    """

    sums: FloatArray
    correction: FloatArray
    estimates: FloatArray


_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(MOST // 2 + 2)
#: Times and weights for integrals over a step, at whose end polynomials are looked at too.
_TIMES = np.append(0.5 + 0.5 * _POINTS, 1.0)
_ONCE = 0.5 * _WEIGHTS
_INTEGRALS = np.stack([_ONCE, _ONCE * (1.0 - _TIMES[:-1])])


@lru_cache(maxsize=512)
def _rule(nodes: tuple[float, ...], k: int) -> _Rule:
    """For accelerations at these times: 0 and before, the step ending at 1."""
    m, at = len(nodes), np.array(nodes)
    sums, estimates, correction = np.zeros((6, m)), np.full((4, 2), np.nan), np.zeros(2)
    for row, j in enumerate((k, k - 1, k - 2, k + 1)):
        if not 1 <= j <= m:
            continue
        past = at[:j]
        own = np.eye(j, dtype=bool)
        lagrange = np.prod(np.where(own, 1.0, _TIMES[:, None, None] - past), axis=2)
        lagrange /= np.prod(np.where(own, 1.0, past[:, None] - past), axis=1)
        sums[2 + row, :j] = lagrange[-1]
        zero_there = np.prod(_TIMES[:, None] - past, axis=1)
        shorter = (_TIMES - 1.0) * np.prod(_TIMES[:, None] - past[:-1], axis=1)
        estimates[row] = _INTEGRALS @ shorter[:-1] / zero_there[-1]
        if j == k:
            sums[:2, :j] = _INTEGRALS @ lagrange[:-1]
            correction = _INTEGRALS @ zero_there[:-1] / zero_there[-1]
    return _Rule(sums, correction, np.abs(estimates))


class _Steps:
    """One step after another, and what they remember."""

    def __init__(self, scheme: Multistep, system: System, start: State, size: float, speed: float) -> None:
        self._system, self.size, self.error = system, size, math.inf
        self._tolerated = scheme.tolerance * np.array([speed, scheme.length])
        #: Accelerations, the last one first, and the lengths of the steps between them.
        self._past = np.zeros((MOST + 1, 3 * system.n_atoms))
        self._sizes: list[float] = []
        self._k, self._known, self._starting, self._tries = 1, 1, True, 0
        moving = system.inverse_masses[:, 0] > 0
        self._moving = None if moving.all() else np.repeat(moving, 3)
        assert start.forces is not None
        x, v, forces = start.positions, start.velocities, start.forces
        self._past[0] = system.motion.acceleration(x, v, system.resisted(forces, v), start.time).ravel()

    def made(self, start: State, size: float, until: float | None) -> State | None:
        system, known = self._system, min(self._known, self._k + 1)
        frame = Frame(system, start, size)
        time = frame.time if until is None else until
        nodes, back = [0.0], 0.0
        for before in self._sizes[: known - 1]:
            back -= before / size
            nodes.append(back)
        rule = _rule(tuple(nodes), self._k)
        sums = rule.sums @ self._past[:known]
        shape = frame.x.shape
        x = frame.x + (size * frame.v + size**2 * sums[1].reshape(shape))
        v = frame.v + size * sums[0].reshape(shape)
        forces = system.forces(frame.whole(x), v, time, frame.number)
        found = system.motion.acceleration(x, v, system.resisted(forces, v), time).ravel()
        errors = self._errors(found - sums[2:], rule.estimates, size, start)
        self.error = float(errors[0])
        if not self.error <= 1.0:
            self._shorter(size, errors)
            return None
        off = found - sums[2]
        change = np.empty((2, *shape))
        np.add(size * frame.v, (size**2 * (sums[1] + rule.correction[1] * off)).reshape(shape), out=change[0])
        np.multiply(size, (sums[0] + rule.correction[0] * off).reshape(shape), out=change[1])
        state = landed(system, start, size, until, change, forces=False)
        self._past[1:] = self._past[:-1].copy()
        self._past[0] = found
        self._sizes = [size, *self._sizes[: MOST - 1]]
        self._known = min(self._known + 1, MOST + 1)
        self._tries = 0
        self._longer(errors)
        return state

    def _errors(self, off: FloatArray, estimates: FloatArray, size: float, start: State) -> FloatArray:
        """In units of the tolerance, shape (4,): for as many accelerations as in `_Rule`."""
        if self._moving is not None:
            off = off[:, self._moving]
        rms = np.sqrt(np.einsum("ij,ij->i", off, off) / max(off.shape[1], 1))
        size = abs(size)
        # No smaller step mends what rounding leaves.
        allowed = self._tolerated + 4 * EPS * np.array([np.abs(start.velocities).max(), np.abs(start.positions).max()])
        parts = rms[:, None] * estimates * [size, size**2] / allowed
        return np.asarray(np.sqrt(0.5 * np.einsum("ij,ij->i", parts, parts)))

    def _shorter(self, size: float, errors: FloatArray) -> None:
        if np.nanmax(errors[1:3], initial=-math.inf) <= errors[0] and self._k > 1 and not np.isnan(errors[1]):
            self._k -= 1
        self.failed(size)

    def failed(self, size: float) -> None:
        self.size, self._starting = FAILED * abs(size), False
        self._tries += 1
        if self._tries >= TRIES:
            self._k, self._known, self._starting = 1, 1, True

    def _longer(self, errors: FloatArray) -> None:
        """Order and size of the next step."""
        error, fewer, still_fewer, more = (float(each) for each in errors)
        known = [each for each in (fewer, still_fewer) if not math.isnan(each)]
        if self._starting:
            if len(known) == 2 and still_fewer <= fewer:
                self._starting = False
            else:
                if error < AIM / 2 ** (self._k + 1):
                    self.size *= 2.0
                else:
                    self._starting = False
                self._k = min(self._k + 1, MOST)
                return
        if known and max(known) <= error:
            self._k, error = self._k - 1, fewer
        elif more < error and self._k < MOST and not (known and min(known) <= error):
            self._k, error = self._k + 1, more
        factor = (AIM / max(error, 1e-30)) ** (1.0 / (self._k + 1))
        if factor >= GROW:
            self.size *= GROW
        elif factor < 1.0:
            self.size *= max(LEAST, min(FIRST_CUT, factor))
