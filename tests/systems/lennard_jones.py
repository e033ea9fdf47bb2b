"""Periodic fluids of molecules with Lennard-Jones sites and charges, smooth at the cutoff; any consistent units.

Small and compiled: for statistics over millions of steps. Atoms of one molecule do not act on each other.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints.compilation import njit
from kcons.constraints.target import FloatArray
from kcons.errors import InputError

#: Where the potential begins to be switched off, as a share of the cutoff.
SWITCH = 0.7


class LennardJones:
    """Forces and energies of a periodic fluid in a cubic box.

    u(r) = S(r) [4 eps ((sigma/r)^12 - (sigma/r)^6) + q q' (1/r + r^2/(2 c^3) - 3/(2 c))], mixed by Lorentz and
    Berthelot: charges with a conducting reaction field beyond the cutoff c. S falls from 1 to 0 with two continuous
    derivatives.

    Atoms of one molecule follow each other; `charges` are in units in which the energy of two is q q'/r. The cutoff is
    half the box by default, and at most: beyond, minimum images would be wrong.
    """

    def __init__(
        self,
        molecule: ArrayLike,
        box: float,
        *,
        masses: ArrayLike = 1.0,
        epsilon: ArrayLike = 1.0,
        sigma: ArrayLike = 1.0,
        charges: ArrayLike = 0.0,
        cutoff: float | None = None,
    ) -> None:
        self.molecule = np.asarray(molecule, dtype=np.int64)
        n = len(self.molecule)
        if n and (self.molecule[0] != 0 or not np.isin(np.diff(self.molecule), (0, 1)).all()):
            raise InputError(
                "molecules must be numbered 0, 0, ..., 1, 1, ... in the order of the atoms", item="molecule"
            )
        cutoff = 0.5 * box if cutoff is None else cutoff
        if not 0 < cutoff <= 0.5 * box:
            raise InputError(
                f"the cutoff {cutoff:g} must be above 0 and at most half the box, {0.5 * box:g}: beyond that more than "
                "one image is near",
                item="cutoff",
            )
        self.box, self.cutoff = float(box), float(cutoff)
        well, size, charge, mass = (np.broadcast_to(np.asarray(a, float), n) for a in (epsilon, sigma, charges, masses))
        #: eps^(1/2), sigma/2 and q of each atom.
        self.sites: FloatArray = np.ascontiguousarray(np.stack([np.sqrt(well), 0.5 * size, charge], axis=1))
        self.masses: FloatArray = mass.copy()
        self.first = np.append(np.flatnonzero(np.diff(self.molecule, prepend=-1)), n)

    def force(self, x: FloatArray, time: float = 0.0) -> FloatArray:
        """Forces, shape (n_atoms, 3)."""
        return self.evaluate(x)[1]

    def potential(self, x: FloatArray, time: float = 0.0) -> float:
        """Potential energy."""
        return self.evaluate(x)[0]

    def evaluate(self, x: FloatArray) -> tuple[float, FloatArray]:
        """Energy and forces in one pass."""
        f = np.zeros_like(x)
        return float(_evaluate(x, self.molecule, self.sites, self.box, self.cutoff, f)), f

    def metropolis(
        self,
        x: ArrayLike,
        thermal_energy: float,
        sweeps: int,
        every: int,
        seed: int | Sequence[int],
        shift: float,
        turn: float,
    ) -> tuple[FloatArray, FloatArray, float]:
        """Canonical sampling of rigid molecules by Metropolis moves: energies, positions, share of accepted moves.

        Moves are at most `shift` along each axis and `turn` about a random one; energies are recorded each `every`.
        """
        y, rng, n = np.array(x, dtype=np.float64), np.random.default_rng(seed), len(self.first) - 1
        energies = np.empty(sweeps // every)
        draws, axes = (draw((len(energies), every * n, k)) for draw, k in ((rng.random, 6), (rng.standard_normal, 3)))
        molecules = self.first, self.sites, self.box, self.cutoff
        accepted = _metropolis(y, *molecules, thermal_energy, draws, axes, (shift, turn), energies)
        return energies, y, accepted / (every * len(energies) * n)


@njit(cache=True, nogil=True)
def _pair(r2, a, b, cutoff):  # type: ignore[no-untyped-def]
    """u and u'/r of two sites."""
    r = np.sqrt(r2)
    s = a[1] + b[1]
    q = a[2] * b[2]
    c = (s * s / r2) ** 3
    e = 4.0 * a[0] * b[0] * c
    field = 1.0 / cutoff**3
    u = e * (c - 1.0) + q * (1.0 / r + 0.5 * field * r2 - 1.5 / cutoff)
    d = -e * (12.0 * c - 6.0) / r + q * (field * r - 1.0 / r2)
    begin = SWITCH * cutoff
    if r > begin:
        w = 1.0 / (cutoff - begin)
        t = (r - begin) * w
        k = 1.0 - t * t * t * (10.0 - t * (15.0 - 6.0 * t))
        dk = -30.0 * t * t * (1.0 - t) * (1.0 - t) * w
        d = d * k + u * dk
        u = u * k
    return u, d / r


@njit(cache=True, nogil=True)
def _evaluate(x, molecule, sites, box, cutoff, f):  # type: ignore[no-untyped-def]
    total, cut2, inverse = 0.0, cutoff * cutoff, 1.0 / box
    n, d = x.shape[0], np.empty(3)
    for i in range(n):
        for j in range(i + 1, n):
            if molecule[j] == molecule[i]:
                continue
            r2 = 0.0
            for c in range(3):
                d[c] = x[i, c] - x[j, c]
                d[c] -= box * np.rint(d[c] * inverse)
                r2 += d[c] * d[c]
            if r2 < cut2:
                u, slope = _pair(r2, sites[i], sites[j], cutoff)
                total += u
                for c in range(3):
                    f[i, c] -= slope * d[c]
                    f[j, c] += slope * d[c]
    return total


@njit(cache=True, nogil=True)
def _one(y, a, b, x, sites, box, cutoff):  # type: ignore[no-untyped-def]
    """Energy of atoms a..b at y with all others at x."""
    total, cut2, inverse = 0.0, cutoff * cutoff, 1.0 / box
    for i in range(a, b):
        for j in range(x.shape[0]):
            if a <= j < b:
                continue
            r2 = 0.0
            for c in range(3):
                d = y[i - a, c] - x[j, c]
                d -= box * np.rint(d * inverse)
                r2 += d * d
            if r2 < cut2:
                total += _pair(r2, sites[i], sites[j], cutoff)[0]
    return total


@njit(cache=True, nogil=True)
def _propose(y, draw, axis, moves):  # type: ignore[no-untyped-def]
    """Turn a molecule at places y, shape (n, 3), about its center and move it, in place."""
    size = np.sqrt(axis[0] ** 2 + axis[1] ** 2 + axis[2] ** 2)
    angle = moves[1] * (2.0 * draw[0] - 1.0)
    sine, cosine = np.sin(angle), np.cos(angle)
    center, p = np.zeros(3), np.empty(3)
    for i in range(len(y)):
        for c in range(3):
            center[c] += y[i, c] / len(y)
    for i in range(len(y)):
        along = 0.0
        for c in range(3):
            p[c] = y[i, c] - center[c]
            along += p[c] * axis[c] / size**2
        for c in range(3):
            d, e = (c + 1) % 3, (c + 2) % 3
            across = (axis[d] * p[e] - axis[e] * p[d]) / size
            turned = cosine * p[c] + sine * across + (1.0 - cosine) * along * axis[c]
            y[i, c] = center[c] + moves[0] * (2.0 * draw[1 + c] - 1.0) + turned


@njit(cache=True, nogil=True)
def _metropolis(x, first, sites, box, cutoff, kt, draws, axes, moves, energies):  # type: ignore[no-untyped-def]
    molecules, accepted, energy = len(first) - 1, 0, 0.0
    for k in range(molecules):
        energy += 0.5 * _one(x[first[k] : first[k + 1]], first[k], first[k + 1], x, sites, box, cutoff)
    for record in range(len(energies)):
        for trial in range(draws.shape[1]):
            draw = draws[record, trial]
            k = int(draw[4] * molecules)
            a, b = first[k], first[k + 1]
            y = x[a:b].copy()
            _propose(y, draw, axes[record, trial], moves)
            change = _one(y, a, b, x, sites, box, cutoff) - _one(x[a:b], a, b, x, sites, box, cutoff)
            if change <= 0.0 or draw[5] < np.exp(-change / kt):
                x[a:b] = y
                energy += change
                accepted += 1
        energies[record] = energy
    return accepted
