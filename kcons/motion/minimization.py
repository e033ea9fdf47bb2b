"""Statics: the minimum of a potential on the constraints."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import Positive, as_array, check_call, checked
from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, KconsError, NonFiniteError
from kcons.motion.motion import Motion

#: Steps that are remembered for the curvature.
MEMORY = 20
#: Of the slope at the start, what a step must gain at least.
GAIN = 1e-4
#: Shortenings of one step.
SHORTENINGS = 20


@dataclass(frozen=True, eq=False)
class Minimum:
    """Where the forces along the constraints vanish.

    Attributes
    ----------
    positions : ndarray, shape (n_atoms, 3)
        On the constraints.
    forces : ndarray, shape (n_atoms, 3)
        What is left of the forces there, f + z with z of the constraints.
    steps, evaluations : int
        Steps made, and how often forces were evaluated.
    """

    positions: FloatArray
    forces: FloatArray
    steps: int
    evaluations: int

    @property
    def largest(self) -> float:
        """The largest force left on an atom."""
        return _largest(self.forces)


@checked
def minimize(
    motion: Motion,
    force: Callable[[FloatArray, float], ArrayLike],
    positions: ArrayLike,
    *,
    tolerance: Positive,
    longest: Positive,
    steps: int = 1000,
    time: float = 0.0,
) -> Minimum:
    """Follow the forces on the constraints to a minimum of their potential (L-BFGS in the tangent space).

    Every iterate is on the constraints: steps along them are brought back as those of dynamics are, and what is known
    of the curvature is projected to where it is used. Forces alone are needed, no energies.

    Parameters
    ----------
    motion : Motion
        Constraints and masses. Masses weigh the coordinates, and do not change where minima are.
    force : callable
        ``force(x, t)``, shape (n_atoms, 3).
    positions : array_like, shape (n_atoms, 3)
        Where to start; brought onto the constraints if they are off.
    tolerance : float
        The largest force that may be left on an atom.
    longest : float
        No atom moves farther in a step: for molecules, a tenth of a bond length or so.
    steps : int
        Give up after so many.
    time : float
        For targets and forces that change in time: when.

    Raises
    ------
    InputError
        A tolerance or length that is not positive; a force that takes other arguments, or has a wrong shape.
    NonFiniteError
        A force is not finite.
    ConvergenceError
        Too many steps, or forces that no potential has; `error.positions` is the best place found.

    References
    ----------
    Nocedal and Wright, Numerical Optimization, ch. 7.2; Absil, Mahony and Sepulchre, Optimization Algorithms on Matrix
    Manifolds, ch. 4 and 8 (retraction and transport by projection).
    """
    check_call("force", force, ("x", "t"))
    descent = _Descent(motion, force, time)
    x = motion.restore_positions(positions, time=time)
    f = descent.forces(x)
    for step in range(steps + 1):
        if _largest(f) <= tolerance:
            return Minimum(x, f, step, descent.evaluations)
        if step == steps:
            break
        x, f, gained = descent.advanced(x, f, longest)
        if not gained:
            break
    error = ConvergenceError(
        f"the largest force along the constraints is {_largest(f):.3g} after {step} steps, and not {tolerance:g}; "
        + (
            "give more steps"
            if step == steps
            else "no step along the forces lowers their potential any further: they are no gradient, or not so exact"
        ),
        residual=_largest(f),
        tolerance=tolerance,
        iterations=step,
    )
    error.positions = x
    raise error


class _Descent:
    """Steps with a memory, in coordinates weighted by the square roots of the masses."""

    def __init__(self, motion: Motion, force: Callable[[FloatArray, float], ArrayLike], time: float) -> None:
        self.motion, self.force, self.time = motion, force, time
        self.evaluations = 0
        self._shape = (motion.n_atoms, 3)
        finite = np.isfinite(motion.masses) & (motion.masses > 0)
        self._mass = np.where(finite, motion.masses, 1.0)[:, None]
        #: Moves and changes of the force along them, both along the constraints.
        self._memory: deque[tuple[FloatArray, FloatArray]] = deque(maxlen=MEMORY)

    def forces(self, x: FloatArray) -> FloatArray:
        """Along the constraints."""
        self.evaluations += 1
        f = as_array(self.force(x.copy(), self.time), self._shape, "force")
        if not np.all(np.isfinite(f)):
            atom = int(np.argmin(np.isfinite(f).all(axis=1)))
            raise NonFiniteError(f"the force on atom {atom} is not finite: {f[atom]}", item="force", atom=atom)
        return self.motion.project_forces(x, f, time=self.time)

    def advanced(self, x: FloatArray, f: FloatArray, longest: float) -> tuple[FloatArray, FloatArray, bool]:
        """Positions and forces after a step that gains; those given, and False, if there is none."""
        while True:
            move = self._along(x, self._newton(f))
            slope = float(np.vdot(f, move))
            if not slope > 0 or not self._memory:
                self._memory.clear()
                move = self._along(x, f / self._mass)
                move *= longest / _largest(move)
                slope = float(np.vdot(f, move))
            move *= min(1.0, longest / _largest(move))
            slope = float(np.vdot(f, move))
            size = 1.0
            for _ in range(SHORTENINGS):
                try:
                    there = self.motion.project_positions(x + size * move, x, time=self.time)
                except KconsError:  # too far for this place
                    size *= 0.25
                    continue
                if np.array_equal(there, x):  # all that is left is rounding
                    break
                after = self.forces(there)
                left = float(np.vdot(after, move))
                # The potential falls by the mean of the slopes, to third order.
                if slope + left > GAIN * slope:
                    self._remember(there, size * move, f - after)
                    return there, after, True
                size *= max(0.1, min(0.7, slope / (slope - left)))
            if not self._memory:
                return x, f, False
            self._memory.clear()  # it led nowhere: once more along the forces

    def _along(self, x: FloatArray, move: FloatArray) -> FloatArray:
        """What of a move is along the constraints."""
        return self.motion.project_forces(x, self._mass * move, time=self.time) / self._mass

    def _remember(self, x: FloatArray, move: FloatArray, change: FloatArray) -> None:
        move = self._along(x, move)
        change = self.motion.project_forces(x, change, time=self.time)
        weight = np.sqrt(self._mass)
        curvature = float(np.vdot(move, change))
        if curvature > 1e-10 * float(np.linalg.norm(weight * move) * np.linalg.norm(change / weight)):
            self._memory.append((move, change))

    def _newton(self, f: FloatArray) -> FloatArray:
        """The move that the memory suggests (two-loop recursion)."""
        if not self._memory:
            return f / self._mass
        q, parts = f.copy(), []
        for move, change in reversed(self._memory):
            parts.append(float(np.vdot(move, q) / np.vdot(move, change)))
            q -= parts[-1] * change
        move, change = self._memory[-1]
        found = q / self._mass * float(np.vdot(move, change) / np.vdot(change, change / self._mass))
        for (move, change), part in zip(self._memory, reversed(parts), strict=True):
            found += (part - float(np.vdot(change, found) / np.vdot(move, change))) * move
        return found


def _largest(f: FloatArray) -> float:
    return float(np.sqrt(np.max(np.einsum("ij,ij->i", f, f), initial=0.0)))
