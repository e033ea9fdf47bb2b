"""Relaxed scans: minima of the energy with one or two coordinates held at the points of a grid.

Every point is relaxed from each of its neighbors, and again from a neighbor whose energy became lower, until nothing
changes (the wavefront of TorsionDrive): both ways, as torsions are driven. The next value is reached by turning and
moving groups as rigid pieces. What was learned of the curvature goes along from point to point.

References
----------
Y. Qiu et al., J. Chem. Phys. 152, 244116 (2020).
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from ase import Atoms
from numpy.typing import ArrayLike

from kcons.ase.binding import FORCES_ONLY, applied_forces
from kcons.ase.constraints_object import Constraints
from kcons.ase.named_calculators import described
from kcons.ase.topology import bonds_of
from kcons.ase.translation import translated
from kcons.constraints import Constraint
from kcons.constraints.arguments import positive, whole_number
from kcons.constraints.constraint import constraints_in
from kcons.constraints.target import FloatArray
from kcons.errors import (
    CalculatorError,
    ConstraintError,
    InfeasibleError,
    InputError,
    KconsError,
    NonFiniteError,
    UnreadableError,
)
from kcons.free_energy.scans.relaxation import FIRST, Descent, Internals, Relaxed
from kcons.free_energy.scans.scan_result import Attempt, Grid, Point, Scan
from kcons.free_energy.torsion_force import warn_of_gaps
from kcons.motion.minimization import minimize
from kcons.motion.motion import Motion
from kcons.steppers.files import ResultFolder

#: Energy by which a structure has to be lower to be handed on to the neighbors, in eV (10^-5 hartree).
LOWER = 2.7e-4
#: Atoms up to which curvatures are kept as a table; beyond, relaxations remember their last steps only.
MOST_ATOMS = 150

#: Relaxations to a point that failed after which it is given up.
MOST_TRIES = 4
#: What is in a folder: what the scan is of, its relaxations, and what `Scan.write` makes of them.
PLAN, PLACE = "plan.json", "relaxations"
FILES = (f"{PLACE}/*.npz", "scan.json", "scan.csv", "scan.png", "scan.extxyz")

#: Told of every attempt: points done, points in all, and a line about it.
Progress = Callable[[int, int, str], None]


def scan(
    atoms: Atoms,
    coordinates: Constraint | Sequence[Constraint],
    values: ArrayLike | Sequence[ArrayLike],
    *,
    held: Constraint | Iterable[Constraint] = (),
    folder: str | PathLike[str] | None = None,
    fmax: float = 0.01,
    both_ways: bool = True,
    evaluations: int = 200,
    progress: Progress | None = None,
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
    lists = [values] if isinstance(coordinates, Constraint) else list(values)  # type: ignore[arg-type]
    grid = Grid(items, lists)  # type: ignore[arg-type]
    fmax, evaluations = positive(fmax, "fmax"), whole_number(evaluations, "evaluations")
    settings: dict[str, Any] = {"fmax": fmax, "both_ways": both_ways, "evaluations": evaluations}
    wavefront = _Wavefront(atoms, grid, constraints_in(held, "held"), settings, progress)
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
    results = ResultFolder(folder, PLAN, plan, FILES, "a scan")
    results.refuse_others()
    with results.taken():
        wavefront.place = results.path / PLACE
        wavefront.place.mkdir(exist_ok=True)
        return wavefront.run()


class _Wavefront:
    """What is held at each point, its energies and forces; which point is relaxed next, and from where."""

    def __init__(
        self, atoms: Atoms, grid: Grid, held: list[Constraint], settings: dict[str, Any], progress: Progress | None
    ) -> None:
        if atoms.calc is None:
            raise InputError("the atoms have no calculator; give them one: atoms.calc = ...", item="calculator")
        self.grid, self.settings, self.progress = grid, settings, progress
        self.atoms = atoms.copy()
        self.atoms.calc = atoms.calc
        forces_only = [item for item in atoms.constraints if isinstance(item, FORCES_ONLY)]
        held = [*translated(atoms, [item for item in atoms.constraints if item not in forces_only]), *held]
        self.atoms.set_constraint(forces_only)
        self.start = self.atoms.get_positions()
        bare = self.atoms.copy()
        bare.set_constraint()
        kept = Constraints(held)
        rank = kept.engine(bare).rank
        # With the targets that were left open.
        self.scan = Scan(grid, bare, list(kept.constraints))
        for n, item in enumerate(grid.coordinates):
            # Says what is undefined at the start, and which atoms there are not.
            with_it = self._engine([c.with_target(None) for c in grid.coordinates[: n + 1]])
            if with_it.rank != rank + n + 1:
                raise ConstraintError(
                    f"{item.row_name(0)} depends on what else is held; it cannot take other values. Leave out "
                    "what holds it, or scan another coordinate",
                    atoms=item.atoms[0].tolist(),
                )
            r = self.start[item.atoms]
            for v in grid.values[n]:
                item.with_target(float(v)).check(r, 0.0, 0)
        measured = Constraints([c.with_target(None) for c in grid.coordinates]).engine(bare).constraint_set
        self._measured = [float(v) for v in measured.measure(self.start)]
        self._bonds = bonds_of(self.atoms)
        warn_of_gaps({item.row_name(0): item for item in grid.coordinates}, self._bonds)
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
        bad = ~np.isfinite(forces).all(axis=1)
        if bad.any():
            atom = int(np.argmax(bad))
            raise NonFiniteError(f"the force on atom {atom} is not finite: {forces[atom]}", item="force", atom=atom)
        return energy, forces

    def relaxed(self, point: Point, source: Attempt | None) -> Relaxed:
        """The minimum at a point, from the structure of another relaxation or from the first one."""
        fmax, evaluations = self.settings["fmax"], self.settings["evaluations"]
        before = self.start if source is None else source.positions
        reset = getattr(self.atoms.calc, "reset", None)
        if reset is not None:
            # What a calculator remembers, such as a density, would make the bits depend on what was done before.
            reset()
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
            energy = self.evaluate(found.positions)[0]
            return Relaxed(found.positions, energy, found.largest, found.evaluations)
        internals, memory = Internals(self.atoms.numbers, x, motion.lattice), None
        if source is not None and len(source.memory):
            memory = internals.remapped(source.memory, source.terms)
        return Descent(motion, self.evaluate, internals, memory).relaxed(x, fmax, evaluations)

    # -- from point to point --------------------------------------------------------------------

    def run(self) -> Scan:
        for point in sorted(self.grid.points, key=lambda p: self.grid.apart(p, self._measured)):
            self._queue.append((point, None))
            self._drain()
            if self.scan.best:
                break
        while self._reach_the_rest() or self._try_again():
            self._drain()
        if not self.scan.best:
            assert self._first is not None
            raise self._first
        return self.scan

    def _drain(self) -> None:
        while self._queue:
            point, source = self._queue.popleft()
            if (point, source) in self._tried:
                continue
            if source is not None and self._handed[self.scan.attempts[source].point] != source:
                continue  # a lower one is on its way
            if not self.settings["both_ways"] and point in self.scan.best:
                continue
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
            raise UnreadableError(
                f"relaxation {len(attempts)} in {self.place} is of another scan; take another folder", item="folder"
            )
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
