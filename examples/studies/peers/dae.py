"""Solvers of differential-algebraic equations: Radau IIA of scipy-dae, and SUNDIALS' IDA from scikit-sundae.

Both get the stabilised formulation of index 2 of Gear, Gupta and Leimkuhler, J. Comput. Appl. Math. 12, 77 (1985), with
the multipliers as derivatives of unknowns, which lowers the index by one more::

    x' = v + M^-1 A^T gamma',   v' = M^-1 (f + A^T Lambda'),   sigma(x) = 0,   A v = 0

and a Jacobian in which the derivative of f alone is left out: the simplified Newton iteration converges as long as
steps resolve the motion, and no force is spent on differences.
"""

from __future__ import annotations

from abc import abstractmethod
from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np

from kcons.comparison import Run, TestSystem, add_method
from kcons.constraints.target import FloatArray
from kcons.errors import KconsError
from kcons.motion.motion import Motion
from peers.smallness import dense_rows, one_thread, plain_set, too_much

#: Step of the differences of A.
DIFFERENCE = 1e-6
#: What an unknown may be off by, beside the relative tolerance, as a fraction of its scale.
LEAST = 1e-13


class _Equations:
    """F(t, y, y') = 0 with y = (x, v, Lambda, gamma), its start and its Jacobians."""

    def __init__(self, test_system: TestSystem) -> None:
        self.held = plain_set(test_system)
        self.value, self.gradient = dense_rows(self.held)
        self.test_system, self.shape = test_system, test_system.positions.shape
        self.n, self.m = test_system.positions.size, self.held.n_rows
        self.weights = np.repeat(1.0 / test_system.masses, 3)
        self.size = 2 * (self.n + self.m)
        speed = float(np.sqrt(np.mean(test_system.velocities**2))) or 1.0
        impulse = speed * float(np.mean(test_system.masses))
        parts = ((self.n, 1.0), (self.n, speed), (self.m, impulse), (self.m, impulse))
        self.scale = np.concatenate([np.full(count, size) for count, size in parts])

    def start(self) -> tuple[FloatArray, FloatArray]:
        test_system = self.test_system
        x, v, f = test_system.positions, test_system.velocities, self.forces(test_system.positions, 0.0)
        motion = Motion(self.held, x)
        a, lam = motion.acceleration(x, v, f.reshape(self.shape)), motion.multipliers(x, v, f.reshape(self.shape))
        y = np.concatenate([x.ravel(), v.ravel(), np.zeros(2 * self.m)])
        return y, np.concatenate([v.ravel(), a.ravel(), lam, np.zeros(self.m)])

    def forces(self, x: FloatArray, t: float) -> FloatArray:
        return self.test_system.potential.forces(x, t).ravel()

    def residual(self, t: float, y: FloatArray, rate: FloatArray) -> FloatArray:
        n, m = self.n, self.m
        x, v, lam, gamma = y[:n].reshape(self.shape), y[n : 2 * n], rate[2 * n : 2 * n + m], rate[2 * n + m :]
        a = self.gradient(y[:n])
        return np.concatenate(
            [
                rate[:n] - v - self.weights * (a.T @ gamma),
                rate[n : 2 * n] - self.weights * (self.forces(x, t) + a.T @ lam),
                self.value(y[:n]),
                a @ v,
            ]
        )

    def jacobians(self, t: float, y: FloatArray, rate: FloatArray) -> tuple[FloatArray, FloatArray]:
        """dF/dy and dF/dy', each of shape (size, size)."""
        n, m = self.n, self.m
        a = self.gradient(y[:n])
        lam, gamma = rate[2 * n : 2 * n + m], rate[2 * n + m :]
        by_y, by_rate = np.zeros((self.size, self.size)), np.zeros((self.size, self.size))
        for j in range(n):
            step = np.zeros(n)
            step[j] = DIFFERENCE
            change = (self.gradient(y[:n] + step) - self.gradient(y[:n] - step)) / (2.0 * DIFFERENCE)
            by_y[:n, j] = -self.weights * (gamma @ change)
            by_y[n : 2 * n, j] = -self.weights * (lam @ change)
            by_y[2 * n + m :, j] = change @ y[n : 2 * n]
        by_y[:n, n : 2 * n] = -np.eye(n)
        by_y[2 * n : 2 * n + m, :n] = a
        by_y[2 * n + m :, n : 2 * n] = a
        by_rate[: 2 * n, : 2 * n] = np.eye(2 * n)
        pull = -self.weights[:, None] * a.T
        by_rate[n : 2 * n, 2 * n : 2 * n + m] = pull
        by_rate[:n, 2 * n + m :] = pull
        return by_y, by_rate


class DaeRun(Run):
    """All is one system of equations."""

    def __init__(self, test_system: TestSystem, equations: _Equations) -> None:
        super().__init__(0.0)
        self._equations, self._horizon, self._t = equations, test_system.horizon, 0.0
        self._y, self._rate = equations.start()

    def advance(self, steps: int = 1) -> None:
        for _ in range(steps):
            self._step()

    @abstractmethod
    def _step(self) -> None:
        """One step of the solver."""

    @property
    def time(self) -> float:
        return self._t

    def observe(self) -> tuple[FloatArray, FloatArray]:
        n, shape = self._equations.n, self._equations.shape
        return np.array(self._y[:n]).reshape(shape), np.array(self._y[n : 2 * n]).reshape(shape)


class RadauRun(DaeRun):
    def __init__(self, test_system: TestSystem, rtol: float) -> None:
        from scipy_dae.integrate import RadauDAE

        one_thread("scipy-dae")
        equations = _Equations(test_system)
        super().__init__(test_system, equations)
        self._solver = RadauDAE(
            equations.residual, 0.0, self._y, self._rate, test_system.horizon,
            rtol=rtol, atol=np.maximum(rtol, LEAST) * equations.scale, jac=equations.jacobians,
        )  # fmt: skip

    def _step(self) -> None:
        message = self._solver.step()
        if self._solver.status == "failed":
            raise KconsError(f"Radau gave up at t = {self._solver.t:g}: {message}")
        self._t, self._y = float(self._solver.t), self._solver.y


class IdaRun(DaeRun):
    def __init__(self, test_system: TestSystem, rtol: float) -> None:
        from sksundae.ida import IDA

        one_thread("scikit-sundae")
        equations = _Equations(test_system)
        super().__init__(test_system, equations)

        def residual(t: float, y: FloatArray, rate: FloatArray, out: FloatArray) -> None:
            out[:] = equations.residual(t, y, rate)

        def jacobian(t: float, y: FloatArray, rate: FloatArray, f: FloatArray, cj: float, out: FloatArray) -> None:
            by_y, by_rate = equations.jacobians(t, y, rate)
            out[:] = by_y + cj * by_rate

        self._solver: Any = IDA(
            residual, jacfn=jacobian, rtol=rtol, atol=np.maximum(rtol, LEAST) * equations.scale, max_num_steps=100_000
        )
        self._solver.init_step(0.0, self._y, self._rate)

    def _step(self) -> None:
        found = self._solver.step(self._horizon, method="onestep", tstop=self._horizon)
        if not found.success:
            raise KconsError(f"IDA gave up at t = {self.time:g}: {found.message}")
        self._t, self._y = float(np.ravel(found.t)[-1]), np.ravel(found.y)


def refuses(package: str, module: str, test_system: TestSystem) -> str | None:
    if find_spec(module) is None:
        return f"{package} is not installed; python -m pip install {package}"
    return too_much(test_system)


def add() -> None:
    """Radau and IDA."""
    for name, title, run, package, module in (
        ("dae-radau", "scipy-dae Radau, index 2", RadauRun, "scipy-dae", "scipy_dae"),
        ("dae-ida", "SUNDIALS IDA, index 2", IdaRun, "scikit-sundae", "sksundae"),
    ):
        options = {"title": title, "adaptive": True, "refuses": partial(refuses, package, module)}
        add_method(name, run, **options)
