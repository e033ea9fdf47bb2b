"""mici's constrained leapfrog integrator, with its dense Newton solver and its check of reversibility."""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any, ClassVar

import numpy as np

from kcons.comparison.methods.method import Method, Run, Steps
from kcons.comparison.methods.peers.smallness import dense_rows, one_thread, plain_set, too_much
from kcons.comparison.test_systems import TestSystem
from kcons.constraints.target import FloatArray

#: Its own defaults, and what is left of rounding.
DEFAULT = {"constraint_tol": 1e-9, "position_tol": 1e-8}
TIGHT = {"constraint_tol": 1e-13, "position_tol": 1e-12}
#: What is timed as the constraints' part.
SOLVES = ("projection_solver", "_project_onto_cotangent_space")


class _MiciRun(Steps):
    def __init__(self, test_system: TestSystem, dt: float, tolerances: dict[str, float]) -> None:
        from mici.integrators import ConstrainedLeapfrogIntegrator
        from mici.states import ChainState
        from mici.systems import DenseConstrainedEuclideanMetricSystem

        super().__init__(dt, round(test_system.horizon / dt))
        one_thread("mici")
        potential, shape = test_system.potential, test_system.positions.shape
        value, jacobian = dense_rows(plain_set(test_system))
        self._weights = np.repeat(test_system.masses, 3)
        system = DenseConstrainedEuclideanMetricSystem(
            lambda q: potential.energy(q.reshape(shape)),
            value,
            metric=self._weights,
            grad_neg_log_dens=lambda q: -potential.forces(q.reshape(shape)).ravel(),
            jacob_constr=jacobian,
        )
        self._integrator = ConstrainedLeapfrogIntegrator(system, step_size=dt, projection_solver_kwargs=tolerances)
        self.constraints.watch(self._integrator, SOLVES)
        momenta = self._weights * test_system.velocities.ravel()
        self._state: Any = ChainState(pos=test_system.positions.ravel().copy(), mom=momenta, dir=1)
        self._shape = shape
        self._share = math.exp(-0.5 * test_system.friction * dt)
        self._test_system, self._system, self._start = test_system, system, self._state.copy()
        potential.forces(test_system.positions)

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
        self._test_system.potential.forces(self._test_system.positions)
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

    def refuses(self, test_system: TestSystem) -> str | None:
        if find_spec("mici") is None:
            return "mici is not installed; python -m pip install mici"
        return super().refuses(test_system) or too_much(test_system)

    def warm_up(self, test_system: TestSystem) -> None:
        self.start(test_system, min(test_system.time_steps)).advance()

    def start(self, test_system: TestSystem, setting: float) -> Run:
        return _MiciRun(test_system, setting, TIGHT if self.tight else DEFAULT)


def mici_methods() -> list[Method]:
    """At its defaults, and tight."""
    return [
        Mici("mici", "mici constrained leapfrog", md_engine="peer", guest=True, damps=True),
        Mici("mici-tight", "mici, tight", usual=False, md_engine="peer", guest=True, damps=True, tight=True),
    ]
