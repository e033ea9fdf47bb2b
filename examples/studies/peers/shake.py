"""RATTLE by Gauss-Seidel sweeps as a method, over tolerances."""

from __future__ import annotations

from functools import partial

import numpy as np

from kcons.comparison import Run, TestSystem, add_method
from kcons.comparison.methods import exponent
from kcons.constraints.target import FloatArray
from kcons.errors import InputError
from peers.gauss_seidel import GaussSeidel, kick, kick_and_drift

TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
USUAL = (1e-4, 1e-8)


class ShakeRun(Run):
    def __init__(self, test_system: TestSystem, sweeps: GaussSeidel, dt: float) -> None:
        super().__init__(dt)
        self._test_system, self._sweeps = test_system, sweeps
        self._x, self._v = test_system.positions.copy(), test_system.velocities.copy()
        self._old = np.empty_like(self._x)
        self._f = self._first = test_system.potential.forces(self._x)

    def advance(self, steps: int = 1) -> None:
        forces = self._test_system.potential.forces
        if steps > 1:
            self._f = self._sweeps.march(self._x, self._v, self._f, self.dt, steps, forces, self._old)
        else:
            x, v, dt, w = self._x, self._v, self.dt, self._sweeps.inverse_masses
            kick_and_drift(x, v, self._f, w, dt, self._old)
            self._sweeps.positions(x, self._old, v, dt)
            self._f = forces(x)
            kick(v, self._f, w, dt)
            self._sweeps.velocities(x, v, dt)
        self.done += steps

    def observe(self) -> tuple[FloatArray, FloatArray]:
        return self._x.copy(), self._v.copy()

    def rewind(self) -> None:
        self._x[:], self._v[:], self._f = self._test_system.positions, self._test_system.velocities, self._first


def sweeps_of(tolerance: float, test_system: TestSystem) -> GaussSeidel:
    """The solver; angles are held by the distances of their ends."""
    assert test_system.bonds is not None
    masses = test_system.masses.copy()
    masses[test_system.fixed] = np.inf
    # A pair across the boundary would be as long as the box.
    lengths = None if test_system.cell is None else _shortest(test_system)
    return GaussSeidel(test_system.bonds, masses, test_system.positions, tolerance, lengths)


def start(tolerance: float, test_system: TestSystem, dt: float) -> Run:
    return ShakeRun(test_system, sweeps_of(tolerance, test_system), dt)


def refuses(tolerance: float, test_system: TestSystem) -> str | None:
    if test_system.bonds is None:
        return "it holds distances only"
    try:
        sweeps_of(tolerance, test_system)
    except InputError as error:
        return str(error)
    return None


def _shortest(test_system: TestSystem) -> FloatArray:
    assert test_system.bonds is not None
    d = test_system.positions[test_system.bonds[:, 0]] - test_system.positions[test_system.bonds[:, 1]]
    lattice = test_system.motion.lattice
    if lattice is not None:
        d = d - np.round(d @ lattice[1]) @ lattice[0]
    return np.asarray(np.linalg.norm(d, axis=1))


def add() -> None:
    """One for each tolerance."""
    for tolerance in TOLERANCES:
        told = exponent(tolerance)
        options = {"title": f"SHAKE/RATTLE sweeps, {told}", "usual": tolerance in USUAL}
        add_method(f"shake-{told}", partial(start, tolerance), refuses=partial(refuses, tolerance), **options)
