"""Small clusters: a tensor for each number, and elimination written out, so that one kernel does all of a step."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from kcons.batched.clusters import Clusters, Vector

Matrix = list[list[Any]]


class Lanes(Clusters):
    """See `Clusters`; gradients are lists of numbers by row, matrices lists of rows, None where two share no atom."""

    def unpacked(self, packed: Tensor) -> Vector:
        return list(packed.unbind(0))

    def take(self, vector: Vector, numbers: Any) -> list[Any]:
        return [vector[k] for k in numbers]

    def packed(self, vector: Vector, like: Tensor) -> Tensor:
        lane = like[0]
        return torch.stack([each.expand_as(lane) if isinstance(each, Tensor) else lane * 0 + each for each in vector])

    def couple(self, left: Any, right: Any, weights: Vector) -> Matrix:
        rows = self.pattern.rows[: self.pattern.rank]
        slot = [{a: 3 * i for i, a in enumerate(row.atoms) if a not in self.pattern.fixed} for row in rows]
        heavy = [
            {a: [weights[3 * a] * right[k][i + c] for c in range(3)] for a, i in mine.items()}
            for k, mine in enumerate(slot)
        ]

        def entry(k: int, other: int) -> Any:
            terms = [
                left[k][i + c] * each
                for atom, i in slot[k].items()
                for c, each in enumerate(heavy[other].get(atom, ()))
            ]
            return sum(terms[1:], terms[0]) if terms else None

        return [[entry(k, other) for other in range(len(rows))] for k in range(len(rows))]

    def solve(self, s: Matrix, b: Vector, transposed: bool = False) -> Vector:
        n, b = len(b), list(b)
        s = [[s[j][i] if transposed else s[i][j] for j in range(n)] for i in range(n)]
        for k in range(n):
            s[k][k] = 1.0 / s[k][k]
            for i in range(k + 1, n):
                if s[i][k] is None:
                    continue
                factor = s[i][k] * s[k][k]
                for j in range(k + 1, n):
                    if s[k][j] is not None:
                        s[i][j] = -factor * s[k][j] if s[i][j] is None else s[i][j] - factor * s[k][j]
                b[i] = b[i] - factor * b[k]
        for k in reversed(range(n)):
            for j in range(k + 1, n):
                if s[k][j] is not None:
                    b[k] = b[k] - s[k][j] * b[j]
            b[k] = b[k] * s[k][k]
        return b

    def diagonal(self, s: Matrix) -> Vector:
        return [s[k][k] for k in range(len(s))]

    def spread(self, slope: Any, lam: Vector) -> Vector:
        found: Vector = [0.0] * (3 * self.pattern.n_atoms)
        for row, steep, each in zip(self.pattern.rows, slope, lam, strict=False):
            for i, k in enumerate(3 * atom + c for atom in row.atoms for c in range(3)):
                found[k] = found[k] + steep[i] * each
        return found

    def contract(self, slope: Any, v: Vector) -> Vector:
        return [
            sum(steep[3 * i + c] * v[3 * atom + c] for i, atom in enumerate(row.atoms) for c in range(3))
            for row, steep in zip(self.pattern.rows, slope, strict=True)
        ]
