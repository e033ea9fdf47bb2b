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

#: Differences of the two sides that are less probable than this are marked, and widen errors.
UNLIKELY = 0.01


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
        x, period = self._places()[:, 0], float(self.periods[0]) or None
        spread = np.ptp(x) if len(x) else 0.0
        whole = period is not None and spread + np.diff(np.sort(x)).max(initial=0.0) >= period * (1 - 1e-6)
        return integrate(x, f, e, period=period if whole else None)

    @cached_property
    def surface(self) -> Surface:
        """Free energy in all coordinates, kJ/mol.

        Raises
        ------
        InputError
            Too few windows.
        """
        x, f = self._places(), np.array([w.force for w in self.windows])
        covariances = np.array([w.covariance for w in self.windows])
        return fit_surface(x, f, covariances, periods=[period or None for period in self.periods.tolist()])

    def _places(self) -> FloatArray:
        """Where the windows are, within one period where they are further apart, shape (n, d)."""
        x = np.array([w.value for w in self.windows]).reshape(-1, len(self.names))
        for column, period in zip(x.T, self.periods.tolist(), strict=True):
            if period and len(column) and np.ptp(column) > period:
                column[:] = column.min() + (column - column.min()) % period
        return x

    def numbers(self) -> dict[str, Any]:
        """All of it as plain data."""
        return {
            "names": list(self.names),
            "units": "kJ/mol, angstrom, radian",
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
