"""Minima on constraints with few evaluations of energy and forces, for structures of up to some hundred atoms.

Steps are those of a model of the Hessian from the geometry alone, and of what was learned on the way. The model is
E = sum of k_i (q_i - q_i0)^2/2 over distances, angles and dihedrals q_i of neighbors, with constants k_i that fall off
with the distances of the atoms. No bonds need to be known, and weak contacts have weak constants.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from functools import cache
from importlib.util import find_spec
from typing import Any

import numpy as np
from ase import units

from kcons.constraints import Angle, Constraint, Dihedral, Distance
from kcons.constraints.constraint import IntArray
from kcons.constraints.periodic.one_piece import lined_up, minimum_image
from kcons.constraints.target import FloatArray, nearest_image
from kcons.constraints.vectors import cross, dot, norm
from kcons.errors import ConvergenceError, KconsError
from kcons.motion.motion import Motion

#: Constants of the model in hartree and bohr: of distances, angles and dihedrals.
STRETCH, BEND, TURN = 0.45, 0.15, 0.005
#: Exponents and lengths for atoms of the first, second and later rows of the periodic table, in bohr.
_EXPONENT = np.array([[1.0, 0.3949, 0.3949], [0.3949, 0.28, 0.28], [0.3949, 0.28, 0.28]])
_LENGTH = np.array([[1.35, 2.1, 2.53], [2.1, 2.87, 3.4], [2.53, 3.4, 3.4]])
#: Closeness below which a term is left out: atoms that are bonded have about 1.
CLOSE_PAIR, CLOSE = 1e-3, 1e-2
#: Sine of an angle below which it counts as straight.
STRAIGHT = 0.2


class Internals:
    """Internal coordinates with the constants of the model, chosen from positions in angstrom.

    R. Lindh, A. Bernhardsson, G. Karlström and P.-Å. Malmqvist, Chem. Phys. Lett. 241, 423 (1995).
    """

    def __init__(self, numbers: Sequence[int] | IntArray, x: FloatArray, lattice: FloatArray | None = None) -> None:
        self.lattice, self.n_atoms = lattice, len(x)
        row = np.searchsorted([2, 10], np.asarray(numbers))
        apart = norm(minimum_image(x[None] - x[:, None], lattice)) / units.Bohr
        close = np.exp(_EXPONENT[row[:, None], row] * (_LENGTH[row[:, None], row] ** 2 - apart**2))
        np.fill_diagonal(close, 0.0)
        near = close >= CLOSE
        pairs = np.argwhere(np.triu(close >= CLOSE_PAIR))
        triples = [
            (i, j, k)
            for j in range(self.n_atoms)
            for i in np.flatnonzero(near[j])
            for k in np.flatnonzero(near[j])
            if i < k and close[i, j] * close[j, k] >= CLOSE
        ]
        table = np.array(triples, dtype=np.int64).reshape(-1, 3)
        sine = self._sines(x, table)
        bent = table[sine >= STRAIGHT]
        quads = [
            (i, j, k, l)
            for i, j, k in (tuple(t) for half in (bent, bent[:, ::-1]) for t in half.tolist())
            for l in np.flatnonzero(near[k])
            if l not in (i, j) and i < l and close[i, j] * close[j, k] * close[k, l] >= CLOSE
        ]
        turns = np.array(quads, dtype=np.int64).reshape(-1, 4)
        turns = turns[self._sines(x, turns[:, 1:]) >= STRAIGHT]
        straight = table[sine < STRAIGHT]
        self._families: list[Constraint] = [Distance(pairs), Angle(bent), Dihedral(turns)]
        self._periods = np.repeat([0.0, 2 * np.pi, 0.0], [len(pairs) + len(bent), len(turns), 2 * len(straight)])
        # From now on each term keeps its images: in a small cell, others may come as near.
        self._tables = [*(item.atoms for item in self._families), straight]
        self._images = [lined_up(x[atoms], lattice) - x[atoms] for atoms in self._tables]
        # Two directions across each straight angle, shape (2, n, 3).
        r = self._gathered(x)[-1]
        axis = _along(r[:, 2] - r[:, 0])
        first = _along(cross(axis, np.eye(3)[np.argmin(np.abs(axis), axis=1)]))
        self._frames = np.stack([first, cross(axis, first)])
        constants = [
            math.prod((close[*table[:, k : k + 2].T] for k in range(table.shape[1] - 1)), start=size) * units.Hartree
            for size, table in zip((STRETCH, BEND, TURN, BEND), self._tables, strict=True)
        ]
        #: In eV and angstrom or radian; and the atoms of each.
        self.constants: FloatArray = np.concatenate([constants[0] / units.Bohr**2, *constants[1:], constants[3]])
        self.terms = [tuple(row) for item in self._families for row in item.atoms.tolist()]
        # The two directions across a straight angle are those of this structure alone.
        self.terms += [(*row, -1, side) for side in (0, 1) for row in straight.tolist()]

    def remapped(self, data: FloatArray, terms: Sequence[tuple[int, ...]]) -> FloatArray:
        """Data for other terms, shape (..., m), as data for these; zero for terms that were not among them."""
        place = {term: n for n, term in enumerate(terms) if -1 not in term}
        result = np.zeros((*data.shape[:-1], len(self.terms)))
        for n, term in enumerate(self.terms):
            if term in place:
                result[..., n] = data[..., place[term]]
        return result

    def _gathered(self, x: FloatArray) -> list[FloatArray]:
        """The atoms of each distance, angle, dihedral and straight angle, in the images next to each other."""
        return [x[atoms] + images for atoms, images in zip(self._tables, self._images, strict=True)]

    def _sines(self, x: FloatArray, triples: IntArray) -> FloatArray:
        r = lined_up(x[triples], self.lattice)
        u, w = r[:, 0] - r[:, 1], r[:, 2] - r[:, 1]
        return norm(cross(u, w)) / (norm(u) * norm(w))

    def values(self, x: FloatArray) -> FloatArray:
        """Angstrom and radian, shape (n,)."""
        *gathered, r = self._gathered(x)
        found = [item.measure(part, 0.0) for item, part in zip(self._families, gathered, strict=True)]
        bow = _along(r[:, 0] - r[:, 1]) + _along(r[:, 2] - r[:, 1])
        return np.concatenate([*found, *np.einsum("sni,ni->sn", self._frames, bow)])

    def change(self, after: FloatArray, before: FloatArray) -> FloatArray:
        """Difference of two sets of values, dihedrals by the shorter way."""
        return nearest_image(after - before, self._periods)

    def jacobian(self, x: FloatArray) -> FloatArray:
        """dq/dx, shape (n, 3 n_atoms)."""
        table = np.zeros((len(self.constants), self.n_atoms, 3))
        *gathered, r = self._gathered(x)
        first = 0
        for item, part in zip(self._families, gathered, strict=True):
            table[first + np.arange(item.n_rows)[:, None], item.atoms] = item.gradient(part, 0.0)
            first += item.n_rows
        for side, mine in zip(self._frames, np.arange(first, len(table)).reshape(2, -1), strict=True):
            for end in (0, 2):
                arm = r[:, end] - r[:, 1]
                slope = side / norm(arm)[:, None] - arm * (dot(side, arm) / norm(arm) ** 3)[:, None]
                table[mine, self._tables[-1][:, end]] += slope
                table[mine, self._tables[-1][:, 1]] -= slope
        return table.reshape(len(table), 3 * self.n_atoms)


def _along(r: FloatArray) -> FloatArray:
    """Vectors of length 1, shape (n, 3)."""
    return r / norm(r)[:, None]


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
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController().select(user_api="blas")


def one_thread() -> AbstractContextManager[Any]:
    """Keep BLAS to one thread inside: threads that share a small matrix wait for each other longer than they compute.

    With few cores, or other work on them, a hundred times as long. A calculator has the threads that its user chose.
    """
    return nullcontext() if find_spec("threadpoolctl") is None else _libraries().limit(limits=1)


@dataclass(eq=False)
class Relaxed:
    """A minimum on constraints, its energy in eV, and the largest force along them that is left, in eV/angstrom."""

    positions: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    energy: float = math.nan
    largest: float = math.nan
    #: Calls of energy and forces.
    evaluations: int = 0
    #: Moves and changes of the slopes along internal coordinates, (m, 2, n): what was learned of the curvature.
    memory: FloatArray = field(default_factory=lambda: np.zeros((0, 2, 0)))
    terms: list[tuple[int, ...]] = field(default_factory=list)


class _Place:
    """Positions, energy, and what follows from the rows there."""

    def __init__(self, descent: Descent, x: FloatArray, energy: float, forces: FloatArray) -> None:
        self.x, self.energy, slope = x, energy, -forces.ravel()
        columns, internals = descent.columns, descent.internals
        rows = descent.motion.constraint_set.jacobian(x).toarray()[:, columns]
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
    """Quasi-Newton steps on constraints, in internal coordinates of a structure nearby.

    `memory` is that of a relaxation nearby, in the same internal coordinates (J. M. Bofill, Int. J. Quantum Chem. 94,
    324 (2003); E. D. Hermes et al., J. Chem. Theory Comput. 18, 6974 (2022)).
    """

    def __init__(
        self, motion: Motion, evaluate: Evaluate, internals: Internals, memory: Iterable[FloatArray] = ()
    ) -> None:
        self.motion, self.evaluate, self.internals = motion, evaluate, internals
        #: What was learned, move by move: vectors u and w of internal coordinates and numbers c, see `_learned`.
        self._updates: list[tuple[FloatArray, FloatArray, float]] = []
        self._memory: list[FloatArray] = []
        for pair in memory:
            self._learn(pair)
        self.evaluations = 0
        fixed = [item.atoms.ravel() for item in motion.constraint_set.constraints if item.fixes_atoms]
        free = np.setdiff1d(np.arange(motion.n_atoms), np.concatenate([[], *fixed]))
        self.columns: IntArray = (3 * free[:, None] + np.arange(3)).ravel()

    @np.errstate(all="ignore")
    def relaxed(self, x: FloatArray, fmax: float, most: int = 200) -> Relaxed:
        """Follow the forces on the constraints to a minimum of the energy, by at most so many evaluations.

        `ConvergenceError` of too many, or of forces that are not the gradient; `error.positions` is the last place.
        """
        try:
            return self._relaxed(x, fmax, most)
        except np.linalg.LinAlgError as error:
            raise ConvergenceError(
                "an angle became straight, or two atoms met, where internal coordinates are undefined; start elsewhere"
            ) from error

    def _place(self, x: FloatArray) -> _Place:
        self.evaluations += 1
        found = self.evaluate(x)
        with one_thread():
            return _Place(self, x, *found)

    def _relaxed(self, x: FloatArray, fmax: float, most: int) -> Relaxed:
        here, radius = self._place(x), FIRST
        while here.largest > fmax:
            if self.evaluations >= most or radius < LEAST:
                why = f"{most} evaluations; allow more, or start nearer to the minimum"
                if self.evaluations < most:
                    why = "no step lowers the energy any further: forces are not its gradient, or not so exact; take "
                    why += "a larger fmax, or a calculator whose energies are smoother"
                error = ConvergenceError(
                    f"the largest force along the constraints is {here.largest:.3g} eV/angstrom, and not {fmax:g}, "
                    f"after {why}",
                    residual=here.largest,
                    tolerance=fmax,
                    iterations=self.evaluations,
                )
                error.positions = here.x
                raise error
            try:
                with one_thread():
                    step, expected = self._step(here, radius)
                    x = self._moved(here, step)
            except KconsError:  # too far for the rows
                radius /= 4
                continue
            there = self._place(x)
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
        memory = np.array(self._memory[-MEMORY:])
        return Relaxed(here.x, here.energy, here.largest, self.evaluations, memory, self.internals.terms)

    def _step(self, here: _Place, radius: float) -> tuple[FloatArray, float]:
        """Along the rows, the longest move of an atom at most `radius`, shape (columns,); what it is to gain."""
        table = here.table[:, self.columns] @ here.along
        hessian = table.T @ (self.internals.constants[:, None] * table + self._learned(table))
        curvature, modes = np.linalg.eigh(hessian)
        size = np.maximum(np.abs(curvature), FLAT)
        slopes = modes.T @ here.left

        def too_long(shift: float) -> bool:
            return _longest(here.along @ (modes @ (-slopes / (size + shift)))) > radius

        shift = 0.0
        if too_long(shift):
            low, shift = 0.0, float(np.linalg.norm(slopes)) / radius
            for _ in range(30):
                middle = 0.5 * (low + shift)
                low, shift = (middle, shift) if too_long(middle) else (low, middle)
        step = -slopes / (size + shift)
        return here.along @ (modes @ step), float(slopes @ step + 0.5 * step @ (curvature * step))

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
