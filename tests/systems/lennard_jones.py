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
    """Forces, energies and curvatures of a periodic fluid in a cubic box.

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
        table = [np.broadcast_to(np.asarray(a, dtype=np.float64), n) for a in (epsilon, sigma, charges, masses)]
        #: eps^(1/2), sigma/2, q and m of each atom.
        self.sites: FloatArray = np.ascontiguousarray(
            np.stack([np.sqrt(table[0]), 0.5 * table[1], table[2], table[3]], axis=1)
        )
        self.masses: FloatArray = table[3].copy()
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

    def split_sample(self, x: FloatArray) -> tuple[float, float, float, float]:
        """|grad U|^2 and laplacian of U in the shifts of whole molecules, and both in their turns (per radian)."""
        found = _rigid(x, self.molecule, self.first, self.sites, self.box, self.cutoff)
        return (float(found[0]), float(found[1]), float(found[2]), float(found[3]))

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
        y = np.array(x, dtype=np.float64)
        energies, rng = np.empty(sweeps // every), np.random.default_rng(seed)
        common = self.first, self.sites, self.box, np.array([self.cutoff]), thermal_energy, every, rng
        accepted = _metropolis(y, *common, (shift, turn), energies)
        return energies, y, accepted / (every * len(energies) * (len(self.first) - 1))


@njit(cache=True, nogil=True)
def _pair(r2, a, b, cutoff, end):  # type: ignore[no-untyped-def]
    """u, u'/r and u'' of two sites, switched off at `end`."""
    r = np.sqrt(r2)
    s = a[1] + b[1]
    q = a[2] * b[2]
    c = (s * s / r2) ** 3
    e = 4.0 * a[0] * b[0] * c
    field = 1.0 / cutoff**3
    u = e * (c - 1.0) + q * (1.0 / r + 0.5 * field * r2 - 1.5 / cutoff)
    d = -e * (12.0 * c - 6.0) / r + q * (field * r - 1.0 / r2)
    dd = e * (156.0 * c - 42.0) / r2 + q * (2.0 / (r2 * r) + field)
    begin = SWITCH * end
    if r > begin:
        w = 1.0 / (end - begin)
        t = (r - begin) * w
        k = 1.0 - t * t * t * (10.0 - t * (15.0 - 6.0 * t))
        dk = -30.0 * t * t * (1.0 - t) * (1.0 - t) * w
        ddk = -60.0 * t * (1.0 - t) * (1.0 - 2.0 * t) * w * w
        dd = dd * k + 2.0 * d * dk + u * ddk
        d = d * k + u * dk
        u = u * k
    return u, d / r, dd


@njit(cache=True, nogil=True)
def _line(x, i, j, box, inverse):  # type: ignore[no-untyped-def]
    """From j to i, to the nearest image, and the square of its length."""
    dx, dy, dz = x[i, 0] - x[j, 0], x[i, 1] - x[j, 1], x[i, 2] - x[j, 2]
    dx -= box * np.rint(dx * inverse)
    dy -= box * np.rint(dy * inverse)
    dz -= box * np.rint(dz * inverse)
    return dx, dy, dz, dx * dx + dy * dy + dz * dz


@njit(cache=True, nogil=True)
def _push(f, i, j, fx, fy, fz):  # type: ignore[no-untyped-def]
    f[i, 0] -= fx
    f[i, 1] -= fy
    f[i, 2] -= fz
    f[j, 0] += fx
    f[j, 1] += fy
    f[j, 2] += fz


@njit(cache=True, nogil=True)
def _evaluate(x, molecule, sites, box, cutoff, f):  # type: ignore[no-untyped-def]
    total, cut2, inverse = 0.0, cutoff * cutoff, 1.0 / box
    n = x.shape[0]
    for i in range(n):
        for j in range(i + 1, n):
            if molecule[j] == molecule[i]:
                continue
            dx, dy, dz, r2 = _line(x, i, j, box, inverse)
            if r2 < cut2:
                u, slope, _ = _pair(r2, sites[i], sites[j], cutoff, cutoff)
                total += u
                _push(f, i, j, slope * dx, slope * dy, slope * dz)
    return total


@njit(cache=True, nogil=True)
def _rigid(x, molecule, first, sites, box, cutoff):  # type: ignore[no-untyped-def]
    """Squares of forces, laplacian over shifts, squares of torques, laplacian over turns; summed over molecules.

    A turn about the axis e moves a site at p from the center by e x p, and bends its path by e x (e x p). Summed over
    three axes, the first gives |e x p|^2 -> |p x d|^2 along the line d of a pair and 2 p^2 in all, the second -2 p.
    """
    n, cut2, inverse = x.shape[0], cutoff * cutoff, 1.0 / box
    f, p = np.zeros_like(x), np.empty_like(x)
    for k in range(len(first) - 1):
        for c in range(3):
            mass = center = 0.0
            for i in range(first[k], first[k + 1]):
                mass += sites[i, 3]
                center += sites[i, 3] * x[i, c]
            for i in range(first[k], first[k + 1]):
                p[i, c] = x[i, c] - center / mass
    shifts = turns = 0.0
    for i in range(n):
        for j in range(i + 1, n):
            if molecule[j] == molecule[i]:
                continue
            dx, dy, dz, r2 = _line(x, i, j, box, inverse)
            if r2 < cut2:
                _, slope, bend = _pair(r2, sites[i], sites[j], cutoff, cutoff)
                _push(f, i, j, slope * dx, slope * dy, slope * dz)
                shifts += 2.0 * (bend + 2.0 * slope)
                for k in (i, j):
                    p2 = p[k, 0] ** 2 + p[k, 1] ** 2 + p[k, 2] ** 2
                    along = p[k, 0] * dx + p[k, 1] * dy + p[k, 2] * dz
                    across = p2 - along * along / r2  # |p x d|^2 / d^2
                    turns += (bend - slope) * across + slope * 2.0 * p2
    squares = torques = 0.0
    for k in range(len(first) - 1):
        fx = fy = fz = tx = ty = tz = 0.0
        for i in range(first[k], first[k + 1]):
            fx += f[i, 0]
            fy += f[i, 1]
            fz += f[i, 2]
            tx += p[i, 1] * f[i, 2] - p[i, 2] * f[i, 1]
            ty += p[i, 2] * f[i, 0] - p[i, 0] * f[i, 2]
            tz += p[i, 0] * f[i, 1] - p[i, 1] * f[i, 0]
            # grad U = -f, bent by -2 p
            turns += 2.0 * (f[i, 0] * p[i, 0] + f[i, 1] * p[i, 1] + f[i, 2] * p[i, 2])
        squares += fx * fx + fy * fy + fz * fz
        torques += tx * tx + ty * ty + tz * tz
    return squares, shifts, torques, turns


@njit(cache=True, nogil=True)
def _one(y, a, b, x, first, sites, box, reach):  # type: ignore[no-untyped-def]
    """Energy of atoms a..b at y with all others at x."""
    cutoff = reach[0]
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
                total += _pair(r2, sites[i], sites[j], cutoff, cutoff)[0]
    return total


@njit(cache=True, nogil=True)
def _proposed(y, moves, rng):  # type: ignore[no-untyped-def]
    """A molecule at places y, turned about its center and moved, in place; shape (n, 3)."""
    center = np.zeros(3)
    for i in range(len(y)):
        center += y[i] / len(y)
    axis = rng.normal(0.0, 1.0, 3)
    axis /= np.sqrt((axis * axis).sum())
    angle = moves[1] * (2.0 * rng.random() - 1.0)
    sine, cosine = np.sin(angle), np.cos(angle)
    move = moves[0] * (2.0 * rng.random(3) - 1.0)
    for i in range(len(y)):
        p = y[i] - center
        y[i] = center + move + cosine * p + sine * np.cross(axis, p) + (1.0 - cosine) * (axis * p).sum() * axis


# That of near molecules is written out beside it: what takes a function as an argument is compiled by every process.
@njit(cache=True, nogil=True)
def _metropolis(x, first, sites, box, cutoff, kt, every, rng, moves, energies):  # type: ignore[no-untyped-def]
    molecules = len(first) - 1
    energy = 0.0
    for k in range(molecules):
        energy += 0.5 * _one(x[first[k] : first[k + 1]], first[k], first[k + 1], x, first, sites, box, cutoff)
    accepted = 0
    for record in range(len(energies)):
        for _ in range(every * molecules):
            k = int(rng.random() * molecules)
            a, b = first[k], first[k + 1]
            y = x[a:b].copy()
            _proposed(y, moves, rng)
            change = _one(y, a, b, x, first, sites, box, cutoff)
            change -= _one(x[a:b], a, b, x, first, sites, box, cutoff)
            if change <= 0.0 or rng.random() < np.exp(-change / kt):
                x[a:b] = y
                energy += change
                accepted += 1
        energies[record] = energy
    return accepted
