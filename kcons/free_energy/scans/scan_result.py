"""The points of a scan, its relaxations, in memory and in files, and how they are shown."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zipfile import BadZipFile

import ase.io
import numpy as np
from ase import Atoms, units
from numpy.typing import ArrayLike
from rich import box
from rich.console import Console
from rich.table import Column, Table

from kcons import __version__
from kcons.ase.constraints_object import Constraints
from kcons.constraints import Constraint
from kcons.constraints.arguments import ANGLE, LENGTH, as_float_array
from kcons.constraints.target import FloatArray, nearest_image
from kcons.errors import InputError, UnreadableError, UnsupportedError
from kcons.free_energy.scans.relaxation import Relaxed
from kcons.steppers.files import in_one_piece, stored_arrays, text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: One eV in kJ/mol, and the difference of energies that is told of, in kJ/mol.
KJ, TOLD = units.mol / units.kJ, 0.1
#: Values this near to each other, relative to their range, are the same.
SAME = 1e-9

#: Number of a value along each coordinate.
Point = tuple[int, ...]


class Grid:
    """All combinations of the values of one or two coordinates, in angstrom or radian, up or down.

    Of dihedrals over a whole turn the last value, which is the first one again, is left out.
    """

    def __init__(self, coordinates: Sequence[Constraint], values: Sequence[ArrayLike]) -> None:
        self.coordinates = list(coordinates)
        if not 1 <= len(self.coordinates) <= 2:
            raise InputError(f"a scan has one or two coordinates, not {len(self.coordinates)}", item="coordinates")
        if len(values) != len(self.coordinates):
            raise InputError(
                f"{len(self.coordinates)} coordinates have {len(values)} lists of values; give one list for each",
                item="values",
            )
        for item in self.coordinates:
            if item.n_rows != 1:
                raise InputError(f"{item!r} has {item.n_rows} rows; a coordinate of a scan has one", item="coordinates")
            if item.moving or not item.holonomic:
                raise UnsupportedError(f"{item!r} moves with time or holds velocities; scan a coordinate of positions")
        made = [_axis(item, given) for item, given in zip(self.coordinates, values, strict=True)]
        #: Arrays; and whether the first value of a coordinate follows on its last.
        self.values, self.rings = [axis for axis, _ in made], [ring for _, ring in made]
        self.names = [item.row_name(0) for item in self.coordinates]
        # Without blanks, for files: 'dihedral_0_1_2_3'.
        keys = ["_".join([item.family.lower(), *map(str, item.atoms[0].tolist()[:6])]) for item in self.coordinates]
        self.keys = [key + (f"_{n}" if key in keys[:n] else "") for n, key in enumerate(keys)]
        self.in_degrees = [item.held == ANGLE for item in self.coordinates]
        self.units = [{ANGLE: "degrees", LENGTH: "angstrom"}.get(item.held, "own unit") for item in self.coordinates]
        self.shape: Point = tuple(len(axis) for axis in self.values)
        self.points: list[Point] = list(product(*map(range, self.shape)))

    def at(self, point: Point) -> list[float]:
        """The values at a point."""
        return [float(axis[n]) for axis, n in zip(self.values, point, strict=True)]

    def shown(self, point: Point) -> list[float]:
        """The values at a point, angles in degrees."""
        return [float(np.degrees(v)) if turn else v for v, turn in zip(self.at(point), self.in_degrees, strict=True)]

    def said(self, point: Point) -> str:
        """For messages: 'Dihedral(0, 1, 2, 3) = 30'."""
        return ", ".join(f"{name} = {v:.6g}" for name, v in zip(self.names, self.shown(point), strict=True))

    def held_at(self, point: Point) -> list[Constraint]:
        """The coordinates with their values at a point as targets."""
        return [item.with_target(v) for item, v in zip(self.coordinates, self.at(point), strict=True)]

    def neighbors(self, point: Point) -> list[Point]:
        """One value further along one coordinate, either way."""
        found = []
        for axis, (n, size, ring) in enumerate(zip(point, self.shape, self.rings, strict=True)):
            for other in (n + 1, n - 1):
                other = other % size if ring else other
                if 0 <= other < size and other != n:
                    found.append((*point[:axis], other, *point[axis + 1 :]))
        return list(dict.fromkeys(found))

    def apart(self, point: Point, place: Sequence[float]) -> float:
        """How far a point is from values, in steps of the grid."""
        steps = [float(np.diff(axis).mean()) if len(axis) > 1 else 1.0 for axis in self.values]
        periods = np.array([item.period or 0.0 for item in self.coordinates])
        return float(np.linalg.norm(nearest_image(np.subtract(self.at(point), place), periods) / steps))


def _axis(item: Constraint, given: ArrayLike) -> tuple[FloatArray, bool]:
    name = item.row_name(0)
    axis = np.atleast_1d(np.array(as_float_array(given, f"values of {name}")))
    if axis.ndim != 1 or not len(axis) or not np.isfinite(axis).all():
        raise InputError(f"the values of {name} are not a list of finite numbers", item="values")
    ring, span = False, float(np.ptp(axis))
    if np.diff(np.sort(axis)).min(initial=np.inf) <= SAME * span:
        raise InputError(f"two values of {name} are the same; give each once", item="values")
    if len(set(np.sign(np.diff(axis)).tolist())) > 1:
        raise InputError(f"the values of {name} go up and down; give them in order", item="values")
    if item.period is not None and len(axis) > 1:
        if span > item.period * (1 + SAME):
            raise InputError(
                f"the values of {name} span more than its period, {item.period:.6g}; give one turn", item="values"
            )
        if span > item.period * (1 - SAME):
            axis = axis[:-1]
        ring = len(axis) > 2 and item.period - float(np.ptp(axis)) <= 1.5 * float(np.abs(np.diff(axis)).max())
    return axis, ring


#: What of an attempt is no number and no text.
_ARRAYS = ("positions", "memory")


@dataclass(eq=False, kw_only=True)
class Attempt(Relaxed):
    """One relaxation."""

    number: int
    point: Point
    #: The attempt whose structure it began from; None for the structure that was given.
    source: int | None
    #: Why it failed.
    error: str | None = None

    def save(self, path: Path) -> None:
        """Write it; the file is there as a whole, or not at all."""
        head = {name: value for name, value in vars(self).items() if name not in ("number", *_ARRAYS)}
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        with in_one_piece(path) as file:
            np.savez(file, head=np.array(json.dumps(head)), **arrays)

    @classmethod
    def load(cls, path: Path, number: int) -> Attempt:
        """Read what `save` wrote."""
        try:
            with path.open("rb") as file:
                data = stored_arrays(file)
            head = json.loads(str(data["head"])) | {name: data[name] for name in _ARRAYS}
            head |= {"point": tuple(head["point"]), "terms": [tuple(term) for term in head["terms"]]}
            return cls(number=number, **head)
        except (OSError, ValueError, KeyError, TypeError, BadZipFile) as error:
            raise UnreadableError(f"{path} cannot be read ({error}); remove it", item="folder") from error


class _Shown(Table):
    """A table that `print` shows as a terminal does."""

    def __str__(self) -> str:
        page = io.StringIO()
        Console(file=page, width=200, color_system=None).print(self)
        return page.getvalue().rstrip()


@dataclass
class Scan:
    """What a scan found.

    Attributes
    ----------
    grid : Grid
    atoms : ase.Atoms
        As given, without calculator and constraints.
    held : list of Constraint
        What was held besides the coordinates.
    attempts : list of Attempt
        All relaxations, in the order in which they were made.
    best : dict
        The attempt of lowest energy of each point that was reached.
    """

    grid: Grid
    atoms: Atoms
    held: list[Constraint] = field(default_factory=list)
    attempts: list[Attempt] = field(default_factory=list)
    best: dict[Point, Attempt] = field(default_factory=dict)

    @property
    def energies(self) -> FloatArray:
        """In eV, shape of the grid; NaN where no relaxation succeeded."""
        table = np.full(self.grid.shape, np.nan)
        for point, attempt in self.best.items():
            table[point] = attempt.energy
        return table

    @property
    def hysteresis(self) -> FloatArray:
        """How much the last relaxations from the neighbors of each point differ in energy, in eV, shape of the grid.

        Zero where they ended in the same minimum, or where there was one only.
        """
        last: dict[Point, dict[Point | None, float]] = {}
        for attempt in self.attempts:
            if attempt.error is None:
                origin = None if attempt.source is None else self.attempts[attempt.source].point
                last.setdefault(attempt.point, {})[origin] = attempt.energy
        table = np.full(self.grid.shape, np.nan)
        for point, energies in last.items():
            table[point] = max(energies.values()) - min(energies.values())
        return table

    @property
    def failed(self) -> dict[Point, str]:
        """Points that were not reached, with the last error of each."""
        errors = {a.point: a.error for a in self.attempts if a.error is not None}
        return {p: errors.get(p) or "no relaxation was tried" for p in self.grid.points if p not in self.best}

    @property
    def evaluations(self) -> int:
        """Calls of energy and forces in all."""
        return sum(attempt.evaluations for attempt in self.attempts)

    def structure(self, point: Point, *, hold: bool = False) -> Atoms:
        """The minimum at a point, its values and energy in `info`.

        Parameters
        ----------
        point : tuple of int
            Numbers of its values in the lists of the scan.
        hold : bool
            Whether the atoms get the constraints they had there: what was held besides, and the coordinates.
        """
        if point not in self.best:
            raise InputError(
                f"there is no structure at {point}: {self.failed.get(point, 'no such point')}", item="point"
            )
        found = self.atoms.copy()
        found.positions[:] = self.best[point].positions
        found.info |= {"energy": self.best[point].energy, **self._values(point)}
        if hold:
            found.set_constraint(Constraints([*self.held, *self.grid.held_at(point)]))
        return found

    def _values(self, point: Point) -> dict[str, float]:
        return dict(zip(self.grid.keys, self.grid.shown(point), strict=True))

    # -- shown ----------------------------------------------------------------------------------

    def rows(self) -> list[dict[str, Any]]:
        """Of each point the values, energies, hysteresis, calls, the force left, and why it failed."""
        energy, spread = self.energies, self.hysteresis
        lowest = np.nanmin(energy)
        return [
            {
                **self._values(point),
                "energy_eV": float(energy[point]) if point in self.best else None,
                "energy_kJ_mol": float(energy[point] - lowest) * KJ,
                "hysteresis_kJ_mol": float(spread[point]) * KJ,
                "calls": sum(attempt.evaluations for attempt in self.attempts if attempt.point == point),
                "force_left_eV_A": self.best[point].largest if point in self.best else float("nan"),
                "error": self.failed.get(point),
            }
            for point in self.grid.points
        ]

    def summary(self) -> str:
        """What was done, and what failed."""
        lines = [
            f"{len(self.best)} of {len(self.grid.points)} points, {len(self.attempts)} relaxations, "
            f"{self.evaluations} calls of energy and forces; lowest energy {np.nanmin(self.energies):.6f} eV"
        ]
        spread = self.hysteresis * KJ
        if np.nanmax(spread) >= TOLD:
            worst = tuple(int(n) for n in np.unravel_index(np.nanargmax(spread), spread.shape))
            lines.append(
                f"from different neighbors the energy differs by up to {spread[worst]:.2f} kJ/mol, at "
                f"{self.grid.said(worst)}; the lower one is kept"
            )
        return "\n".join([*lines, *(f"failed: {why}" for why in self.failed.values())])

    def table(self) -> Table:
        """A row a point; energies above the lowest one. Print it."""
        titles = [f"{name}\n{unit}" for name, unit in zip(self.grid.names, self.grid.units, strict=True)]
        titles += ["energy\nkJ/mol", "hysteresis\nkJ/mol", "calls\n", "force left\neV/angstrom"]
        shown = _Shown(*(Column(title, justify="right") for title in titles), box=box.SIMPLE_HEAD, padding=(0, 1))
        for row in self.rows():
            *values, _, energy, spread, calls, left, error = row.values()
            numbers = (
                ("failed", "", f"{calls}", "")
                if error
                else (f"{energy:.3f}", f"{spread:.3f}", f"{calls}", f"{left:.4f}")
            )
            shown.add_row(*(f"{value:.6g}" for value in values), *numbers)
        return shown

    def plot(self) -> Figure:
        """Energy along one coordinate, or over two; points that failed are crosses."""
        from matplotlib.figure import Figure

        grid, energy, spread = self.grid, (self.energies - np.nanmin(self.energies)) * KJ, self.hysteresis * KJ
        figure = Figure(figsize=(7, 4.5), layout="constrained")
        axes = figure.subplots()
        labels = [f"{name} / {unit}" for name, unit in zip(grid.names, grid.units, strict=True)]
        axes.set_xlabel(labels[0])
        failed = np.array([grid.shown(point) for point in grid.points if point not in self.best])
        x, *y = (np.degrees(v) if turn else v for v, turn in zip(grid.values, grid.in_degrees, strict=True))
        if y:
            drawn = axes.pcolormesh(x, y[0], np.ma.masked_invalid(energy.T), shading="nearest", cmap="viridis")
            figure.colorbar(drawn, ax=axes, label="energy / (kJ/mol)")
            axes.set_ylabel(labels[1])
        else:
            axes.plot(x, energy, marker="o", markersize=4, color="#0072B2", label="lowest")
            if np.nanmax(spread, initial=0.0) >= TOLD:
                higher = "highest from another neighbor"
                axes.plot(x, energy + spread, linestyle="--", color="#D55E00", label=higher)
                axes.legend(fontsize=8)
            axes.set_ylabel("energy / (kJ/mol)")
        if len(failed):
            axes.plot(failed[:, 0], failed[:, 1] if y else np.zeros(len(failed)), "x", color="black")
        return figure

    def write(self, folder: Path | str) -> list[Path]:
        """Put scan.json, .csv, .png and .extxyz (the minima, as in the grid) into a folder; the paths written."""
        import pandas

        place, table = Path(folder), pandas.DataFrame(self.rows())
        place.mkdir(parents=True, exist_ok=True)
        data: dict[str, Any] = {
            "kcons": __version__,
            "coordinates": dict(zip(self.grid.keys, self.grid.units, strict=True)),
            "points": self.rows(),
            "relaxations": len(self.attempts),
            "calls": self.evaluations,
        }
        frames, picture = io.StringIO(), io.BytesIO()
        for point in sorted(self.best):
            ase.io.write(frames, self.structure(point), format="extxyz")
        self.plot().savefig(picture, dpi=150, format="png")
        lines = table.to_csv(index=False, lineterminator="\r\n", na_rep="")
        written = [place / f"scan.{kind}" for kind in ("json", "csv", "png", "extxyz")]
        contents = [text(data).encode(), lines.encode(), picture.getvalue(), frames.getvalue().encode()]
        for path, content in zip(written, contents, strict=True):
            with in_one_piece(path) as file:
                file.write(content)
        return written
