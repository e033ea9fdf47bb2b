"""mici's constrained leapfrog integrator, with its dense Newton solver and its check of reversibility."""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any, ClassVar

import numpy as np

from kcons.comparison.methods.method import Method, Run, Steps
from kcons.comparison.methods.peers.smallness import dense_rows, one_thread, plain_set, too_much
from kcons.comparison.scenes import Scene
from kcons.constraints.target import FloatArray

#: Its own defaults, and what is left of rounding.
DEFAULT = {"constraint_tol": 1e-9, "position_tol": 1e-8}
TIGHT = {"constraint_tol": 1e-13, "position_tol": 1e-12}
#: What is timed as the constraints' part.
SOLVES = ("projection_solver", "_project_onto_cotangent_space")


class _MiciRun(Steps):
    def __init__(self, scene: Scene, dt: float, tolerances: dict[str, float]) -> None:
        from mici.integrators import ConstrainedLeapfrogIntegrator
        from mici.states import ChainState
        from mici.systems import DenseConstrainedEuclideanMetricSystem

        super().__init__(dt, round(scene.horizon / dt))
        one_thread("mici")
        potential, shape = scene.potential, scene.positions.shape
        value, jacobian = dense_rows(plain_set(scene))
        self._weights = np.repeat(scene.masses, 3)
        system = DenseConstrainedEuclideanMetricSystem(
            lambda q: potential.energy(q.reshape(shape)),
            value,
            metric=self._weights,
            grad_neg_log_dens=lambda q: -potential.forces(q.reshape(shape)).ravel(),
            jacob_constr=jacobian,
        )
        self._integrator = ConstrainedLeapfrogIntegrator(system, step_size=dt, projection_solver_kwargs=tolerances)
        self.constraints.watch(self._integrator, SOLVES)
        momenta = self._weights * scene.velocities.ravel()
        self._state: Any = ChainState(pos=scene.positions.ravel().copy(), mom=momenta, dir=1)
        self._shape = shape
        self._share = math.exp(-0.5 * scene.friction * dt)
        self._scene, self._system, self._start = scene, system, self._state.copy()
        potential.forces(scene.positions)

    def advance(self) -> None:
        if self._share != 1.0:
            self._state.mom = self._share * self._state.mom
        self._state = self._integrator.step(self._state)
        if self._share != 1.0:
            self._state.mom = self._share * self._state.mom
        self._done += 1

    def march(self, steps: int) -> None:
        if self._share != 1.0:
            super().march(steps)
            return
        state, step = self._state, self._integrator.step
        for _ in range(steps):
            state = step(state)
        self._state = state
        self._done += steps

    def rewind(self) -> None:
        self._scene.potential.forces(self._scene.positions)
        # What a state knows goes on to its copies, as it does from step to step.
        self._system.grad_neg_log_dens(self._start)
        self._system.inv_gram(self._start)
        self._state = self._start.copy()

    @property
    def positions(self) -> FloatArray:
        return np.array(self._state.pos).reshape(self._shape)

    @property
    def velocities(self) -> FloatArray:
        return np.asarray(self._state.mom / self._weights).reshape(self._shape)


@dataclass(frozen=True)
class Mici(Method):
    """`ConstrainedLeapfrogIntegrator` on a `DenseConstrainedEuclideanMetricSystem`: RATTLE, each step taken back once.

    Attributes
    ----------
    tight : bool
        Its solver at the end of rounding instead of at its defaults.
    """

    marches: ClassVar[bool] = True

    tight: bool = False

    def refuses(self, scene: Scene) -> str | None:
        if find_spec("mici") is None:
            return "mici is not installed; python -m pip install mici"
        return super().refuses(scene) or too_much(scene)

    def warm_up(self, scene: Scene) -> None:
        self.start(scene, min(scene.time_steps)).advance()

    def start(self, scene: Scene, setting: float) -> Run:
        return _MiciRun(scene, setting, TIGHT if self.tight else DEFAULT)


def mici_methods() -> list[Method]:
    """At its defaults, and tight."""
    return [
        Mici("mici", "mici constrained leapfrog", host="peer", guest=True, damps=True),
        Mici("mici-tight", "mici, tight", usual=False, host="peer", guest=True, damps=True, tight=True),
    ]
