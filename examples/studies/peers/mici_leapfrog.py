"""mici's constrained leapfrog integrator, with its dense Newton solver and its check of reversibility."""

from __future__ import annotations

from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np

from kcons.comparison import Run, TestSystem, add_method
from kcons.constraints.target import FloatArray
from peers.smallness import dense_rows, one_thread, plain_set, too_much

#: Its own defaults, and what is left of rounding.
DEFAULT = {"constraint_tol": 1e-9, "position_tol": 1e-8}
TIGHT = {"constraint_tol": 1e-13, "position_tol": 1e-12}


class MiciRun(Run):
    def __init__(self, test_system: TestSystem, dt: float, tolerances: dict[str, float]) -> None:
        from mici.integrators import ConstrainedLeapfrogIntegrator
        from mici.states import ChainState
        from mici.systems import DenseConstrainedEuclideanMetricSystem

        super().__init__(dt)
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
        momenta = self._weights * test_system.velocities.ravel()
        self._state: Any = ChainState(pos=test_system.positions.ravel().copy(), mom=momenta, dir=1)
        self._shape = shape
        self._test_system, self._system, self._start = test_system, system, self._state.copy()
        potential.forces(test_system.positions)

    def advance(self, steps: int = 1) -> None:
        state, step = self._state, self._integrator.step
        for _ in range(steps):
            state = step(state)
        self._state = state
        self.done += steps

    def rewind(self) -> None:
        # What a state knows goes on to its copies, as it does from step to step.
        self._system.grad_neg_log_dens(self._start)
        self._system.inv_gram(self._start)
        self._state = self._start.copy()

    def observe(self) -> tuple[FloatArray, FloatArray]:
        return np.array(self._state.pos).reshape(self._shape), (self._state.mom / self._weights).reshape(self._shape)


def start(tolerances: dict[str, float], test_system: TestSystem, dt: float) -> Run:
    """`ConstrainedLeapfrogIntegrator`: RATTLE, each step taken back once."""
    return MiciRun(test_system, dt, tolerances)


def refuses(test_system: TestSystem) -> str | None:
    if find_spec("mici") is None:
        return "mici is not installed; python -m pip install mici"
    return too_much(test_system)


def add() -> None:
    """At its defaults, and tight."""
    for name, title, tolerances in (
        ("mici", "mici constrained leapfrog", DEFAULT),
        ("mici-tight", "mici, tight", TIGHT),
    ):
        options = {"title": title, "usual": tolerances is DEFAULT, "refuses": refuses}
        add_method(name, partial(start, tolerances), **options)
