"""Fluids whose molecules are switched off as wholes, by the distance of their first atoms.

Charges that are switched off atom by atom leave forces at the cutoff as stiff as those of a hydrogen bond. Those of
whole molecules are soft: a short reach is a cheap force for several time steps, and what a long one adds is slow.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from kcons.comparison.test_systems.lennard_jones import LennardJones, _pair, _proposed, _push
from kcons.constraints.compilation import njit
from kcons.constraints.target import FloatArray
from kcons.errors import InputError

#: Where pairs begin to be switched off, as a share of where they are gone.
BEGIN = 2 / 3


class NearMolecules:
    """Pairs of molecules whose first atoms are closer than `reach`, switched off smoothly.

    Parameters
    ----------
    forces : LennardJones
        Of pairs; its cutoff is that of the reaction field only.
    reach : float
        Distance of first atoms from which on a pair counts no more; it counts in full up to two thirds of that. Longer
        than molecules that touch are apart, or their far ends would meet unseen.

    Raises
    ------
    InputError
        A reach that is not positive, or beyond half the box.
    """

    def __init__(self, forces: LennardJones, reach: float) -> None:
        if not 0 < reach <= 0.5 * forces.box:
            raise InputError(
                f"molecules reach {reach:g}; give a number above 0 and at most half the box, {0.5 * forces.box:.4g}",
                item="reach",
            )
        self.forces, self.reach = forces, float(reach)

    def evaluate(self, x: FloatArray) -> tuple[float, FloatArray]:
        """Energy and forces."""
        f, of = np.zeros_like(x), self.forces
        return float(_near(x, of.first, of.sites, of.box, of.cutoff, BEGIN * self.reach, self.reach, f)), f

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
        """As `LennardJones.metropolis`."""
        y, of = np.array(x, dtype=np.float64), self.forces
        energies, rng = np.empty(sweeps // every), np.random.default_rng(seed)
        reach = np.array([of.cutoff, BEGIN * self.reach, self.reach])
        common = of.first, of.sites, of.box, reach, thermal_energy, every, rng
        accepted = _near_metropolis(y, *common, (shift, turn), energies)
        return energies, y, accepted / (every * len(energies) * (len(of.first) - 1))


@njit(cache=True, nogil=True)
def _image(d, box, inverse):  # type: ignore[no-untyped-def]
    """What takes a difference to its nearest image."""
    return -box * np.rint(d * inverse)


@njit(cache=True, nogil=True)
def _share(apart, begin, end):  # type: ignore[no-untyped-def]
    """How much a pair counts, and the slope of that over the distance."""
    if apart <= begin:
        return 1.0, 0.0
    w = 1.0 / (end - begin)
    t = (apart - begin) * w
    return 1.0 - t * t * t * (10.0 - t * (15.0 - 6.0 * t)), -30.0 * t * t * (1.0 - t) * (1.0 - t) * w / apart


@njit(cache=True, nogil=True)
def _near(x, first, sites, box, cutoff, begin, end, f):  # type: ignore[no-untyped-def]
    total, inverse = 0.0, 1.0 / box
    for a in range(len(first) - 1):
        for b in range(a + 1, len(first) - 1):
            p, q = first[a], first[b]
            ox, oy, oz = x[p, 0] - x[q, 0], x[p, 1] - x[q, 1], x[p, 2] - x[q, 2]
            sx, sy, sz = _image(ox, box, inverse), _image(oy, box, inverse), _image(oz, box, inverse)
            ox, oy, oz = ox + sx, oy + sy, oz + sz
            o2 = ox * ox + oy * oy + oz * oz
            if o2 >= end * end:
                continue
            share, steep = _share(np.sqrt(o2), begin, end)
            energy = 0.0
            for i in range(p, first[a + 1]):
                for j in range(q, first[b + 1]):
                    dx, dy, dz = x[i, 0] - x[j, 0] + sx, x[i, 1] - x[j, 1] + sy, x[i, 2] - x[j, 2] + sz
                    u, slope, _ = _pair(dx * dx + dy * dy + dz * dz, sites[i], sites[j], cutoff, 2.0 * cutoff)
                    energy += u
                    slope *= share
                    _push(f, i, j, slope * dx, slope * dy, slope * dz)
            total += share * energy
            if steep != 0.0:
                steep *= energy
                _push(f, p, q, steep * ox, steep * oy, steep * oz)
    return total


@njit(cache=True, nogil=True)
def _one_molecule(y, a, b, x, first, sites, box, reach):  # type: ignore[no-untyped-def]
    """Energy of the molecule of atoms a..b at y with all others at x."""
    cutoff, begin, end = reach[0], reach[1], reach[2]
    total, inverse = 0.0, 1.0 / box
    for m in range(len(first) - 1):
        q = first[m]
        if q == a:
            continue
        ox, oy, oz = y[0, 0] - x[q, 0], y[0, 1] - x[q, 1], y[0, 2] - x[q, 2]
        sx, sy, sz = _image(ox, box, inverse), _image(oy, box, inverse), _image(oz, box, inverse)
        o2 = (ox + sx) ** 2 + (oy + sy) ** 2 + (oz + sz) ** 2
        if o2 >= end * end:
            continue
        share, _ = _share(np.sqrt(o2), begin, end)
        energy = 0.0
        for i in range(a, b):
            for j in range(q, first[m + 1]):
                dx, dy, dz = y[i - a, 0] - x[j, 0] + sx, y[i - a, 1] - x[j, 1] + sy, y[i - a, 2] - x[j, 2] + sz
                energy += _pair(dx * dx + dy * dy + dz * dz, sites[i], sites[j], cutoff, 2.0 * cutoff)[0]
        total += share * energy
    return total


@njit(cache=True, nogil=True)
def _near_metropolis(x, first, sites, box, reach, kt, every, rng, moves, energies):  # type: ignore[no-untyped-def]
    molecules = len(first) - 1
    energy = 0.0
    for k in range(molecules):
        energy += 0.5 * _one_molecule(x[first[k] : first[k + 1]], first[k], first[k + 1], x, first, sites, box, reach)
    accepted = 0
    for record in range(len(energies)):
        for _ in range(every * molecules):
            k = int(rng.random() * molecules)
            a, b = first[k], first[k + 1]
            y = x[a:b].copy()
            _proposed(y, moves, rng)
            change = _one_molecule(y, a, b, x, first, sites, box, reach)
            change -= _one_molecule(x[a:b], a, b, x, first, sites, box, reach)
            if change <= 0.0 or rng.random() < np.exp(-change / kt):
                x[a:b] = y
                energy += change
                accepted += 1
        energies[record] = energy
    return accepted
