"""RATTLE by Gauss-Seidel sweeps as a method, over tolerances."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from kcons.comparison.methods.method import Method, Run, Steps, exponent
from kcons.comparison.methods.peers.gauss_seidel import GaussSeidel, kick, kick_and_drift
from kcons.comparison.test_systems import TestSystem
from kcons.constraints.target import FloatArray
from kcons.errors import InputError

TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
USUAL = (1e-4, 1e-8)


class _ShakeRun(Steps):
    def __init__(self, test_system: TestSystem, sweeps: GaussSeidel, dt: float) -> None:
        super().__init__(dt, round(test_system.horizon / dt))
        self._test_system, self._sweeps = test_system, sweeps
        self.constraints.watch(sweeps, ("positions", "velocities"))
        self._x, self._v = test_system.positions.copy(), test_system.velocities.copy()
        self._old = np.empty_like(self._x)
        self._f = self._first = test_system.potential.forces(self._x)

    def advance(self) -> None:
        x, v, dt, w = self._x, self._v, self._dt, self._sweeps.inverse_masses
        kick_and_drift(x, v, self._f, w, dt, self._old)
        self._sweeps.positions(x, self._old, v, dt)
        self._f = self._test_system.potential.forces(x)
        kick(v, self._f, w, dt)
        self._sweeps.velocities(x, v, dt)
        self._done += 1

    def march(self, steps: int) -> None:
        forces = self._test_system.potential.forces
        self._f = self._sweeps.march(self._x, self._v, self._f, self._dt, steps, forces, self._old)
        self._done += steps

    def rewind(self) -> None:
        self._x[:], self._v[:], self._f = self._test_system.positions, self._test_system.velocities, self._first
        # The end of the last step is no longer the last point known.
        self._test_system.potential.forces(self._x)

    @property
    def positions(self) -> FloatArray:
        return self._x.copy()

    @property
    def velocities(self) -> FloatArray:
        return self._v.copy()


@dataclass(frozen=True)
class Shake(Method):
    """Velocity Verlet with SHAKE and RATTLE sweeps; angles are held by the distances of their ends.

    Attributes
    ----------
    tolerance : float
    """

    marches: ClassVar[bool] = True

    tolerance: float = 1e-8

    def refuses(self, test_system: TestSystem) -> str | None:
        reason = super().refuses(test_system)
        if reason is None and test_system.bonds is None:
            reason = "it holds distances only"
        if reason is None:
            try:
                self._sweeps(test_system)
            except InputError as error:
                reason = str(error)
        return reason

    def warm_up(self, test_system: TestSystem) -> None:
        run = self.start(test_system, min(test_system.time_steps))
        run.advance()
        run.march(1)

    def start(self, test_system: TestSystem, setting: float) -> Run:
        return _ShakeRun(test_system, self._sweeps(test_system), setting)

    def _sweeps(self, test_system: TestSystem) -> GaussSeidel:
        assert test_system.bonds is not None
        masses = test_system.masses.copy()
        masses[test_system.fixed] = np.inf
        # A pair across the boundary would be as long as the box.
        lengths = None if test_system.cell is None else _shortest(test_system)
        return GaussSeidel(test_system.bonds, masses, test_system.positions, self.tolerance, lengths)


def _shortest(test_system: TestSystem) -> FloatArray:
    assert test_system.bonds is not None
    d = test_system.positions[test_system.bonds[:, 0]] - test_system.positions[test_system.bonds[:, 1]]
    lattice = test_system.motion.lattice
    if lattice is not None:
        d = d - np.round(d @ lattice[1]) @ lattice[0]
    return np.asarray(np.linalg.norm(d, axis=1))


def shake_methods() -> list[Method]:
    """One for each tolerance."""
    found: list[Method] = []
    for tolerance in TOLERANCES:
        told = exponent(tolerance)
        found.append(
            Shake(
                f"shake-{told}",
                f"SHAKE/RATTLE sweeps, {told}",
                usual=tolerance in USUAL,
                md_engine="peer",
                guest=True,
                tolerance=tolerance,
            )
        )
    return found
