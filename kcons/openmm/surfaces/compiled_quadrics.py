"""The landing on quadrics by compiled code, for platforms that run on the CPU.

OpenMM interprets scalar products in a CustomIntegrator: a third of a microsecond a particle for each. Two PythonForces
carry positions to a compiled loop instead. The first notes where the drift begins; the 'force' of the second is the
way from where a particle flew to its landing, its 'energy' 1 more than the place of a particle that finds none, or 0.
Formulas as in `kcons.openmm.surfaces.quadrics`.
"""

from __future__ import annotations

import uuid
from collections.abc import Sequence
from threading import get_ident
from typing import Any

import numpy as np
import openmm

from kcons.constraints.compilation import njit
from kcons.constraints.constraint import Constraint
from kcons.constraints.target import FloatArray
from kcons.errors import KconsError, UnsupportedError
from kcons.openmm.integrator.program import Program
from kcons.openmm.integrator.system_checks import SURFACE_NAME
from kcons.openmm.surfaces.quadrics import QuadricRows

#: Where drifts began; both callbacks of a System run in turn within one drift. Copies of a System, which have its key,
#: may make steps at the same time, each in a thread of its own.
_STARTS: dict[tuple[str, int], FloatArray] = {}


class CompiledQuadricRows(QuadricRows):
    """As `QuadricRows`; the drift calls compiled code, where it is that of `SurfaceIntegrator` at constant energy.

    Parameters
    ----------
    rows : sequence of Constraint
    system : openmm.System
        Gets two forces, in two force groups that no other force uses.
    """

    moves = True

    def __init__(self, rows: Sequence[Constraint], system: openmm.System) -> None:
        super().__init__(rows, system.getNumParticles())
        # OpenMM takes particles in rising order.
        order = np.argsort(self.atoms)
        tables: tuple[FloatArray, ...] = (
            self.matrices[order],
            self.centers[order],
            self.flats[order],
            self.levels[order],
        )
        if self.spheres:
            tables = tables[1::2]
        free = free_groups(system, 2)
        self._note, self._land = free
        self.groups = frozenset(free)
        key = uuid.uuid4().hex
        for group, callback in ((self._note, _Note(key)), (self._land, _Land(key, tables))):
            force = openmm.PythonForce(callback)
            force.setParticles(self.atoms[order].tolist())
            force.setForceGroup(group)
            force.setName(SURFACE_NAME)
            system.addForce(force)
        self._order = order

    def _declare_solution(self, p: Program) -> None:
        super()._declare_solution(p)  # for drifts beside which there is more than surfaces
        p.number("s_seen", "0; its computation notes where the drift begins")
        p.number("s_failed", "1 more than the place of a particle without landing, 0 for none")
        if self._others:
            p.vector("s_x", "positions where the drift began")

    def fly_alone(self, p: Program, u: str, h: str) -> None:
        if self._others:
            p.each("s_x", "x", "to come back to")
        with p.when("behind = 0", "x need not be where the last drift ended"):
            p.let("s_seen", f"energy{self._note}", "note where the drift begins")
        p.each("x", f"x+{h}*{u}", "fly; not on the surface")
        p.let("s_failed", f"energy{self._land}", "solve for the landing")
        p.let("failed", f"select(s_failed, {self.code}, failed)", "whether there is one")
        p.each("v", f"select(failed, v, {u}+f{self._land}/{h})", "impulse of the surface")
        landing = f"x+f{self._land}"
        if self._others:  # those on surfaces are carried back where there is no landing
            landing = f"select(failed, s_x, {landing})"
        p.each("x", landing, "onto the surface")

    def failure(self, integrator: openmm.CustomIntegrator, step: int) -> KconsError:
        place = 0 if self.circles else int(integrator.getGlobalVariableByName("s_failed"))
        if not place:
            return super().failure(integrator, step)
        solved = np.ones(len(self.atoms))
        solved[self._order[abs(place) - 1]] = -1.0 if place > 0 else np.nan
        return self._error(solved, step, np.full(len(self.atoms), np.nan))


def free_groups(system: openmm.System, count: int) -> list[int]:
    """The last force groups that no force of the System uses."""
    used = {force.getForceGroup() for force in system.getForces()}
    free = sorted(set(range(32)) - used)[-count:]
    if len(free) < count:
        raise UnsupportedError(f"these surfaces need {count} force groups that no force of the System uses")
    return free


class _Note:
    """Callback: where the drift begins."""

    def __init__(self, key: str) -> None:
        self.key = key

    def __call__(self, state: openmm.State) -> tuple[float, FloatArray]:
        x = _positions(state)
        _STARTS[self.key, get_ident()] = x
        return 0.0, np.zeros_like(x)


class _Land:
    """Callback: the way onto the surfaces; where one particle finds none, all go back to where the drift began."""

    def __init__(self, key: str, tables: tuple[FloatArray, ...]) -> None:
        self.key, self.tables = key, tables

    def __call__(self, state: openmm.State) -> tuple[float, FloatArray]:
        x = _positions(state)
        place = self.key, get_ident()
        start = _STARTS.get(place)
        if start is None:
            start = x.copy()
        way = np.empty_like(x)
        solve = _land_on_spheres if len(self.tables) == 2 else _land
        failed = solve(start, x, *self.tables, way)  # type: ignore[call-arg, operator]
        if failed:
            np.subtract(start, x, out=way)
        # The same sum as in the program: where the next drift begins if nobody moves x.
        _STARTS[place] = np.add(x, way, out=x)
        return float(failed), way


def _positions(state: Any) -> FloatArray:
    # The public getPositions makes the same call, and a Quantity, which takes 20 times as long.
    out = np.empty((state._getNumParticles(), 3))
    state._getVectorAsNumpy(openmm.State.Positions, out)
    return out


@njit(cache=True)
def _land_on_spheres(start, there, centers, levels, way):  # type: ignore[no-untyped-def]
    """As `_land`, where Q = 1."""
    for i in range(len(levels)):
        x0, y0, z0 = start[i, 0] - centers[i, 0], start[i, 1] - centers[i, 1], start[i, 2] - centers[i, 2]
        x, y, z = there[i, 0] - centers[i, 0], there[i, 1] - centers[i, 1], there[i, 2] - centers[i, 2]
        A = x0 * x0 + y0 * y0 + z0 * z0
        B = x0 * x + y0 * y + z0 * z
        S = x * x + y * y + z * z - levels[i]
        root = B * B - A * S
        if not root >= 0.0:
            return i + 1 if root < 0.0 else -i - 1
        factor = -S / (B + np.sqrt(root))
        way[i, 0], way[i, 1], way[i, 2] = factor * x0, factor * y0, factor * z0
    return 0


@njit(cache=True)
def _land(start, there, matrices, centers, flats, levels, way):  # type: ignore[no-untyped-def]
    """0, or 1 more than the first row without landing; negative if it is not finite."""
    d0, d = np.empty(3), np.empty(3)
    for i in range(len(levels)):
        A = B = 0.0
        S = -levels[i]
        for j in range(3):
            d0[j] = start[i, j] - centers[i, j]
            d[j] = there[i, j] - centers[i, j]
        for j in range(3):
            g0 = g = flats[i, j]
            for k in range(3):
                g0 += matrices[i, j, k] * d0[k]
                g += matrices[i, j, k] * d[k]
            way[i, j] = g0
            B += g0 * g
            S += d[j] * (g + flats[i, j])
        for j in range(3):
            for k in range(3):
                A += way[i, j] * matrices[i, j, k] * way[i, k]
        root = B * B - A * S
        if not root >= 0.0:
            return i + 1 if root < 0.0 else -i - 1
        factor = -S / (B + np.sqrt(root))
        for j in range(3):
            way[i, j] *= factor
    return 0
