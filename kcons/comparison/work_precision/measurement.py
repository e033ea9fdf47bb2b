"""What a comparison found, as plain data that goes to files and comes back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal

import numpy as np

Status = Literal["ok", "baseline", "thermostat", "partial", "failed", "not run"]


@dataclass(frozen=True)
class Measurement:
    """One method at one time step (or tolerance). Times in seconds unless said; None where not known.

    Attributes
    ----------
    setting : float
        Time step in the test system's shown unit, or relative tolerance of an adaptive method.
    status : {'ok', 'baseline', 'thermostat', 'partial', 'failed', 'not run'}
        'baseline': nothing is held, only the cost is stated. 'thermostat': the trajectory is not to be that of the
        reference, so that there is no error. 'partial': stopped for the budget; cost only.
    error : float
        Root-mean-square distance an atom from the reference at the horizon.
    constraint_residual, velocity_residual : float
        max |sigma| in natural units, and max |A v|/v_rms with rows of unit norm, after the last step.
    energy_slope, energy_slope_error : float
        Linear fit of the total energy against time and its standard error, a degree of freedom and `long_time`.
    step_seconds, constraint_seconds : float
        Median wall time of a step, and of the constraints' part of it where an MD engine tells.
    setup_seconds : float
        Before the first step, and what the first step took beyond the others.
    evaluations_per_time, seconds_per_time : float
        Force evaluations and wall time a simulated `long_time` (1 ps for molecules).
    """

    method: str
    title: str
    setting: float
    adaptive: bool
    status: Status
    note: str = ""
    steps: int = 0
    steps_planned: int | None = None
    error: float | None = None
    constraint_residual: float | None = None
    velocity_residual: float | None = None
    energy_slope: float | None = None
    energy_slope_error: float | None = None
    step_seconds: float | None = None
    constraint_seconds: float | None = None
    setup_seconds: float | None = None
    evaluations_per_time: float | None = None
    seconds_per_time: float | None = None


@dataclass(frozen=True)
class Comparison:
    """All that `kcons compare` found.

    Attributes
    ----------
    scene : mapping
        Name, title, sizes, horizon, units.
    reference : mapping
        How the reference was obtained and how good it is.
    settings : mapping
        What was asked for.
    environment : mapping
        Machine, versions, commit, date.
    measurements : list of Measurement
    remarks : list of str
        What a reader should know of the methods that ran.
    timing : mapping
        'force_seconds', what the forces take once beyond the least that a call from Python takes; 'repeats', how many
        rounds of short runs were timed at least; 'margin', by what fraction the medians of odd and of even rounds
        differed at most, for nine tenths of them.
    recommendation : mapping or None
        What `kcons.comparison.work_precision.recommendation` found for an error that was asked for.
    """

    scene: Mapping[str, Any]
    reference: Mapping[str, Any]
    settings: Mapping[str, Any]
    environment: Mapping[str, Any]
    measurements: Sequence[Measurement] = field(default_factory=list)
    remarks: Sequence[str] = ()
    timing: Mapping[str, Any] = field(default_factory=dict)
    recommendation: Mapping[str, Any] | None = None

    @property
    def error_unit(self) -> str:
        """That of errors: of lengths, or of energies where the error is one."""
        return str(self.scene["units"]["energy" if "error" in self.scene else "length"])

    def of(self, method: str, status: Status = "ok") -> list[Measurement]:
        """Measurements of one method, coarsest first."""
        return [m for m in self.measurements if m.method == method and m.status == status]

    def observed_order(self, method: str) -> float | None:
        """Slope of log(error) against log(time step) at the two finest steps whose error is above the reference's.

        None with fewer than two such steps, and where the error is no distance from a trajectory. Coarser steps are
        left out: high orders show at small steps only.
        """
        if "error" in self.scene:
            return None
        least = max(5 * float(self.reference["error"]), 1e-12)
        used = [m for m in self.of(method) if not m.adaptive and m.error is not None and m.error > least]
        if len(used) < 2:
            return None
        steps, errors = np.log([(m.setting, float(m.error or 0)) for m in used[-2:]]).T
        return float((errors[1] - errors[0]) / (steps[1] - steps[0]))

    def to_dict(self) -> dict[str, Any]:
        """Plain data, as it goes to JSON."""
        orders = {name: self.observed_order(name) for name in dict.fromkeys(m.method for m in self.measurements)}
        found = {
            "format": "kcons-compare-1",
            "scene": dict(self.scene),
            "reference": dict(self.reference),
            "settings": dict(self.settings),
            "environment": dict(self.environment),
            "remarks": list(self.remarks),
            "timing": dict(self.timing),
            "observed_order": {name: order for name, order in orders.items() if order is not None},
            "measurements": [asdict(m) for m in self.measurements],
        }
        return found if self.recommendation is None else {**found, "recommendation": dict(self.recommendation)}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Comparison:
        """What `to_dict` wrote; entries that are missing are None, unknown ones are left out.

        Older files say 'floor' where 'baseline' stands now; both are read.
        """
        known = {f.name for f in fields(Measurement)}
        measurements = [
            Measurement(**{k: v for k, v in _named_as_now(m).items() if k in known}) for m in data["measurements"]
        ]
        parts = {f.name: data[f.name] for f in fields(cls) if f.name in data and f.name != "measurements"}
        return cls(**parts, measurements=measurements)


def _named_as_now(entry: Mapping[str, Any]) -> Mapping[str, Any]:
    """A measurement from a file, with the words of this version."""
    if entry["status"] != "floor":
        return entry
    return {**entry, "status": "baseline", "title": entry["title"].replace("floor: ", "baseline: ", 1)}
