"""What a check of a trajectory found: plain data for tables, plots and files."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from kcons.constraints.target import FloatArray
from kcons.thermostats.correlated_series import slope


@dataclass(frozen=True)
class Drift:
    """Straight line through one number a frame."""

    slope: float
    error: float
    change: float

    @property
    def significant(self) -> bool:
        """Whether the slope exceeds three times its standard error."""
        return abs(self.slope) > 3 * self.error


def fitted(times: FloatArray, values: FloatArray) -> Drift | None:
    """Least squares of values against times, which may depend on their neighbors; None for fewer than three times."""
    good = np.isfinite(values) & np.isfinite(times)
    t, y = times[good], values[good]
    if len(t) < 3 or not np.ptp(t) > 0:
        return None
    found = slope(t, y)
    return Drift(found.value, found.error, found.value * float(np.ptp(t)))


@dataclass(frozen=True)
class UnitResult:
    """Rows of one natural unit.

    Attributes
    ----------
    unit : str
    n_rows : int
    largest, rms, mean : float
        Over all rows and frames: largest absolute deviation, root mean square, mean.
    bound : float
        What rounding in the file makes of a row that is kept, at most, in the frame and row where it makes most.
    tolerance : float
        What the tolerance allows the shortest row, besides rounding.
    rounding_rms : float
        The root mean square of rounding alone.
    largest_mean : float
        Largest absolute mean of a row over the frames: rounding averages out of it.
    drift : Drift or None
        Of the root mean square, an ps.
    rate_largest, rate_rms : float or None
        Of A v, where velocities are stored.
    """

    unit: str
    n_rows: int
    largest: float
    rms: float
    mean: float
    bound: float
    tolerance: float
    rounding_rms: float
    largest_mean: float
    drift: Drift | None
    rate_largest: float | None = None
    rate_rms: float | None = None


@dataclass(frozen=True)
class RowResult:
    """One of the worst rows.

    Attributes
    ----------
    row : int
    name : str
    atoms : list of int
    unit : str
    target : float
    largest, allowed : float
        Absolute deviation and what was allowed, in the frame where the first exceeds the second most.
    mean : float
        Over the frames.
    frame : int or None
        That frame, where this row exceeded more than the others; None where another did.
    """

    row: int
    name: str
    atoms: list[int]
    unit: str
    target: float
    largest: float
    mean: float
    allowed: float
    frame: int | None


@dataclass(frozen=True)
class Break:
    """Where a trajectory cannot be read any further.

    Attributes
    ----------
    frame : int
        The first frame that cannot be used.
    reason : str
    ends : bool
        Whether the file ends or is damaged there; else it can be read but its numbers are none.
    """

    frame: int
    reason: str
    ends: bool = True

    @property
    def text(self) -> str:
        """For a person."""
        if self.ends:
            return f"the file ends too early, at frame {self.frame}: {self.reason}"
        return f"frame {self.frame} cannot be used, nor what follows: {self.reason}"


@dataclass
class CheckResult:
    """All that a check found.

    Attributes
    ----------
    status : {'kept', 'tolerated', 'violated', 'incomplete'}
        Kept to the precision of the file; kept to the tolerance given; neither; no violation, but not all that was
        asked could be told, see `gaps`.
    verdict : str
        The same in a sentence.
    frames, times : list
        Frames looked at, and their times in ps.
    units : list of UnitResult
    worst : list of RowResult
        Violated rows first, then by their largest deviation.
    series : dict
        Numbers by frame: largest and root mean square deviation, and the largest that rounding makes, for each unit;
        temperature.
    rank, degrees_of_freedom : int or None
        None where the rank could not be found; see `remarks`.
    temperature : dict or None
        Mean, standard deviation and drift in K; None without velocities or masses.
    broken : Break or None
        Where the file ends too early, or is no longer numbers.
    gaps : list of str
        Why the check is no verdict on all that was asked.
    """

    trajectory: str
    topology: str
    n_atoms: int
    n_rows: int
    n_constrained: int
    status: str
    verdict: str
    precision: str
    tolerance: float
    targets: str
    frames: list[int]
    times: list[float]
    n_frames_in_file: int
    units: list[UnitResult]
    worst: list[RowResult]
    violated_rows: int
    violated_frames: int
    first_violated_frame: int | None
    rank: int | None
    degrees_of_freedom: int | None
    temperature: dict[str, float] | None
    broken: Break | None
    series: dict[str, list[float]]
    gaps: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)

    @property
    def violated(self) -> bool:
        return self.status == "violated"

    def to_dict(self) -> dict[str, Any]:
        """Plain data; NaN where a number does not exist."""
        return asdict(self)
