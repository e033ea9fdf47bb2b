"""Relaxed scans: minima of the energy with one or two coordinates held at the points of a grid.

Every point is relaxed from each of its neighbors, and again from a neighbor whose energy became lower, until nothing
changes (the wavefront of TorsionDrive): both ways, as torsions are driven. The next value is reached by turning and
moving groups as rigid pieces. What was learned of the curvature goes along from point to point.

References
----------
Y. Qiu et al., J. Chem. Phys. 152, 244116 (2020).
"""

from __future__ import annotations

import io
import json
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import product
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import ase.io
import numpy as np
from ase import Atoms, units
from numpy.typing import ArrayLike

from kcons.ase.binding import FORCES_ONLY, applied_forces
from kcons.ase.constraints_object import Constraints
from kcons.ase.named_calculators import described
from kcons.ase.topology import bonds_of
from kcons.ase.translation import translated
from kcons.constraints import Constraint
from kcons.constraints.arguments import ANGLE, LENGTH, Count, Positive, as_float_array, checked
from kcons.constraints.constraint import constraints_in
from kcons.constraints.target import FloatArray, nearest_image
from kcons.errors import (
    CalculatorError,
    InfeasibleError,
    InputError,
    KconsError,
    NonFiniteError,
    UnreadableError,
    UnsupportedError,
)
from kcons.free_energy.held_coordinates import HeldCoordinates, warn_of_gaps
from kcons.free_energy.scans.relaxation import FIRST, Descent, Internals, Relaxed
from kcons.motion.minimization import minimize
from kcons.motion.motion import Motion
from kcons.steppers.files import ResultFolder, in_one_piece, stored_arrays, write_arrays, write_files

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

#: Energy by which a structure has to be lower to be handed on to the neighbors, in eV (10^-5 hartree).
LOWER = 2.7e-4
#: Atoms up to which curvatures are kept as a table; beyond, relaxations remember their last steps only.
MOST_ATOMS = 150
#: Relaxations to a point that failed after which it is given up.
MOST_TRIES = 4
#: What is in a folder besides what the scan is of: its relaxations, and what `Scan.write` makes of them.
PLACE, WRITTEN = "relaxations", ("scan.csv", "scan.png", "scan.extxyz")

#: One eV in kJ/mol, and the difference of energies that is told of, in kJ/mol.
KJ, TOLD = units.mol / units.kJ, 0.1
#: Values this near to each other, relative to their range, are the same.
SAME = 1e-9
#: Number of a value along each coordinate.
Point = tuple[int, ...]


@checked
def scan(
    atoms: Atoms,
    coordinates: Constraint | Sequence[Constraint],
    values: ArrayLike | Sequence[ArrayLike],
    *,
    held: Constraint | Iterable[Constraint] = (),
    folder: str | PathLike[str] | None = None,
    fmax: Positive = 0.01,
    both_ways: bool = True,
    evaluations: Count = 200,
    progress: Callable[[int, int, str], None] | None = None,
) -> Scan:
    """Relax a structure with one or two coordinates held at each of their values in turn.

    Parameters
    ----------
    atoms : ase.Atoms
        With a calculator; not changed. What ASE constraints hold on it stays held.
    coordinates : Constraint, or sequence of one or two
        What is scanned, one row each: ``Dihedral([0, 1, 2, 3])``, or any other that depends on positions.
    values : array_like, or one for each coordinate
        Where they are held, in angstrom or radian, up or down; `Scan.energies` is in this order.
    held : sequence of Constraint
        What else is held, at its targets or as it is in `atoms`.
    folder : path, optional
        Keeps every relaxation as soon as it is done. With the same arguments again, a scan goes on there, and tries
        points once more that failed. One at a time.
    fmax : float
        The largest force along the constraints that may be left on an atom, in eV/angstrom.
    both_ways : bool
        Whether points are relaxed from all their neighbors, and not only from the one that is reached first.
    evaluations : int
        Calls of energy and forces after which a relaxation is given up.
    progress : callable, optional
        ``progress(done, points, line)`` after each relaxation.

    Returns
    -------
    Scan
        Points that failed are in `Scan.failed`; they do not stop the others.

    Raises
    ------
    InputError
        No calculator, unknown atoms, values that a coordinate cannot have, ...
    ConstraintError
        A coordinate that is undefined at the start, or depends on what else is held.
    OccupiedError
        The folder has another scan in it, or other files of the names of its results; or another one writes there.
    KconsError
        The first failure, where no point at all could be relaxed.
    """
    items = constraints_in(coordinates, "coordinates")
    one = isinstance(coordinates, Constraint) or not isinstance(values, Iterable)
    lists = [values] if one else list(values)  # type: ignore[arg-type]
    grid = Grid(items, lists)  # type: ignore[arg-type]
    settings: dict[str, Any] = {"fmax": fmax, "both_ways": both_ways, "evaluations": evaluations}
    wavefront = _Wavefront(atoms, grid, constraints_in(held, "held"), settings)
    wavefront.progress = progress
    if folder is None:
        return wavefront.run()
    plan = {
        "structure": [value.tolist() for value in (atoms.numbers, atoms.positions, atoms.cell.array, atoms.pbc)],
        "calculator": described(atoms.calc, atoms),
        "coordinates": [item.with_target(None).todict() for item in grid.coordinates],
        "values": [axis.tolist() for axis in grid.values],
        "held": [item.todict() for item in wavefront.scan.held],
        "settings": settings,
    }
    results = ResultFolder(folder, "plan.json", plan, (f"{PLACE}/*.npz", *WRITTEN), "a scan")
    results.refuse_others()
    with results.taken():
        wavefront.place = results.path / PLACE
        wavefront.place.mkdir(exist_ok=True)
        return wavefront.run()


class _Wavefront:
    """What is held at each point, its energies and forces; which point is relaxed next, and from where."""

    def __init__(self, atoms: Atoms, grid: Grid, held: list[Constraint], settings: dict[str, Any]) -> None:
        if atoms.calc is None:
            raise InputError("the atoms have no calculator; give them one: atoms.calc = ...", item="calculator")
        self.grid, self.settings = grid, settings
        #: Told of every attempt: points done, points in all, and a line about it.
        self.progress: Callable[[int, int, str], None] | None = None
        self.atoms = atoms.copy()
        self.atoms.calc = atoms.calc
        forces_only = [item for item in atoms.constraints if isinstance(item, FORCES_ONLY)]
        held = [*translated(atoms, [item for item in atoms.constraints if item not in forces_only]), *held]
        self.atoms.set_constraint(forces_only)
        self.start = self.atoms.get_positions()
        bare = self.atoms.copy()
        bare.set_constraint()
        kept = Constraints(held)
        kept.engine(bare)
        self.scan = Scan(grid, bare, list(kept.constraints))  # with the targets that were left open
        motion = self._engine([item.with_target(None) for item in grid.coordinates])
        there = HeldCoordinates(motion, dict(zip(grid.keys, grid.coordinates, strict=True)), self.start)
        self._measured = motion.sources[0].measure(self.start)[there.rows].tolist()
        for item, axis in zip(grid.coordinates, grid.values, strict=True):
            weighted = item.with_masses(bare.get_masses()[item.atoms])
            for value in axis.tolist():
                weighted.with_target(value).check(self.start[item.atoms], 0.0, 0)
        self._bonds = bonds_of(self.atoms)
        warn_of_gaps({item.row_name(0): item for item in grid.coordinates}, self._bonds, stacklevel=5)
        #: Where relaxations are kept.
        self.place: Path | None = None
        #: The attempt whose structure a point has handed on to its neighbors.
        self._handed: dict[Point, int] = {}
        self._queue: deque[tuple[Point, int | None]] = deque()
        self._tried: set[tuple[Point, int | None]] = set()
        self._tried_now: set[Point] = set()
        self._first: KconsError | None = None

    def _engine(self, rows: list[Constraint]) -> Motion:
        """Of these rows, beside all that is held at each point."""
        return Constraints([*self.scan.held, *rows]).engine(self.scan.atoms)

    def evaluate(self, x: FloatArray) -> tuple[float, FloatArray]:
        """Energy and forces."""
        self.atoms.set_positions(x, apply_constraint=False)
        try:
            energy, forces = float(self.atoms.get_potential_energy()), applied_forces(self.atoms)
        except InputError:
            raise
        except Exception as error:
            raise CalculatorError(
                f"the calculator failed ({type(error).__name__}: {error}); change its settings, or leave the value out"
            ) from error
        if not np.isfinite(energy):
            raise NonFiniteError(f"the energy is not finite: {energy}", item="energy")
        for atom in np.flatnonzero(~np.isfinite(forces).all(axis=1)).tolist():
            raise NonFiniteError(f"the force on atom {atom} is not finite: {forces[atom]}", item="force", atom=atom)
        return energy, forces

    def relaxed(self, point: Point, source: Attempt | None) -> Relaxed:
        """The minimum at a point, from the structure of another relaxation or from the first one."""
        fmax, evaluations = self.settings["fmax"], self.settings["evaluations"]
        before = self.start if source is None else source.positions
        # What a calculator remembers, such as a density, would make the bits depend on what was done before.
        getattr(self.atoms.calc, "reset", lambda: None)()
        motion = self._engine(self.grid.held_at(point))
        try:
            x = motion.restore_positions(before, bonds=self._bonds)
        except InfeasibleError:
            # In rings, other angles have to change, which the relaxation puts right.
            x = motion.restore_positions(before, bonds=[])
        if len(x) > MOST_ATOMS:
            found = minimize(
                motion, lambda y, _: self.evaluate(y)[1], x, tolerance=fmax, longest=FIRST, steps=evaluations
            )
            return Relaxed(found.positions, self.evaluate(found.positions)[0], found.largest, found.evaluations)
        internals = Internals(self.atoms.numbers, x, motion.lattice)
        memory = internals.remapped(source.memory, source.terms) if source and len(source.memory) else ()
        return Descent(motion, self.evaluate, internals, memory).relaxed(x, fmax, evaluations)

    # -- from point to point --------------------------------------------------------------------

    def run(self) -> Scan:
        for point in sorted(self.grid.points, key=lambda p: self.grid.apart(p, self._measured)):
            if not self.scan.best:
                self._queue.append((point, None))
                self._drain()
        while self._reach_the_rest() or self._try_again():
            self._drain()
        if not self.scan.best:
            assert self._first is not None
            raise self._first
        return self.scan

    def _drain(self) -> None:
        while self._queue:
            point, source = self._queue.popleft()
            # Of a source that was overtaken a lower one is on its way.
            overtaken = source is not None and self._handed[self.scan.attempts[source].point] != source
            reached = not self.settings["both_ways"] and point in self.scan.best
            if not (overtaken or reached or (point, source) in self._tried):
                self._tried.add((point, source))
                self._settle(self._made(point, source))

    def _kept(self) -> Attempt | None:
        """The next attempt as an earlier run made it; None if there is none."""
        number = len(self.scan.attempts)
        file = None if self.place is None else self.place / f"{number:05d}.npz"
        return Attempt.load(file, number) if file is not None and file.exists() else None

    def _made(self, point: Point, source: int | None) -> Attempt:
        attempts, attempt = self.scan.attempts, self._kept()
        if attempt is not None and (attempt.point, attempt.source) != (point, source):
            said = f"relaxation {len(attempts)} in {self.place} is of another scan; take another folder"
            raise UnreadableError(said, item="folder")
        if attempt is None:
            self._tried_now.add(point)
            attempt = Attempt(number=len(attempts), point=point, source=source)
            try:
                vars(attempt).update(vars(self.relaxed(point, None if source is None else attempts[source])))
            except KconsError as error:
                attempt.error = f"{self.grid.said(point)}: {type(error).__name__}: {error}"
                self._first = self._first or error
            if self.place is not None:
                attempt.save(self.place / f"{attempt.number:05d}.npz")
        attempts.append(attempt)
        return attempt

    def _settle(self, attempt: Attempt) -> None:
        point, best = attempt.point, self.scan.best
        if attempt.error is None:
            handed = self._handed.get(point)
            if point not in best or attempt.energy < best[point].energy:
                best[point] = attempt
            if handed is None or attempt.energy < self.scan.attempts[handed].energy - LOWER:
                self._handed[point] = attempt.number
                self._queue.extend((other, attempt.number) for other in self.grid.neighbors(point))
        if self.progress is not None:
            said = f"{attempt.energy:.6f} eV" if attempt.error is None else f"failed: {attempt.error}"
            self.progress(len(best), len(self.grid.points), f"{self.grid.said(point)}: {said}")

    def _reach_the_rest(self) -> bool:
        """Ask for a point that was not reached from a reached one that has not been tried for it, the nearest one."""
        missing = [point for point in self.grid.points if point not in self.scan.best]
        tries = Counter(point for point, _ in self._tried)
        pairs = [
            (self.grid.apart(point, self.grid.at(other)), point, number)
            for point in missing
            for other, number in self._handed.items()
            if (point, number) not in self._tried and tries[point] < MOST_TRIES
        ]
        self._queue.extend((point, number) for _, point, number in sorted(pairs)[:1])
        return bool(pairs)

    def _try_again(self) -> bool:
        """Try a point that failed in an earlier run, once in this one, as it was tried first; False if none is left."""
        attempts = self.scan.attempts
        failed = (a for a in attempts if a.point not in self.scan.best and a.point not in self._tried_now)
        again = self._kept() or next(failed, None)
        if again is None:
            return False
        self._settle(self._made(again.point, again.source))
        return True


# -- points, relaxations, and what is shown of them --------------------------------------------------


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
        #: Arrays; and whether the first value of a coordinate follows on its last.
        self.values: list[FloatArray] = []
        self.rings: list[bool] = []
        for item, given in zip(self.coordinates, values, strict=True):
            if item.n_rows != 1:
                raise InputError(f"{item!r} has {item.n_rows} rows; a coordinate of a scan has one", item="coordinates")
            if item.moving or not item.holonomic:
                raise UnsupportedError(f"{item!r} moves with time or holds velocities; scan a coordinate of positions")
            name = item.row_name(0)
            axis = np.atleast_1d(np.array(as_float_array(given, f"values of {name}")))
            if axis.ndim != 1 or not len(axis) or not np.isfinite(axis).all():
                raise InputError(f"the values of {name} are not a list of finite numbers", item="values")
            ring, span, steps = False, float(np.ptp(axis)), np.diff(axis)
            if (steps * np.sign(steps.sum()) <= SAME * span).any():
                raise InputError(f"values of {name} repeat or turn back; give each once and in order", item="values")
            if item.period is not None and len(axis) > 1:
                if span > item.period * (1 + SAME):
                    raise InputError(
                        f"the values of {name} span more than its period, {item.period:.6g}; give one turn",
                        item="values",
                    )
                if span > item.period * (1 - SAME):
                    axis = axis[:-1]
                ring = len(axis) > 2 and item.period - float(np.ptp(axis)) <= 1.5 * float(np.abs(np.diff(axis)).max())
            self.values.append(axis)
            self.rings.append(ring)
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
            write_arrays(file, {"head": np.array(json.dumps(head)), **arrays})

    @classmethod
    def load(cls, path: Path, number: int) -> Attempt:
        """Read what `save` wrote."""
        try:
            with path.open("rb") as file:
                data = stored_arrays(file)
            head = json.loads(str(data["head"])) | {name: data[name] for name in _ARRAYS}
            head |= {"point": tuple(head["point"]), "terms": [tuple(term) for term in head["terms"]]}
            return cls(number=number, **head)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UnreadableError(f"{path} cannot be read ({error}); remove it", item="folder") from error


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

    def structure(self, point: Point) -> Atoms:
        """The minimum at a point, its values and energy in `info`.

        Parameters
        ----------
        point : tuple of int
            Numbers of its values in the lists of the scan.
        """
        if point not in self.best:
            why = self.failed.get(point, "no such point")
            raise InputError(f"there is no structure at {point}: {why}", item="point")
        found = self.atoms.copy()
        found.positions[:] = self.best[point].positions
        shown = dict(zip(self.grid.keys, self.grid.shown(point), strict=True))
        found.info |= {"energy": self.best[point].energy, **shown}
        return found

    # -- shown ----------------------------------------------------------------------------------

    def table(self) -> DataFrame:
        """A row a point: its values, energies, hysteresis, calls, the force left, and why it failed."""
        import pandas

        energy, spread, units = self.energies, self.hysteresis, [unit.replace(" ", "_") for unit in self.grid.units]
        lowest, names = np.nanmin(energy), [f"{key}_{unit}" for key, unit in zip(self.grid.keys, units, strict=True)]
        return pandas.DataFrame(
            {
                **dict(zip(names, self.grid.shown(point), strict=True)),
                "energy_eV": float(energy[point]),
                "energy_kJ_mol": float(energy[point] - lowest) * KJ,
                "hysteresis_kJ_mol": float(spread[point]) * KJ,
                "calls": sum(attempt.evaluations for attempt in self.attempts if attempt.point == point),
                "force_left_eV_A": self.best[point].largest if point in self.best else np.nan,
                "error": self.failed.get(point),
            }
            for point in self.grid.points
        )

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
        """Put scan.csv, .png and .extxyz (the minima, as in the grid) into a folder; the paths written."""
        frames, picture = io.StringIO(), io.BytesIO()
        for point in sorted(self.best):
            ase.io.write(frames, self.structure(point), format="extxyz")
        self.plot().savefig(picture, dpi=150, format="png")
        table = self.table().to_csv(index=False, lineterminator="\r\n", na_rep="")
        contents = (table.encode(), picture.getvalue(), frames.getvalue().encode())
        return write_files(folder, dict(zip(WRITTEN, contents, strict=True)))
