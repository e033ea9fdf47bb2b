"""Trajectories in the making, one kind for each MD engine: built from what the engine takes, advanced, observed.

`advance` is what a comparison times: nothing is added to a step of the engine.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from kcons import steppers
from kcons.constraints.target import FloatArray
from kcons.steppers import State, Stepper, System

if TYPE_CHECKING:
    import openmm
    from ase import Atoms


class Run(ABC):
    """A trajectory in the making.

    Parameters
    ----------
    dt : float
        Time step.

    Attributes
    ----------
    evaluations : int or None
        Force evaluations so far; None where the potential of the test system counts them.
    """

    evaluations: int | None = None

    def __init__(self, dt: float) -> None:
        self.dt, self.done = dt, 0

    @property
    def time(self) -> float:
        """How far it has come."""
        return self.done * self.dt

    @abstractmethod
    def advance(self, steps: int = 1) -> None:
        """Make steps; nobody looks in between."""

    @abstractmethod
    def observe(self) -> tuple[FloatArray, FloatArray]:
        """Positions and velocities."""

    def energy(self) -> float | None:
        """Total energy where the MD engine states it; None where it follows from positions and velocities."""
        return None

    def rewind(self) -> None:
        """Go back to the start; the steps go on counting."""
        raise NotImplementedError


class OnArrays(Run):
    """A stepper of kcons, arrays in and arrays out."""

    def __init__(self, system: System, start: State, stepper: Stepper, dt: float) -> None:
        super().__init__(dt)
        stepper.check(system)
        self.system, self.stepper = system, stepper
        self.start = self.state = start

    def advance(self, steps: int = 1) -> None:
        if steps == 1:
            self.state = self.stepper.step(self.system, self.state, self.dt)
        else:
            self.state = steppers.run(self.system, self.state, self.dt, steps, stepper=self.stepper)
        self.done += steps

    def observe(self) -> tuple[FloatArray, FloatArray]:
        return self.state.positions, self.state.velocities

    def rewind(self) -> None:
        self.state = self.start


class OfStates(Run):
    """States, with their times, that `states` gives one after another; it is called again to begin anew."""

    def __init__(self, states: Callable[[], Iterator[State]], start: State) -> None:
        super().__init__(0.0)
        self._begin, self._start = states, start
        self.rewind()

    @property
    def time(self) -> float:
        return self.state.time

    def advance(self, steps: int = 1) -> None:
        for _ in range(steps):
            self.state = next(self._states)
        self.done += steps

    def observe(self) -> tuple[FloatArray, FloatArray]:
        return self.state.positions, self.state.velocities

    def rewind(self) -> None:
        self._states, self.state = self._begin(), self._start


class InAse(Run):
    """Dynamics of ASE on atoms that hold their constraints."""

    def __init__(self, atoms: Atoms, dynamics: Any, dt: float) -> None:
        super().__init__(dt)
        self.atoms, self.dynamics = atoms, dynamics
        self._start = atoms.get_positions(), atoms.get_momenta()

    def advance(self, steps: int = 1) -> None:
        step = self.dynamics.step  # as ASE's own loop calls it
        for _ in range(steps):
            step()
        self.done += steps

    def observe(self) -> tuple[FloatArray, FloatArray]:
        return np.asarray(self.atoms.get_positions()), np.asarray(self.atoms.get_velocities())

    def rewind(self) -> None:
        x, p = self._start
        self.atoms.positions[:] = x
        # Constraints would change them by what rounding leaves.
        self.atoms.set_momenta(p, apply_constraint=False)


class InOpenMM(Run):
    """A Context of OpenMM at its start; `length` and `speed` are OpenMM's units over those of the test system.

    `half_step` says that the integrator keeps velocities half a step behind.
    """

    def __init__(
        self,
        context: openmm.Context,
        integrator: Any,
        dt: float,
        *,
        length: float = 1.0,
        speed: float = 1.0,
        force_evaluations: int = 1,
        half_step: bool = False,
    ) -> None:
        super().__init__(dt)
        self.context, self.integrator = context, integrator
        self.length, self.speed, self.half_step = length, speed, half_step
        self._each, self.evaluations = force_evaluations, 0
        self._start = seen(context)

    def advance(self, steps: int = 1) -> None:
        self.integrator.step(steps)
        self.done += steps
        self.evaluations = self.done * self._each

    def observe(self) -> tuple[FloatArray, FloatArray]:
        x, v = seen(self.context)
        return x / self.length, v / self.speed

    def energy(self) -> float | None:
        if not self.half_step:
            return None
        if hasattr(self.integrator, "scheme"):
            return float("nan")  # to ask would compute the forces that the next step is to pay for
        # OpenMM's own integrators know how to move velocities by half a step.
        state = self.context.getState(energy=True, groups=self.integrator.getIntegrationForceGroups())
        return float((state.getKineticEnergy() + state.getPotentialEnergy())._value) / self.speed**2

    def rewind(self) -> None:
        x, v = self._start
        self.context.setPositions(x)
        self.context.setVelocities(v)


def seen(context: openmm.Context) -> tuple[FloatArray, FloatArray]:
    """Positions and velocities of a Context, nm and nm/ps."""
    state = context.getState(positions=True, velocities=True)
    return np.array(state.getPositions(asNumpy=True)._value), np.array(state.getVelocities(asNumpy=True)._value)
