"""RATTLE by Gauss-Seidel sweeps as a method, over tolerances."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from kcons.comparison.methods.method import Method, Run, Steps, exponent
from kcons.comparison.methods.peers.gauss_seidel import GaussSeidel, kick, kick_and_drift
from kcons.comparison.scenes import Scene
from kcons.constraints.target import FloatArray
from kcons.errors import InputError

TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
USUAL = (1e-4, 1e-8)


class _ShakeRun(Steps):
    def __init__(self, scene: Scene, sweeps: GaussSeidel, dt: float) -> None:
        super().__init__(dt, round(scene.horizon / dt))
        self._scene, self._sweeps = scene, sweeps
        self.constraints.watch(sweeps, ("positions", "velocities"))
        self._x, self._v = scene.positions.copy(), scene.velocities.copy()
        self._old = np.empty_like(self._x)
        self._f = self._first = scene.potential.forces(self._x)

    def advance(self) -> None:
        x, v, dt, w = self._x, self._v, self._dt, self._sweeps.inverse_masses
        kick_and_drift(x, v, self._f, w, dt, self._old)
        self._sweeps.positions(x, self._old, v, dt)
        self._f = self._scene.potential.forces(x)
        kick(v, self._f, w, dt)
        self._sweeps.velocities(x, v, dt)
        self._done += 1

    def march(self, steps: int) -> None:
        forces = self._scene.potential.forces
        self._f = self._sweeps.march(self._x, self._v, self._f, self._dt, steps, forces, self._old)
        self._done += steps

    def rewind(self) -> None:
        self._x[:], self._v[:], self._f = self._scene.positions, self._scene.velocities, self._first
        # The end of the last step is no longer the last point known.
        self._scene.potential.forces(self._x)

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

    def refuses(self, scene: Scene) -> str | None:
        reason = super().refuses(scene)
        if reason is None and scene.bonds is None:
            reason = "it holds distances only"
        if reason is None:
            try:
                self._sweeps(scene)
            except InputError as error:
                reason = str(error)
        return reason

    def warm_up(self, scene: Scene) -> None:
        run = self.start(scene, min(scene.time_steps))
        run.advance()
        run.march(1)

    def start(self, scene: Scene, setting: float) -> Run:
        return _ShakeRun(scene, self._sweeps(scene), setting)

    def _sweeps(self, scene: Scene) -> GaussSeidel:
        assert scene.bonds is not None
        masses = scene.masses.copy()
        masses[scene.fixed] = np.inf
        # A pair across the boundary would be as long as the box.
        lengths = None if scene.cell is None else _shortest(scene)
        return GaussSeidel(scene.bonds, masses, scene.positions, self.tolerance, lengths)


def _shortest(scene: Scene) -> FloatArray:
    assert scene.bonds is not None
    d = scene.positions[scene.bonds[:, 0]] - scene.positions[scene.bonds[:, 1]]
    lattice = scene.motion.lattice
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
                host="peer",
                guest=True,
                tolerance=tolerance,
            )
        )
    return found
