"""The relaxations of a scan, kept one by one in a folder as they are done."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from ase import Atoms

from kcons.ase.named_calculators import described
from kcons.constraints import Constraint
from kcons.constraints.target import FloatArray
from kcons.errors import UnreadableError
from kcons.free_energy.scans.grid import Grid, Point
from kcons.steppers.files import ResultFolder, in_one_piece, stored_arrays

#: What is in a folder: the plan of the scan, its relaxations, and what `scan_report` makes of them.
PLAN, PLACE = "plan.json", "relaxations"
FILES = (f"{PLACE}/*.npz", "scan.json", "scan.csv", "scan.png", "scan.extxyz")
#: Atoms of a term of the model, filled up with this.
_NONE = -9


@dataclass
class Attempt:
    """One relaxation.

    Attributes
    ----------
    number : int
    point : tuple of int
    source : int or None
        The attempt whose structure it began from; None for the structure that was given.
    positions : ndarray, shape (n_atoms, 3)
    energy, largest : float
        In eV; the largest force left on an atom, in eV/angstrom.
    evaluations : int
    error : str or None
        Why it failed.
    memory, terms
        What was learned of the curvature, see `relaxation`.
    """

    number: int
    point: Point
    source: int | None
    positions: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    energy: float = float("nan")
    largest: float = float("nan")
    evaluations: int = 0
    error: str | None = None
    memory: FloatArray = field(default_factory=lambda: np.zeros((0, 2, 0)))
    terms: list[tuple[int, ...]] = field(default_factory=list)

    def fill(self, positions: FloatArray, energy: float, largest: float, evaluations: int) -> None:
        self.positions, self.energy, self.largest, self.evaluations = positions, energy, largest, evaluations


class Attempts:
    """A folder of attempts; without a folder nothing is kept.

    Parameters
    ----------
    folder : path, or None
    atoms : ase.Atoms
    grid : Grid
    held : sequence of Constraint
    settings : mapping

    Raises
    ------
    OccupiedError
        The folder has another scan in it, or other files of these names.
    InputError
        Coordinates that cannot be written to a file.
    """

    def __init__(
        self,
        folder: str | PathLike[str] | None,
        atoms: Atoms,
        grid: Grid,
        held: Sequence[Constraint],
        settings: Mapping[str, Any],
    ) -> None:
        self._results: ResultFolder | None = None
        self.folder: Path | None = None
        if folder is None:
            return
        plan = {
            "symbols": str(atoms.symbols),
            "positions": atoms.positions.tolist(),
            "cell": atoms.cell.array.tolist(),
            "pbc": atoms.pbc.tolist(),
            "calculator": described(atoms.calc, atoms),
            "coordinates": [item.with_target(None).todict() for item in grid.coordinates],
            "values": [axis.tolist() for axis in grid.values],
            "held": [item.todict() for item in held],
            "settings": dict(settings),
        }
        self._results = ResultFolder(folder, PLAN, plan, FILES, "a scan")
        self._results.refuse_others()
        self.folder = self._results.path

    @contextmanager
    def taken(self) -> Iterator[None]:
        """Make the folder, and keep others out of it.

        Raises
        ------
        OccupiedError
            Another scan writes there.
        """
        if self._results is None:
            yield
            return
        with self._results.taken():
            (self._results.path / PLACE).mkdir(exist_ok=True)
            yield

    def _file(self, number: int) -> Path:
        assert self.folder is not None
        return self.folder / PLACE / f"{number:05d}.npz"

    def _read(self, number: int) -> Attempt | None:
        """What a file has; None if there is none."""
        if self.folder is None or not self._file(number).exists():
            return None
        try:
            with self._file(number).open("rb") as file:
                data = {name.removesuffix(".npy"): array for name, array in stored_arrays(file).items()}
            head = json.loads(str(data["head"]))
            point, source = tuple(head["point"]), head["source"]
            found = Attempt(number, point, source, data["positions"], error=head["error"], memory=data["memory"])
            found.terms = [tuple(a for a in row if a != _NONE) for row in data["terms"].tolist()]
            found.energy, found.largest = (float(v) for v in data["numbers"])
            found.evaluations = head["evaluations"]
        except (OSError, ValueError, KeyError, TypeError, BadZipFile) as error:
            raise UnreadableError(f"{self._file(number)} cannot be read ({error}); remove it", item="folder") from error
        return found

    def tried(self, number: int) -> tuple[Point, int | None] | None:
        """Point and source of an attempt of an earlier run; None if there is none."""
        found = self._read(number)
        return None if found is None else (found.point, found.source)

    def kept(self, number: int, point: Point, source: int | None) -> Attempt | None:
        """An attempt of an earlier run; None if there is none.

        Raises
        ------
        UnreadableError
            Its file is damaged, or of another scan.
        """
        found = self._read(number)
        if found is not None and (found.point, found.source) != (point, source):
            raise UnreadableError(f"{self._file(number)} is of another scan; take another folder", item="folder")
        return found

    def keep(self, attempt: Attempt) -> None:
        """Write an attempt; the file is there as a whole, or not at all."""
        if self.folder is None:
            return
        head = {
            "point": list(attempt.point),
            "source": attempt.source,
            "evaluations": attempt.evaluations,
            "error": attempt.error,
        }
        terms = np.full((len(attempt.terms), 5), _NONE, dtype=np.int64)
        for row, term in zip(terms, attempt.terms, strict=True):
            row[: len(term)] = term
        with in_one_piece(self._file(attempt.number)) as file:
            np.savez(
                file,
                head=np.array(json.dumps(head)),
                positions=attempt.positions,
                numbers=np.array([attempt.energy, attempt.largest]),
                memory=attempt.memory,
                terms=terms,
            )
