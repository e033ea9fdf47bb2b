"""Steps that can be taken back, each of which is seen to be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.target import FloatArray
from kcons.constraints.vectors import extent
from kcons.errors import ConvergenceError, ReversibilityError
from kcons.steppers import State, Stepper, System
from kcons.steppers.reversibility_check import missed
from kcons.steppers.stepper import retold


class ReversedSteps:
    """Steps of a system, each taken back at once, which costs projections and no force.

    A step and the step back ask for forces at the same places. Those of the step are remembered for the way back; only
    where the way back leads elsewhere are forces asked for again. So the whole map is checked, whatever it consists of,
    and one step at a time, so that chaos does not hide what is wrong and a bad proposal ends early.

    Parameters
    ----------
    system : System
    tolerance : float
        As for `kcons.steppers.ReversibilityCheck`.
    """

    def __init__(self, system: System, tolerance: float) -> None:
        self.system = system
        self.tolerance = tolerance
        force = None if system.force is None else self._force
        #: The same system, which remembers.
        self.watched = System(system.motion, force, potential=system.potential, far=system.far)
        self._known: list[tuple[FloatArray, FloatArray]] = []
        self._near = 0.0
        self._back = False

    def step(self, stepper: Stepper, state: State, dt: float) -> State:
        """Advance by `dt`, and see that the step back ends at `state`.

        Raises
        ------
        ReversibilityError
            It does not.
        ConvergenceError
            The step itself has no solution.
        KconsError
            As the stepper.
        """
        watched, state = self.watched, replace(state, origin=None)  # forces of the system are those of the watched one
        self._known = [] if state.forces is None else [(state.positions, state.forces)]
        self._back = False
        after = stepper.step(watched, state, dt)
        size = extent(state.positions)
        self._near = self.tolerance * size + 8 * float(np.spacing(np.abs(state.positions).max(initial=0.0)))
        self._back = True
        try:
            back = stepper.step(watched, after, -dt)
        except ConvergenceError as error:
            raise retold(
                error, f"step {after.step} cannot be taken back: {error}", ReversibilityError, after.step
            ) from error
        finally:
            self._back = False
        pushes = [np.abs(forces * watched.inverse_masses).max(initial=0.0) for _, forces in self._known]
        residual = float(missed(state, after, back, dt, float(max(pushes, default=0.0))).max(initial=0.0))
        if not residual <= self.tolerance:
            raise ReversibilityError(
                f"step {after.step}, taken back, misses its start by {residual:.3g}",
                residual=residual,
                tolerance=self.tolerance,
                step=after.step,
            )
        return after

    def _force(self, x: FloatArray, time: float) -> ArrayLike:
        if self._back:
            for place, forces in reversed(self._known):
                if float(np.abs(x - place).max(initial=0.0)) <= self._near:
                    return forces
        force = self.system.force
        assert force is not None
        forces = self.system.accepted(force(x, time), 0, True)
        if not self._back:
            self._known.append((x.copy(), forces))
        return forces
