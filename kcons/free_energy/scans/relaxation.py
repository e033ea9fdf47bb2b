"""Minima on constraints with few evaluations of energy and forces, for structures of up to some hundred atoms."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from typing import Any

import numpy as np

from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, KconsError
from kcons.free_energy.scans.model_hessian import Internals
from kcons.motion.motion import Motion

#: Energy in eV and forces in eV/angstrom at positions, shape (n_atoms, 3).
Evaluate = Callable[[FloatArray], tuple[float, FloatArray]]

#: Curvatures below this count as this, in eV/angstrom^2: flat directions, and shifts and turns of the whole.
FLAT = 0.02
#: How far an atom moves in a step at first, at least and at most, in angstrom.
FIRST, LEAST, MOST = 0.2, 1e-4, 0.4
#: Of the largest, below which directions count as none.
RANK = 1e-8
#: Rise of the energy that is taken for rounding, in eV.
ROUNDING = 1e-6
#: Moves that are remembered from one relaxation to the next.
MEMORY = 40
#: Rounds in which a step is bent so that internal coordinates change as they would along it.
BENDINGS = 4


@cache
def _libraries() -> Any:
    """The BLAS libraries that are loaded; None without threadpoolctl."""
    if find_spec("threadpoolctl") is None:
        return None
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController().select(user_api="blas")


@contextmanager
def one_thread() -> Iterator[None]:
    """Keep BLAS to one thread inside: threads that share a small matrix wait for each other longer than they compute.

    With few cores, or other work on them, a hundred times as long. A calculator has the threads that its user chose.
    """
    libraries = _libraries()
    if libraries is None:
        yield
        return
    with libraries.limit(limits=1):
        yield


@dataclass(frozen=True, eq=False)
class Relaxed:
    """A minimum on constraints, its energy in eV, and the largest force along them that is left, in eV/angstrom."""

    positions: FloatArray
    energy: float
    largest: float
    #: Moves and changes of the slopes along internal coordinates, (m, 2, n): what was learned of the curvature.
    memory: FloatArray
    #: Calls of energy and forces.
    evaluations: int


class _Place:
    """Positions, energy, and what follows from the rows there."""

    @one_thread()
    def __init__(self, descent: Descent, x: FloatArray, energy: float, forces: FloatArray) -> None:
        self.x, self.energy = x, energy
        columns, internals = descent.columns, descent.internals
        slope = -forces.ravel()
        held = descent.motion.constraint_set
        rows = held.jacobian(x).toarray()[:, columns]
        size = np.linalg.norm(rows, axis=1, keepdims=True)
        _, weights, basis = np.linalg.svd(rows / np.where(size > 0, size, 1.0))
        #: Orthonormal directions along the constraints, shape (columns, d).
        self.along = basis[int(np.sum(weights > RANK)) :].T
        self.left = self.along.T @ slope[columns]
        force = np.zeros_like(slope)
        force[columns] = self.along @ self.left
        self.largest = float(np.linalg.norm(force.reshape(-1, 3), axis=1).max(initial=0.0))
        self.values = internals.values(x)
        self.table = internals.jacobian(x)
        # Slopes along the internal coordinates, of least size in the metric of the model.
        stiff = internals.constants[:, None] * self.table
        self.slopes = stiff @ (np.linalg.pinv(self.table.T @ stiff, rcond=RANK, hermitian=True) @ slope)


class Descent:
    """Quasi-Newton steps on constraints, in internal coordinates."""

    def __init__(self, motion: Motion, evaluate: Evaluate, internals: Internals, memory: FloatArray | None) -> None:
        self.motion, self.evaluate, self.internals = motion, evaluate, internals
        #: What was learned, move by move: vectors u and w of internal coordinates and numbers c, see `_learned`.
        self._updates: list[tuple[FloatArray, FloatArray, float]] = []
        self._memory: list[FloatArray] = []
        for pair in [] if memory is None else memory:
            self._learn(pair)
        self.evaluations = 0
        free = np.ones(motion.n_atoms, dtype=bool)
        for item in motion.constraint_set.constraints:
            if item.family == "FixedAtoms":
                free[item.atoms.ravel()] = False
        self.columns: IntArray = np.flatnonzero(np.repeat(free, 3))

    def place(self, x: FloatArray) -> _Place:
        self.evaluations += 1
        return _Place(self, x, *self.evaluate(x))

    def relaxed(self, x: FloatArray, fmax: float, most: int) -> Relaxed:
        here, radius = self.place(x), FIRST
        while here.largest > fmax:
            if self.evaluations >= most:
                raise self._given_up(here, fmax, f"{most} evaluations; allow more, or start nearer to the minimum")
            if radius < LEAST:
                raise self._given_up(
                    here,
                    fmax,
                    "no step lowers the energy any further: forces are not its gradient, or not so exact; take a "
                    "larger fmax, or a calculator whose energies are smoother",
                )
            step, expected = self._step(here, radius)
            try:
                x = self._moved(here, step)
            except KconsError:  # too far for the rows
                radius /= 4
                continue
            there = self.place(x)
            move = self.internals.change(there.values, here.values)
            self._learn(np.stack([move, there.slopes - here.slopes]))
            gain = there.energy - here.energy
            longest = _longest(there.x - here.x)
            ratio = gain / expected if expected < 0 else -1.0
            if abs(gain) <= ROUNDING:
                ratio = 1.0 if there.largest <= here.largest else 0.0
            if ratio > 0.75 and longest > 0.8 * radius:
                radius = min(MOST, 2 * radius)
            elif ratio < 0.25:
                radius = min(radius, longest) / (2 if ratio > 0 else 4)
            if gain <= 0 or ratio > 0 or there.largest <= fmax:
                here = there
        return Relaxed(here.x, here.energy, here.largest, np.array(self._memory[-MEMORY:]), self.evaluations)

    def _given_up(self, here: _Place, fmax: float, why: str) -> ConvergenceError:
        error = ConvergenceError(
            f"the largest force along the constraints is {here.largest:.3g} eV/angstrom, and not {fmax:g}, after {why}",
            residual=here.largest,
            tolerance=fmax,
            iterations=self.evaluations,
        )
        error.positions = here.x
        return error

    @one_thread()
    def _step(self, here: _Place, radius: float) -> tuple[FloatArray, float]:
        """Along the rows, the longest move of an atom at most `radius`, shape (columns,); what it is to gain."""
        table = here.table[:, self.columns] @ here.along
        hessian = table.T @ (self.internals.constants[:, None] * table + self._learned(table))
        curvature, modes = np.linalg.eigh(hessian)
        size = np.maximum(np.abs(curvature), FLAT)
        slopes = modes.T @ here.left

        def at(shift: float) -> FloatArray:
            return np.asarray(-slopes / (size + shift))

        def longest(step: FloatArray) -> float:
            return _longest(here.along @ (modes @ step))

        step = at(0.0)
        if longest(step) > radius:
            low, high = 0.0, float(np.linalg.norm(slopes)) / radius
            for _ in range(30):
                middle = 0.5 * (low + high)
                low, high = (middle, high) if longest(at(middle)) > radius else (low, middle)
            step = at(high)
        return here.along @ (modes @ step), float(slopes @ step + 0.5 * step @ (curvature * step))

    @one_thread()
    def _moved(self, here: _Place, step: FloatArray) -> FloatArray:
        """Positions after a step, on the rows: internal coordinates change as they do at its beginning."""
        internals, columns = self.internals, self.columns
        wanted = here.table[:, columns] @ step
        x = here.x.copy()
        x.flat[columns] += step
        for _ in range(BENDINGS):
            table = internals.jacobian(x)[:, columns] @ here.along
            weighed = table.T * internals.constants
            missing = wanted - internals.change(internals.values(x), here.values)
            normal = weighed @ table + 1e-3 * FLAT * np.eye(table.shape[1])
            x.flat[columns] += here.along @ np.linalg.solve(normal, weighed @ missing)
        return self.motion.project_positions(x, here.x)

    @one_thread()
    def _learn(self, pair: FloatArray) -> None:
        """The nearest symmetric matrix that maps a move to the change of the slopes, of any signature (TS-BFGS)."""
        move, change = pair
        size = self.internals.constants * move
        missing = change - size - self._learned(move)
        weight = change * (change @ move) + size * (size @ move)
        scale = float(weight @ move)
        if scale > 0:
            self._updates.append((missing, weight / scale, float(missing @ move)))
            self._memory.append(pair)

    def _learned(self, move: FloatArray) -> FloatArray:
        """Second derivatives beyond the model, the sum of u w^T + w u^T - c w w^T, times one or several moves."""
        if not self._updates:
            return np.zeros_like(move)
        u, w, c = (np.array(part) for part in zip(*self._updates, strict=True))
        along = w @ move
        return np.asarray(u.T @ along + w.T @ (u @ move - (c * along.T).T))


def _longest(move: FloatArray) -> float:
    return float(np.linalg.norm(move.reshape(-1, 3), axis=1).max(initial=0.0))


def relax(
    motion: Motion,
    evaluate: Evaluate,
    internals: Internals,
    x: FloatArray,
    *,
    fmax: float,
    memory: FloatArray | None = None,
    evaluations: int = 200,
) -> Relaxed:
    """Follow the forces on the constraints to a minimum of the energy.

    Parameters
    ----------
    motion : Motion
    evaluate : callable
        ``evaluate(x)``: energy in eV, forces in eV/angstrom, shape (n_atoms, 3).
    internals : Internals
        Of a structure near `x`.
    x : ndarray, shape (n_atoms, 3)
        On the constraints.
    fmax : float
        The largest force along the constraints that may be left on an atom, in eV/angstrom.
    memory : ndarray, shape (m, 2, n), optional
        That of a relaxation nearby, in the same internal coordinates.
    evaluations : int
        Give up after so many.

    Raises
    ------
    ConvergenceError
        Too many evaluations, or forces that are not the gradient of the energy; `error.positions` is the last place.

    References
    ----------
    J. M. Bofill, Int. J. Quantum Chem. 94, 324 (2003); E. D. Hermes et al., J. Chem. Theory Comput. 18, 6974 (2022).
    """
    try:
        with np.errstate(all="ignore"):
            return Descent(motion, evaluate, internals, memory).relaxed(x, fmax, evaluations)
    except np.linalg.LinAlgError as error:
        raise ConvergenceError(
            "an angle became straight, or two atoms met, where internal coordinates are undefined; start elsewhere"
        ) from error
