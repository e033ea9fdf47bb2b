"""Cheap forces fitted to expensive ones, for several time steps.

The energy is a polynomial of second order in powers of inverse distances. It is linear in its coefficients, so that
they follow from forces by least squares, and the same for atoms that are of one kind.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_array

from kcons.constraints.arguments import check_pairs, numbers
from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.errors import InputError
from kcons.motion.motion import Motion

#: Positions and forces, shape (n_atoms, 3) each.
Frame = tuple[FloatArray, FloatArray]


class FittedForces:
    """Energy and forces from pairs of atoms and pairs of pairs.

    Parameters
    ----------
    pairs : array_like of int, shape (n_pairs, 2)
        Of which distances count; without those that constraints hold.
    exchanges : array_like of int, shape (n_exchanges, n_atoms)
        Orders of the atoms that have the same energy, the given one among them.
    powers : sequence of int
        Of the inverse distances.
    length : float
        A usual distance, by which all are divided.

    Raises
    ------
    InputError
        Pairs that are none; an exchange that takes a pair to what is no pair; powers below 1.
    """

    def __init__(
        self, pairs: ArrayLike, exchanges: ArrayLike, powers: Sequence[int] = (1, 2, 3), length: float = 2.0
    ) -> None:
        self.pairs: IntArray = check_pairs(pairs)
        if not len(powers) or min(powers) < 1:
            raise InputError(f"powers are {tuple(powers)}; give numbers of 1 and more", item="powers")
        self.powers, self.length = np.array(powers, dtype=np.float64), length
        moved = self._moved(np.asarray(exchanges, dtype=np.int64))
        features = (moved[:, :, None] * len(powers) + np.arange(len(powers))).reshape(len(moved), -1)
        count = features.shape[1]
        self._first, self._second = np.triu_indices(count)
        ends = [
            (np.minimum(*both), np.maximum(*both)) for both in ((m[self._first], m[self._second]) for m in features)
        ]
        products = np.min([low * count + high for low, high in ends], axis=0)
        self._kinds = [np.unique(found, return_inverse=True)[1] for found in (features.min(axis=0), products)]
        self._sums = [csr_array((np.ones(len(k)), (k, np.arange(len(k))))) for k in self._kinds]
        self._centre: FloatArray = np.zeros(count)
        self._linear: FloatArray = np.zeros(count)
        self._quadratic: FloatArray = np.zeros((count, count))

    @property
    def coefficients(self) -> int:
        """How many there are to fit."""
        return sum(int(kinds.max()) + 1 for kinds in self._kinds)

    def fit(self, motion: Motion, frames: Sequence[Frame], ridge: float = 1e-7) -> None:
        """Find the coefficients, from what forces do along the constraints in the mass metric.

        Parameters
        ----------
        motion : Motion
        frames : sequence of (positions, forces)
        ridge : float
            Of least squares, relative.

        Raises
        ------
        InputError
            No frames, or one with numbers that are not finite. The coefficients stay what they were.
        """
        if not len(frames):
            raise InputError("there are no frames to fit to", item="frames")
        for k, frame in enumerate(frames):
            if not all(np.isfinite(numbers(part, "frames")).all() for part in frame):
                raise InputError(f"frame {k} has positions or forces that are not finite; leave it out", item="frames")
        self._centre = np.mean([self._features(x)[0] + self._centre for x, _ in frames], axis=0)
        kinds = self._sums[0]  # features of one kind have the same usual value
        self._centre = kinds.T @ ((kinds @ self._centre) / kinds.sum(axis=1))
        count = self.coefficients
        square, target = np.zeros((count, count)), np.zeros(count)
        for x, f in frames:
            seen = along_constraints(motion, x)
            made = seen @ self._design(x)
            square += made.T @ made
            target += made.T @ (seen @ numbers(f, "forces").ravel())
        size = np.sqrt(np.diagonal(square)) + 1e-12
        found = np.linalg.solve(square / np.outer(size, size) + ridge * np.eye(count), target / size) / size
        first = int(self._kinds[0].max()) + 1
        self._linear = found[:first][self._kinds[0]]
        upper = np.zeros_like(self._quadratic)
        upper[self._first, self._second] = found[first:][self._kinds[1]]
        self._quadratic = upper + upper.T

    def evaluate(self, x: FloatArray) -> tuple[float, FloatArray]:
        """Energy, up to a constant, and forces."""
        q, slope, along = self._features(x)
        pushed = self._quadratic @ q
        each = ((self._linear + pushed).reshape(slope.shape) * slope).sum(axis=1)[:, None] * along
        f = np.zeros_like(x)
        np.subtract.at(f, self.pairs[:, 0], each)
        np.add.at(f, self.pairs[:, 1], each)
        return float(self._linear @ q + 0.5 * q @ pushed), f

    def error(self, motion: Motion, frames: Sequence[Frame]) -> float:
        """How far forces along the constraints are off, as a share of their size."""
        off = size = 0.0
        for x, f in frames:
            seen = along_constraints(motion, x)
            off += float(((seen @ (self.evaluate(x)[1] - f).ravel()) ** 2).sum())
            size += float(((seen @ f.ravel()) ** 2).sum())
        return float(np.sqrt(off / size))

    # -- inner ----------------------------------------------------------------------------------

    def _moved(self, exchanges: IntArray) -> IntArray:
        """Where each exchange takes each pair, shape (n_exchanges, n_pairs)."""
        pairs: list[list[int]] = self.pairs.tolist()
        number = {pair: k for k, (i, j) in enumerate(pairs) for pair in ((i, j), (j, i))}
        try:
            return np.array([[number[int(order[i]), int(order[j])] for i, j in pairs] for order in exchanges])
        except KeyError as error:
            raise InputError(
                f"an exchange takes a pair to atoms {error.args[0]}, which are no pair; give all pairs of a kind",
                item="exchanges",
            ) from None

    def _features(self, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Features less their usual values, their slopes over the distances, and unit vectors."""
        apart = x[self.pairs[:, 0]] - x[self.pairs[:, 1]]
        r = np.sqrt((apart * apart).sum(axis=1))[:, None]
        q = (self.length / r) ** self.powers
        return q.ravel() - self._centre, -self.powers * q / r, apart / r

    def _design(self, x: FloatArray) -> FloatArray:
        """Forces for a coefficient of 1 each, shape (3 n_atoms, n_coefficients)."""
        q, slope, along = self._features(x)
        pull = np.zeros((*slope.shape, *x.shape))
        pair = np.arange(len(self.pairs))
        pull[pair, :, self.pairs[:, 0]] = -slope[..., None] * along[:, None]
        pull[pair, :, self.pairs[:, 1]] = slope[..., None] * along[:, None]
        pull = pull.reshape(len(q), -1)
        products = q[self._first, None] * pull[self._second] + q[self._second, None] * pull[self._first]
        return np.vstack([self._sums[0] @ pull, self._sums[1] @ products]).T


def along_constraints(motion: Motion, x: FloatArray) -> FloatArray:
    """Takes forces to what is left of them along the constraints, over the root of the masses; a square matrix."""
    root = np.sqrt(motion.constraint_set.masses)[:, None]
    single = np.eye(x.size).reshape(-1, *x.shape)
    return np.stack([(motion.project_velocities(x, e / root**2) * root).ravel() for e in single], axis=1)
