"""Statics: the minimum of a potential on the constraints."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.arguments import Positive, as_array, check_call, checked
from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, NonFiniteError
from kcons.motion.motion import Motion
from kcons.motion.restoring.nearest_point import Descent, largest


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
        return largest(self.forces)


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
    shape, evaluations = (motion.n_atoms, 3), 0
    finite = np.isfinite(motion.masses) & (motion.masses > 0)
    mass = np.where(finite, motion.masses, 1.0)[:, None]

    def acceleration(x: FloatArray) -> FloatArray:
        nonlocal evaluations
        evaluations += 1
        f = as_array(force(x.copy(), time), shape, "force")
        if not np.all(np.isfinite(f)):
            atom = int(np.argmin(np.isfinite(f).all(axis=1)))
            raise NonFiniteError(f"the force on atom {atom} is not finite: {f[atom]}", item="force", atom=atom)
        return f / mass

    descent = Descent(
        acceleration,
        lambda x, move: motion.project_forces(x, mass * move, time=time) / mass,
        lambda x, reference: motion.project_positions(x, reference, time=time),
        mass,
    )
    x = motion.restore_positions(positions, time=time)
    a = descent.downhill(x)
    for step in range(steps + 1):
        if largest(mass * a) <= tolerance:
            return Minimum(x, mass * a, step, evaluations)
        if step == steps:
            break
        x, a, gained = descent.advanced(x, a, longest)
        if not gained:
            break
    left = largest(mass * a)
    error = ConvergenceError(
        f"the largest force along the constraints is {left:.3g} after {step} steps, and not {tolerance:g}; "
        + (
            "give more steps"
            if step == steps
            else "no step along the forces lowers their potential any further: they are no gradient, or not so exact"
        ),
        residual=left,
        tolerance=tolerance,
        iterations=step,
    )
    error.positions = x
    raise error
