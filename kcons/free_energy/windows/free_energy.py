"""What windows have found: the mean force of each, the free energy of all, and how both are shown."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from kcons.constraints.target import FloatArray
from kcons.errors import InputError
from kcons.free_energy.averages import agreement
from kcons.free_energy.mean_forces import MeanForce
from kcons.free_energy.profiles.mean_force_surface import Surface, fit_surface
from kcons.free_energy.profiles.profile import Profile, integrate
from kcons.free_energy.profiles.pulls import Pulled
from kcons.free_energy.windows.window import Sampler
from kcons.steppers.files import in_one_piece, text
from kcons.thermostats import Estimate
from kcons.thermostats.correlated_series import FEW_INDEPENDENT

if TYPE_CHECKING:
    from rich.table import Table

#: Differences of the two sides that are less probable than this are marked, and widen errors.
UNLIKELY = 0.01
#: Windows of a torsion do not go around a gap that is wider than any other by more than this.
_HOLE = 2.001
#: Of angles, of lengths, and of formulas and functions: as places are shown, and what mean forces are by.
_SHOWN = {True: "degrees", False: "angstrom", None: "own unit"}
_PER = {**_SHOWN, True: "radian"}


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

    @property
    def independent(self) -> float:
        """Independent samples of all sides."""
        return sum(side.n_effective for side in self.sides.values())


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
    angles : tuple of bool or None
        Which coordinates are angles; None where the unit is that of a formula or a function.
    """

    names: tuple[str, ...]
    periods: FloatArray
    windows: list[WindowResult]
    failed: dict[str, str] = field(default_factory=dict)
    angles: tuple[bool | None, ...] = ()

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

    # -- shown ----------------------------------------------------------------------------------

    def _profile(self) -> tuple[Profile | None, str]:
        """The profile along the only coordinate; otherwise None, and where there could be one, why there is none."""
        if len(self.names) != 1:
            return None, ""
        try:
            return self.profile, ""
        except InputError as error:
            return None, f"no profile: {error}"

    def table(self) -> Table:
        """The windows, one in a line; print it by rich."""
        from rich.table import Table

        made = Table(title=f"mean force (kJ/mol by {' or '.join(dict.fromkeys(_PER[angle] for angle in self.angles))})")
        titles = [f"{name} ({_SHOWN[angle]})" for name, angle in zip(self.names, self.angles, strict=True)]
        titles += [f"dF/d {name}" for name in self.names] if len(self.names) > 1 else ["dF/dq"]
        for title in (*titles, "raw multiplier", "independent samples", "hysteresis p"):
            made.add_column(title, justify="right")
        for window in self.windows:
            shown = [np.degrees(q) if angle else q for q, angle in zip(window.value, self.angles, strict=True)]
            mark = "!" if window.hysteresis < UNLIKELY else ""
            made.add_row(
                *(f"{q:.4g}" for q in shown),
                *(f"{f:.2f} ± {e:.2f}" for f, e in zip(window.force, window.error, strict=True)),
                ", ".join(f"{raw:.2f}" for raw in window.raw),
                f"{window.independent:.0f}",
                "" if np.isnan(window.hysteresis) else f"{window.hysteresis:.2g}{mark}",
            )
        return made

    def summary(self) -> str:
        """A sentence or two."""
        lines = [f"{len(self.windows)} windows"]
        if doubtful := ", ".join(str(w.number) for w in self.windows if w.hysteresis < UNLIKELY):
            lines.append(
                f"runs from below and from above differ by more than chance in window {doubtful} (marked !): something "
                "slow is not equilibrated there; sample longer, or look for the other coordinate"
            )
        if poor := ", ".join(str(w.number) for w in self.windows if w.independent < FEW_INDEPENDENT):
            lines.append(
                f"fewer than {FEW_INDEPENDENT} independent samples in window {poor}: errors there are not to be relied "
                "on; sample longer"
            )
        profile, why = self._profile()
        if why:
            lines.append(why)
        if profile is not None:
            low, high = int(np.argmin(profile.F)), int(np.argmax(profile.F))
            gap = profile.difference(float(profile.x[low]), float(profile.x[high]))
            lines.append(f"from the lowest to the highest point {gap.value:.2f} ± {gap.error:.2f} kJ/mol")
        lines += [f"{name} failed: {why}" for name, why in self.failed.items()]
        return "\n".join(lines)

    def beside(self, pulled: Pulled, start: FloatArray, end: FloatArray) -> tuple[dict[str, Any], str]:
        """What pulls gave, as plain data and in a sentence; of one coordinate with the windows between the ends."""
        best, name = pulled.best, "Jarzynski" if pulled.bar is None else "BAR"
        numbers: dict[str, Any] = {"from": start.tolist(), "to": end.tolist()}
        estimates = {key: getattr(pulled, key) for key in ("bar", "jarzynski", "jarzynski_backward")}
        numbers |= {key: [*estimate] for key, estimate in estimates.items() if estimate is not None}
        numbers |= {"dissipated": pulled.dissipated, "overlap": pulled.overlap}
        said = f"pulls give {best.value:.2f} ± {best.error:.2f} kJ/mol ({name}; {pulled.dissipated:.2g} kJ/mol lost)"
        if self._profile()[0] is not None:
            windows = self.between(float(start[0]), float(end[0]))
            if windows is None:
                return numbers, f"{said}; the windows do not reach both ends"
            numbers["windows"] = [*windows]
            away = (best.value - windows.value) / math.hypot(best.error, windows.error)
            said += f", windows {windows.value:.2f} ± {windows.error:.2f}: {away:+.1f} standard errors"
        return numbers, said

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
                    "independent samples": w.independent,
                }
                for w in self.windows
            ],
            "failed": self.failed,
        }

    def write(self, folder: Path) -> list[Path]:
        """free_energy.json, and for one coordinate profile.csv and profile.png; returns their paths."""
        written = [folder / "free_energy.json"]
        with in_one_piece(written[0]) as opened:
            opened.write(text(self.numbers()).encode())
        profile, _ = self._profile()
        if profile is not None:
            from kcons.free_energy.profiles.plots import plot_profile

            (name,), (angle,) = self.names, self.angles
            written += [folder / "profile.csv", folder / "profile.png"]
            with in_one_piece(written[1]) as opened:
                opened.write(f"{name} ({_PER[angle]}),F (kJ/mol),error (kJ/mol)\n".encode())
                np.savetxt(opened, np.column_stack([profile.x, profile.F, profile.error]), fmt="%.8g", delimiter=",")
            with in_one_piece(written[2]) as opened:
                figure = plot_profile(profile, coordinate=f"{name} / {_PER[angle]}", energy="(kJ/mol)")
                figure.savefig(opened, dpi=150, format="png")
        return written


def combine_sides(
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
