"""One adapter for each MD engine: built from what the engine takes, advanced, and observed.

Test systems of the comparison and problems of the hard cases are run by the same ones. `advance` and `march` are what
the comparison times: nothing is added to a step of the engine.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from ase.constraints import FixAtoms, FixBondLengths, FixInternals

from kcons import steppers
from kcons.comparison.methods.method import Run, Steps
from kcons.constraints.target import FloatArray
from kcons.steppers import State, Stepper, System

if TYPE_CHECKING:
    import openmm
    from ase import Atoms


class OfStates(Run):
    """A run whose last `State` is known."""

    _state: State

    @property
    def positions(self) -> FloatArray:
        return self._state.positions

    @property
    def velocities(self) -> FloatArray:
        return self._state.velocities


class OnArrays(OfStates, Steps):
    """A stepper of kcons, arrays in and arrays out."""

    def __init__(self, system: System, start: State, stepper: Stepper, dt: float, steps: int) -> None:
        Steps.__init__(self, dt, steps)
        self._system, self._stepper = system, stepper
        self._start = self._state = start

    def advance(self) -> None:
        self._state = self._stepper.step(self._system, self._state, self._dt)
        self._done += 1
        # Rigid water and few distances take a step in kernels that do not call the engine.
        self.divided = self.constraints.seconds > 0.0

    def march(self, steps: int) -> None:
        self._state = steppers.run(self._system, self._state, self._dt, steps, stepper=self._stepper)
        self._done += steps

    def rewind(self) -> None:
        self._state = self._start

    def put(self, x: FloatArray) -> None:
        self._state = replace(self._state, positions=x)


class InAse(Steps):
    """Dynamics of ASE on atoms that hold their constraints."""

    def __init__(self, atoms: Atoms, dynamics: Any, dt: float, steps: int) -> None:
        super().__init__(dt, steps)
        self._atoms, self._dynamics = atoms, dynamics

    def advance(self) -> None:
        self._dynamics.step()
        self._done += 1

    def march(self, steps: int) -> None:
        step = self._dynamics.step  # as ASE's own loop calls it
        for _ in range(steps):
            step()
        self._done += steps

    def put(self, x: FloatArray) -> None:
        # As atoms.wrap() does it: not through the constraints.
        self._atoms.arrays["positions"][:] = x

    @property
    def positions(self) -> FloatArray:
        return np.asarray(self._atoms.get_positions())

    @property
    def velocities(self) -> FloatArray:
        return np.asarray(self._atoms.get_velocities())


def ase_constraints(
    fixed: Any,
    pairs: Any,
    lengths: Any,
    triples: Any = (),
    degrees: Any = (),
    *,
    internals: bool,
    **options: Any,
) -> list[Any]:
    """ASE's constraint objects: FixAtoms, and FixInternals or FixBondLengths.

    Parameters
    ----------
    fixed : sequence of int
    pairs, lengths, triples, degrees
        Distances in Å and angles in degrees.
    internals : bool
        Whether by FixInternals, which holds angles, too.
    **options
        For FixInternals.
    """
    held: list[Any] = [FixAtoms(list(fixed))] if len(fixed) else []
    if internals:
        bonds = [[float(d), [int(i) for i in pair]] for d, pair in zip(lengths, pairs, strict=True)]
        angles = [[float(a), [int(i) for i in triple]] for a, triple in zip(degrees, triples, strict=True)]
        held.append(FixInternals(bonds=bonds or None, angles_deg=angles or None, **options))
    elif len(pairs):
        held.append(FixBondLengths(pairs, bondlengths=lengths))
    return held


class InOpenMM(Steps):
    """A Context of OpenMM.

    Parameters
    ----------
    length, speed : float
        OpenMM's units over those of the test system.
    """

    def __init__(
        self, context: openmm.Context, integrator: Any, dt: float, steps: int, length: float = 1.0, speed: float = 1.0
    ) -> None:
        super().__init__(dt, steps)
        self.context, self._integrator = context, integrator
        self._length, self._speed = length, speed

    def advance(self) -> None:
        self.march(1)

    def march(self, steps: int) -> None:
        self._integrator.step(steps)
        self._done += steps

    def put(self, x: FloatArray) -> None:
        self.context.setPositions(x * self._length)

    def observe(self) -> tuple[FloatArray, FloatArray]:
        x, v = seen(self.context)
        return x / self._length, v / self._speed

    @property
    def positions(self) -> FloatArray:
        return self.observe()[0]

    @property
    def velocities(self) -> FloatArray:
        return self.observe()[1]


def seen(context: openmm.Context) -> tuple[FloatArray, FloatArray]:
    """Positions and velocities of a Context, nm and nm/ps."""
    state = context.getState(positions=True, velocities=True)
    return (
        np.array(state.getPositions(asNumpy=True)._value),
        np.array(state.getVelocities(asNumpy=True)._value),
    )
