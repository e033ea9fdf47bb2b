"""How OpenMM rounds positions and corrections that pass between it and the engine.

On Reference and CPU they are doubles. GPUs keep forces as multiples of 2^-32, and CustomIntegrator reads them divided
by 2^32 - 1. In mixed precision positions are pairs of single numbers, 48 bits: a PythonForce of all particles gets
both, one of some particles only the first. What it returns becomes single numbers: corrections have
relative errors up to 6e-8. From the rounded correction the engine knows the positions in OpenMM, to rounding.
"""

from __future__ import annotations

import numpy as np
import openmm

from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.openmm.integrator.precision import Precision
from kcons.steppers.state import START_TOLERANCE

#: Corrections are carried multiplied by this: on GPUs forces are whole multiples of 2^-32.
CARRY_SCALE = 2.0**20
#: What GPUs multiply forces with, and what CustomIntegrator divides them by.
_TO_WHOLE, _FROM_WHOLE = 2.0**32, 2.0**32 - 1


def hands_over_all() -> bool:
    """Whether callbacks are to be given the positions of all particles: a platform here may have mixed precision."""
    platforms = range(openmm.Platform.getNumPlatforms())
    return any("Precision" in openmm.Platform.getPlatform(k).getPropertyNames() for k in platforms)


class Passage:
    """Between OpenMM and an engine that knows some of its particles.

    Parameters
    ----------
    atoms : ndarray of int, shape (n_atoms,)
        The particles of the engine.
    n_particles : int
        Of the System.

    Attributes
    ----------
    precision : Precision
        That of the Context.
    """

    def __init__(self, atoms: IntArray, n_particles: int) -> None:
        self.atoms, self._n = atoms, n_particles
        self.precision = Precision("", "double")
        #: Positions and corrections of all particles, where OpenMM hands over all.
        self._all: tuple[FloatArray, FloatArray] | None = None
        self._nothing = np.zeros((len(atoms), 3))
        self._open = False

    def open(self, state: openmm.State) -> None:
        """At the first call: whether positions are those of all particles."""
        if not self._open:
            self._open = True
            if len(self.atoms) < self._n == len(state.getPositions()):
                self._all = np.zeros((self._n, 3)), np.zeros((self._n, 3))

    def take(self, state: openmm.State, out: FloatArray) -> None:
        """Positions of the engine's particles, shape (n_atoms, 3), nm."""
        # The public getPositions(asNumpy=True) makes the same call, and a Quantity: 20 times as slow.
        if self._all is None:
            state._getVectorAsNumpy(openmm.State.Positions, out)
        else:
            state._getVectorAsNumpy(openmm.State.Positions, self._all[0])
            np.take(self._all[0], self.atoms, axis=0, out=out)

    def give(self, force: FloatArray | None) -> FloatArray:
        """What is returned to OpenMM for a force on the engine's particles; None for no force."""
        force = self._nothing if force is None else force
        if self._all is None:
            return force
        self._all[1][self.atoms] = force
        return self._all[1]

    def carried(self, change: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The force that carries a change, and the change that arrives."""
        if not self.precision.rounds_lengths:
            return change * CARRY_SCALE, change
        force = change * (CARRY_SCALE * _FROM_WHOLE / _TO_WHOLE)
        if self.precision.name != "double":
            force = force.astype(np.float32).astype(np.float64)
        return force, np.trunc(force * _TO_WHOLE) / (_FROM_WHOLE * CARRY_SCALE)

    def same(self, x: FloatArray, y: FloatArray) -> bool:
        """Whether positions of a Context, and those it should have, are the same to its rounding."""
        if not self.precision.rounds_lengths:
            return np.array_equal(x, y)
        return bool(np.abs(x - y).max(initial=0.0) <= 4 * self.precision.place * np.abs(y).max(initial=0.0))

    def grain(self, reach: float) -> float:
        """Spacing of coordinates at a distance from the origin."""
        return float(np.spacing(reach)) if self.precision.name == "double" else 2 * self.precision.place * reach

    @property
    def limits(self) -> tuple[float, float]:
        """What positions, of the scale of a row, and velocities, of their size, may be off."""
        if self.precision.name == "double":
            return START_TOLERANCE, START_TOLERANCE
        return self.precision.tolerance, self.precision.speeds
