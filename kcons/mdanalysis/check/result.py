"""What a check of a trajectory says: plain data for tables, plots and files, from what was found in its frames."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kcons.constraints.target import FloatArray
from kcons.mdanalysis.check.deviations import UNITS, Found, RowTable
from kcons.mdanalysis.check.endings import Break
from kcons.mdanalysis.check.targets import label
from kcons.thermostats import Estimate
from kcons.thermostats.correlated_series import slope
from kcons.topology.topology import Topology

#: Boltzmann's constant in amu Å²/(ps² K).
BOLTZMANN = 0.831446261815324
#: Part of its thermal energy that a motion of the whole, of its center or a turn, may have where it is removed.
STILL = 1e-2


def fitted(times: FloatArray, values: FloatArray) -> Estimate | None:
    """Slope of values, which may depend on their neighbors, against times; None for fewer than three times."""
    good = np.isfinite(values) & np.isfinite(times)
    t, y = times[good], values[good]
    return slope(t, y) if len(t) > 2 and np.ptp(t) > 0 else None


@dataclass(frozen=True)
class UnitResult:
    """All rows of one natural unit, over all frames."""

    unit: str
    n_rows: int
    #: Largest absolute deviation, root mean square, mean.
    largest: float
    rms: float
    mean: float
    #: What rounding in the file makes of a row that is kept, at most, in the frame and row where it makes most.
    bound: float
    #: What the tolerance allows the shortest row, besides rounding.
    tolerance: float
    #: The root mean square of rounding alone.
    rounding_rms: float
    #: Largest absolute mean of a row over the frames: rounding averages out of it.
    largest_mean: float
    #: Slope of the root mean square, a ps, and its standard error; None for fewer than three times.
    drift: float | None
    drift_error: float | None
    #: Of A v, where velocities are stored.
    rate_largest: float | None = None
    rate_rms: float | None = None


@dataclass(frozen=True)
class RowResult:
    """One of the worst rows."""

    row: int
    name: str
    atoms: list[int]
    unit: str
    target: float
    #: Mean over the frames; absolute deviation, and what was allowed, in the frame where it exceeds this most.
    mean: float
    largest: float
    allowed: float
    #: That frame; None where nothing could be told in any.
    frame: int | None


@dataclass
class CheckResult:
    """All that a check found."""

    #: What to call the files.
    trajectory: str
    topology: str
    n_atoms: int
    n_rows: int
    n_constrained: int
    #: 'kept' to the precision of the file; 'tolerated': kept to the tolerance given; 'violated': neither; 'incomplete':
    #: no violation, but not all that was asked could be told, see `gaps`.
    status: str
    precision: str
    tolerance: float
    targets: str
    #: Frames looked at, and their times in ps.
    frames: list[int]
    times: list[float]
    n_frames_in_file: int
    units: list[UnitResult]
    #: Violated rows first, then by their largest deviation.
    worst: list[RowResult]
    violated_rows: int
    violated_frames: int
    first_violated_frame: int | None
    #: None where the rank could not be found; degrees of freedom also where a selection was looked at; see `remarks`.
    rank: int | None
    degrees_of_freedom: int | None
    #: Mean, standard deviation and drift in K; None without velocities, masses or degrees of freedom.
    temperature: dict[str, float] | None
    #: Where the file ends too early, or is no longer numbers.
    broken: Break | None
    #: By frame: largest and root mean square deviation and the largest that rounding makes, by unit; temperature.
    series: dict[str, list[float]]
    #: Why the check is no verdict on all that was asked.
    gaps: list[str]
    remarks: list[str]
    #: The status in a sentence.
    verdict: str = field(init=False)

    def __post_init__(self) -> None:
        most = ", ".join(f"{unit.largest:.2g} {unit.unit} (rounding: up to {unit.bound:.2g})" for unit in self.units)
        row, n_frames = self.worst[0], len(self.frames)
        self.verdict = {
            "kept": f"kept to the precision of the file: largest deviation {most}",
            "tolerated": f"kept to the tolerance of {self.tolerance:g}: largest deviation {most}",
            "incomplete": f"incomplete: {'; '.join(self.gaps)}; no violation otherwise in {n_frames} frames: largest "
            f"deviation {most}",
            "violated": f"violated by {row.largest:.3g} {row.unit} ({row.largest - row.allowed:.2g} more than allowed)"
            f": {row.name} in frame {row.frame}; {self.violated_rows} of {self.n_rows} rows; {self.violated_frames} "
            f"of {n_frames} frames, from frame {self.first_violated_frame}",
        }[self.status]

    @property
    def violated(self) -> bool:
        return self.status == "violated"

    def to_dict(self) -> dict[str, Any]:
        """Plain data; NaN where a number does not exist."""
        return asdict(self)


@dataclass
class Asked:
    """What a check was asked for."""

    #: What to call trajectory and topology.
    names: tuple[str, str]
    topology: Topology
    #: Where targets come from, 'given', 'first' or 'mean', and the same in words.
    mode: str
    targets: str
    #: Number of rows to name.
    worst: int
    #: What there is to say besides, and what is known beforehand to be missing.
    remarks: list[str]
    gaps: list[str] = field(default_factory=list)
    #: Whether rows were looked for within a selection only.
    part: bool = False


def result_of(
    found: Found, table: RowTable, asked: Asked, precision: str, rank: int | None, n_in_file: int
) -> CheckResult:
    """All that there is to say of what was found, of a file of `n_in_file` frames and of a `precision` in words."""
    margins, held, numbers = found.rows["margin"], table.set, found.frames["frame"]
    times, remarks = np.array(found.frames["time"]), list(asked.remarks)
    violated = margins > 0
    order = np.lexsort((-np.where(violated, margins, found.rows["largest"]), ~violated))
    # Targets that are nothing but rounding.
    untold = table.measured & (table.of_targets > table.sizes)
    gaps = asked.gaps + _gaps(found, table, untold, asked.targets)
    units = [_unit(table, found, unit, untold, asked.mode) for unit in range(len(UNITS)) if (table.units == unit).any()]
    bare = int((found.frames["turning"] != np.inf).sum())
    if bare and (violated & (table.units == 0) & (found.rows["largest"] > table.sizes)).any():
        some = "" if bare == len(numbers) else f"{bare} of {len(numbers)} "
        remarks.append(
            f"lengths are off by more than themselves, and {some}frames of {asked.names[0]} have no cell: molecules "
            "cut by a face of one look like this. Give a format that has the cell (not XYZ), or whole molecules"
        )
    if alone := _first_alone(table, found):
        remarks.append(alone)
    frames = numbers[(found.units["violated"] > 0).any(axis=1)]
    status = "tolerated" if (margins + table.tolerance * table.sizes > 0).any() else "kept"
    status = "violated" if violated.any() else "incomplete" if gaps else status
    columns = (("largest", found.units["largest"]), ("rms", found.rms), ("rounding", found.units["rounding"]))
    of_unit = [(unit.unit, UNITS.index(unit.unit)) for unit in units]
    series = {f"{name} {unit}": values[:, k].tolist() for unit, k in of_unit for name, values in columns}
    freedom, temperature = None, None
    if asked.part:
        remarks.append("no temperature: what holds atoms outside of the selection was not looked for")
    elif rank is not None:
        freedom, kelvin = _temperatures(found, rank, held.masses, remarks)
        if kelvin is not None:
            series["temperature K"] = kelvin.tolist()
            line = fitted(times, kelvin) or Estimate(np.nan, np.nan)
            temperature = {"mean": float(np.nanmean(kelvin)), "deviation": float(np.nanstd(kelvin))}
            temperature |= {"frames": float(np.isfinite(kelvin).sum()), "slope": line.value, "slope_error": line.error}
    return CheckResult(
        trajectory=asked.names[0],
        topology=asked.names[1],
        n_atoms=held.n_atoms,
        n_rows=held.n_rows,
        n_constrained=len(held.touched),
        status=status,
        precision=precision,
        tolerance=table.tolerance,
        targets=asked.targets,
        frames=numbers.tolist(),
        times=times.tolist(),
        n_frames_in_file=n_in_file,
        units=units,
        worst=[_row(table, asked.topology, found, int(row)) for row in order[: asked.worst]],
        violated_rows=int(violated.sum()),
        violated_frames=len(frames),
        first_violated_frame=int(frames[0]) if len(frames) else None,
        rank=rank,
        degrees_of_freedom=freedom,
        temperature=temperature,
        broken=found.broken,
        series=series,
        gaps=gaps,
        remarks=remarks,
    )


def _unit(table: RowTable, found: Found, unit: int, untold: NDArray[np.bool_], mode: str) -> UnitResult:
    """All rows of a unit together."""
    mine, seen = table.units == unit, found.units[:, unit]
    n, n_seen = int(mine.sum()), max(float(seen["seen"].sum()), 1.0)
    # The rounding of a mean averages out.
    of_targets = table.of_targets if mode != "mean" else np.where(table.measured, 0.0, table.of_targets)
    rounding = (table.spread * np.hypot(found.mean("rounded"), of_targets))[mine]
    rates = seen[np.isfinite(seen["rate_squares"])]
    line = fitted(np.array(found.frames["time"]), found.rms[:, unit])
    return UnitResult(
        unit=UNITS[unit],
        n_rows=n,
        largest=float(seen["largest"].max()),
        rms=float(np.sqrt(seen["squares"].sum() / n_seen)),
        mean=float(seen["sum"].sum() / n_seen),
        bound=float(seen["rounding"].max() + np.where(untold, 0.0, table.of_targets)[mine].max()),
        tolerance=float(table.tolerance * table.sizes[mine].min()),
        rounding_rms=float(np.sqrt(np.mean(rounding**2))),
        largest_mean=float(np.abs(found.mean("total"))[mine].max()),
        drift=None if line is None else line.value,
        drift_error=None if line is None else line.error,
        rate_largest=float(rates["rate"].max()) if len(rates) else None,
        rate_rms=float(np.sqrt(rates["rate_squares"].mean() / n)) if len(rates) else None,
    )


def _row(table: RowTable, topology: Topology, found: Found, row: int) -> RowResult:
    """One row, by name."""
    item, k = table.set.locate(row)
    mine, atoms = found.rows[row], item.atoms[k]
    return RowResult(
        row=row,
        name=f"{item.family} {label(topology, atoms.tolist())}",
        atoms=[int(a) for a in atoms],
        unit=UNITS[table.units[row]],
        target=float(item.target_at(float(found.frames["time"][0]))[k] + table.means[row]),
        largest=float(mine["largest"]),
        mean=float(found.mean("total")[row]),
        allowed=float(mine["largest"] - mine["margin"]),
        frame=int(mine["frame"]) if mine["counted"] else None,
    )


def _first_alone(table: RowTable, found: Found) -> str:
    """What to say where the first frame alone differs from others that agree; '' elsewhere."""
    off = np.asarray((found.units["violated"] > 0).any(axis=1))
    if len(off) < 3 or off[0] == off[1] or (off[1:] != off[1]).any():
        return ""
    spreads = []
    for unit, name in enumerate(UNITS):
        mine = table.units == unit
        if off[1] and mine.any():
            means = found.rows["total"][mine] / np.maximum(found.rows["counted"][mine] - 1, 1)
            rms = float(np.sqrt(max(found.units["squares"][1:, unit].mean() - means @ means, 0.0) / mine.sum()))
            if rms > found.units["rounding"][:, unit].max() + table.tolerance * table.sizes[mine].min():
                return ""
            spreads.append(f"{rms:.1e} {name}")
    among = f": the others agree to {' and '.join(spreads)} (root mean square)" if spreads else ""
    second = found.frames["frame"][1]
    return (
        f"the first frame alone differs{among}. Programs such as LAMMPS write it before they hold the constraints; "
        f"begin at frame {second} (--frames {second}:)"
    )


def _gaps(found: Found, table: RowTable, untold: NDArray[np.bool_], targets: str) -> list[str]:
    """Why a check is no verdict on all that was asked; empty where it is."""
    gaps = [] if found.broken is None else [found.broken.text]
    n_rows, n_frames, measured = len(found.rows), len(found.frames), int(table.measured.sum())
    if n_frames == 1 and measured:
        which = "targets" if measured == n_rows else f"targets of {measured} of {n_rows} rows"
        gaps.append(
            f"{which} come from the only frame that was looked at, so that it cannot be off; look at more frames, or "
            "take targets from the topology or a parameter file"
        )
    if untold.any():
        gaps.append(
            f"coordinates in {targets} are so large that their rounding exceeds the lengths of {untold.sum()} of "
            f"{n_rows} rows: these have no targets; begin at another frame, or take targets from the topology or a "
            "parameter file"
        )
    unseen = n_rows - found.units["seen"].sum(axis=1)
    if len(frames := np.flatnonzero(unseen > 0)):
        gaps.append(
            f"nothing can be told of up to {unseen.max():.0f} of {n_rows} rows in {len(frames)} of {n_frames} "
            f"frames, from frame {found.frames['frame'][frames[0]]}: coordinates are so large that their rounding "
            "exceeds the lengths, or atoms coincide"
        )
    return gaps


def _temperatures(found: Found, rank: int, masses: FloatArray, remarks: list[str]) -> tuple[int, FloatArray | None]:
    """Degrees of freedom, and temperatures in K by frame where there are velocities and masses; remarks are added."""
    freedom = 3 * int(np.count_nonzero(masses > 0)) - rank
    twice = np.array(found.frames["kinetic"])
    has = np.isfinite(twice)
    if not has.any():
        return max(freedom, 0), None
    center, least = (found.frames["momentum"][has] ** 2).sum(axis=1) / masses.sum(), STILL * 3 * twice[has].mean()
    still = bool(center.mean() < least / max(freedom, 1)) and freedom > 3
    remarks.append("the center of mass is " + ("not at rest: it counts", "at rest: 3 degrees of freedom less")[still])
    freedom -= 3 * still
    if found.frames["turning"][has].mean() < least / max(freedom, 1) and freedom > 3:
        remarks.append("the system does not turn as a whole: 3 degrees of freedom less")
        freedom -= 3
    if freedom <= 0:
        remarks.append("no temperature: the constraints leave no degree of freedom")
        return 0, None
    return freedom, twice / (BOLTZMANN * freedom)
