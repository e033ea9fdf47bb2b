"""What windows have found: the mean force of each, and the free energy of all."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from kcons.constraints.target import FloatArray
from kcons.errors import InputError
from kcons.free_energy.averages import agreement
from kcons.free_energy.mean_forces import MeanForce
from kcons.free_energy.profiles.mean_force_surface import Surface, fit_surface
from kcons.free_energy.profiles.profile import Profile, integrate
from kcons.free_energy.windows.window import Sampler
from kcons.thermostats import Estimate

#: Differences of the two sides that are less probable than this are marked, and widen errors.
UNLIKELY = 0.01
#: Windows of a torsion do not go around a gap that is wider than any other by more than this.
_HOLE = 2.001


@dataclass(frozen=True)
class WindowResult:
    """The mean force where one or several coordinates were held, in kJ/mol, angstrom and radian.

    Attributes
    ----------
    number : int
    value, force, error : ndarray, shape (d,)
        The coordinates, dF/dq and its standard error.
    covariance : ndarray, shape (d, d)
        Of the mean force. Where the sides differ by more than chance (p < 0.01), neither knows its own error: half
        their difference is one error more.
    sides : dict of str to MeanForce
        From below and from above.
    hysteresis : float
        Probability of a larger difference between the sides if both were equilibrated; NaN with one side.
    raw : ndarray, shape (d,)
        The plain mean of the multipliers, for comparison.
    seconds : float
        Processor time that its runs took, whichever call made them.
    """

    number: int
    value: FloatArray
    force: FloatArray
    covariance: FloatArray
    sides: dict[str, MeanForce]
    hysteresis: float
    raw: FloatArray
    seconds: float

    @property
    def error(self) -> FloatArray:
        return np.sqrt(np.diagonal(self.covariance))


@dataclass
class FreeEnergy:
    """What became of the windows.

    Attributes
    ----------
    names : tuple of str
    periods : ndarray, shape (d,)
    windows : list of WindowResult
        Those that are finished, in the order of their coordinates.
    failed : dict of str to str
        Windows that failed, and why.
    """

    names: tuple[str, ...]
    periods: FloatArray
    windows: list[WindowResult]
    failed: dict[str, str] = field(default_factory=dict)

    @cached_property
    def profile(self) -> Profile:
        """Free energy along the only coordinate, kJ/mol.

        Raises
        ------
        InputError
            There are several coordinates, or too few windows.
        """
        if len(self.names) != 1:
            raise InputError(f"there are {len(self.names)} coordinates; see surface", item="coordinates")
        f, e = (np.array([getattr(w, name)[0] for w in self.windows]) for name in ("force", "error"))
        x, periods = self._places()
        return integrate(x[:, 0], f, e, period=periods[0])

    @cached_property
    def surface(self) -> Surface:
        """Free energy in all coordinates, kJ/mol.

        Raises
        ------
        InputError
            Too few windows.
        """
        x, periods = self._places()
        f = np.array([w.force for w in self.windows])
        return fit_surface(x, f, np.array([w.covariance for w in self.windows]), periods=periods)

    def between(self, a: float, b: float) -> Estimate | None:
        """F(b) - F(a) of the profile, in whichever turn the places are given; None where it does not reach both."""
        profile, period = self.profile, float(self.periods[0])
        ends = np.array([a, b])
        if period:
            ends += period * np.ceil((profile.x[0] - ends) / period - 1e-9)
        slack = 1e-9 * np.ptp(profile.x)
        if ends.min() < profile.x[0] - slack or ends.max() > profile.x[-1] + slack:
            return None
        return profile.difference(*ends.tolist())

    def _places(self) -> tuple[FloatArray, list[float | None]]:
        """Where the windows are, shape (n, d), and the period of each coordinate that they go all around."""
        x = np.array([w.value for w in self.windows]).reshape(-1, len(self.names))
        around = [self._in_one_turn(column, period) for column, period in zip(x.T, self.periods.tolist(), strict=True)]
        return x, [period if whole else None for whole, period in zip(around, self.periods.tolist(), strict=True)]

    @staticmethod
    def _in_one_turn(x: FloatArray, period: float) -> bool:
        """Put places into one turn, in place, which begins beyond a gap that is far wider than all others.

        Whether they go all around: the gap from the last to the first is no wider than another.
        """
        if not period or not len(x):
            return False
        if np.ptp(x) > period:
            x[:] = x.min() + (x - x.min()) % period
        ordered = np.sort(x)
        gaps = np.append(np.diff(ordered), ordered[0] + period - ordered[-1])
        widest = int(np.argmax(gaps))
        if widest < len(x) - 1 and gaps[widest] > _HOLE * np.delete(gaps, widest).max():
            x[x <= ordered[widest]] += period
            return False
        return bool(gaps[-1] <= gaps[:-1].max(initial=0.0) + 1e-6 * period)

    def numbers(self) -> dict[str, Any]:
        """All of it as plain data."""
        return {
            "names": list(self.names),
            "units": "kJ/mol, angstrom, radian; of formulas and functions their own",
            "windows": [
                {
                    "number": w.number,
                    "value": w.value.tolist(),
                    "mean force": w.force.tolist(),
                    "covariance": w.covariance.tolist(),
                    "raw multiplier": w.raw.tolist(),
                    "hysteresis": w.hysteresis,
                    "samples": sum(side.n for side in w.sides.values()),
                    "independent samples": sum(side.n_effective for side in w.sides.values()),
                }
                for w in self.windows
            ],
            "failed": self.failed,
        }


def together(
    number: int, target: FloatArray, sides: dict[str, MeanForce], sampler: Sampler, seconds: float
) -> WindowResult:
    """The mean of both sides, and how probable their difference is."""
    per = sampler.kJ / sampler.scales
    forces = np.array([side.force * per for side in sides.values()])
    covariances = np.array([side.covariance * np.outer(per, per) for side in sides.values()])
    covariance, chance = covariances.sum(axis=0) / len(sides) ** 2, math.nan
    if len(sides) == 2:
        chance = agreement(forces[0], covariances[0], forces[1], covariances[1]).p_value
        if chance < UNLIKELY:
            half = (forces[0] - forces[1]) / 2
            covariance = covariance + np.outer(half, half)
    raw = np.mean([side.raw * per for side in sides.values()], axis=0)
    return WindowResult(number, target, forces.mean(axis=0), covariance, sides, chance, raw, seconds)
