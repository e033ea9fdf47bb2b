"""One window: where coordinates are held, from which side they come, and how it is sampled."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints import Constraint, Distance, MovingTarget
from kcons.constraints.arguments import ANGLE, LENGTH, Count, FromZero, Positive, as_float_array, checked
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray, nearest_image
from kcons.errors import InfeasibleError, InputError, UnsupportedError
from kcons.free_energy.held_coordinates import HeldCoordinates, named
from kcons.free_energy.series import Collector
from kcons.free_energy.torsion_force import warn_of_gaps
from kcons.motion.motion import Motion

#: What the sides of a window and the directions of a pull are called.
SIDES, DIRECTIONS = ("up", "down"), ("forward", "backward")
#: Steps of a structure on its way to a window where nothing can be turned, and what bonds may change by.
_WALK, _STRETCHED = 20, 0.1


@dataclass(frozen=True)
class Window:
    """Coordinates held at `target`, pulled there from `start`; both in the units of the MD engine.

    `side` is 'up' or 'down' for windows, 'forward' or 'backward' for pulls, which begin in equilibrium at `start`.
    """

    number: int
    side: str
    start: tuple[float, ...]
    target: tuple[float, ...]
    seed: int

    @property
    def name(self) -> str:
        if self.side in SIDES:
            return f"window-{self.number:04d}-{self.side}"
        begin, end = ("_".join(f"{q:.6g}" for q in place) for place in (self.start, self.target))
        return f"pull-{begin}-to-{end}-{self.number:04d}"


@dataclass(frozen=True)
class Settings:
    """How every window is sampled, by Langevin dynamics.

    Attributes
    ----------
    temperature : float
        In K.
    timestep : float
        In fs.
    friction : float
        In 1/ps.
    relax, pull, equilibration, production : int
        Steps of relaxation where the window begins, and of each part of the run.
    every : int
        Steps from one sample to the next. Multipliers forget in 50 to 100 fs, and closer samples tell nothing more.
    """

    temperature: Positive = 300.0
    timestep: Positive = 1.0
    friction: Positive = 5.0
    relax: FromZero = 50
    pull: FromZero = 1000
    equilibration: FromZero = 2000
    production: Count = 20000
    every: Count = 50

    def __post_init__(self) -> None:
        if self.production // self.every < 32:
            raise InputError(
                f"production of {self.production} steps with a sample every {self.every} gives fewer than 32 samples; "
                "an error needs more; take a longer production, or a smaller `every`",
                item="production",
            )


Settings.__init__ = checked(Settings.__init__)  # type: ignore[method-assign]


class Sampler(ABC):
    """What samples windows in an MD engine; it is sent to other processes, so it can be pickled.

    Warns of torsions over no bonds, and refuses what is undefined at the initial structure or depends on other rows.

    Structure and rows are in the units of the engine, in which a length of 1 has `angstrom` angstrom. Groups are turned
    by the bonds `turning`; None where something is held otherwise.

    Attributes
    ----------
    names : tuple of str
    kJ : float
        The engine's unit of energy in kJ/mol.
    scales : ndarray, shape (d,)
        The units of the coordinates in angstrom and radian; formulas stay in the units they are written in.
    angles : tuple of bool or None
        Which coordinates are angles; None where the unit is that of a formula or a function.
    start, periods : ndarray, shape (d,)
        The coordinates at the initial structure; 0 for those without a period.
    """

    kJ: float

    def __init__(
        self,
        coordinates: Mapping[str, Constraint],
        held: Sequence[Constraint],
        positions: FloatArray,
        masses: FloatArray,
        cell: FloatArray | None,
        pbc: Any,
        bonds: IntArray,
        turning: IntArray | None,
        angstrom: float = 1.0,
    ) -> None:
        for name, item in named(coordinates).items():
            if item.n_rows != 1 or not item.holonomic:
                raise UnsupportedError(f"{name} is {item!r}; a coordinate of windows is one row that holds positions")
        self.coordinates = {name: item.with_target(None) for name, item in coordinates.items()}
        self.names = tuple(self.coordinates)
        kinds = [item.held for item in self.coordinates.values()]
        self.scales = np.array([angstrom if kind is LENGTH else 1.0 for kind in kinds])
        self.angles = tuple({ANGLE: True, LENGTH: False}.get(kind) for kind in kinds)
        self._frame = {"masses": masses, "cell": cell, "pbc": pbc}
        self.positions, self.bonds, self.turning = positions, bonds, turning
        everything = self._set([*held, *self.coordinates.values()])
        #: With the targets that were left open.
        self.held = list(everything.constraints[: len(held)])
        there = HeldCoordinates(everything, self.coordinates, positions)
        self.start, self.periods = everything.measure(positions)[there.rows], there.periods
        warn_of_gaps(self.coordinates, bonds)

    @property
    @abstractmethod
    def digest(self) -> str:
        """Of structure, forces and constraints: what a folder of windows belongs to."""

    @abstractmethod
    def simulation(self, window: Window, settings: Settings) -> Any:
        """A run at the start of a window, relaxed there, and without velocities.

        It has ``hold(begin, end, seed, velocities)``, to go on with the coordinates moving from `begin` to `end` in the
        steps of a pull, or at rest where these agree (`velocities` is the seed of new ones at the temperature of the
        settings, or None to keep those that there are); ``step(steps)``; ``run(steps, every, take)``, to call `take`
        with the state after every so many steps; and ``state()``: positions, velocities, forces and time.
        """

    def sample(self, window: Window, settings: Settings, file: Path) -> None:
        """Run the window, and write its `Series` to `file` once it is finished."""
        run = self.simulation(window, settings)
        if settings.pull:
            run.hold(window.start, window.target, window.seed, window.seed)
            run.step(settings.pull)
        # New velocities: those of the pull's end have its rate.
        run.hold(window.target, window.target, window.seed + 2, window.seed + 1)
        run.step(settings.equilibration)
        collector = Collector(self.measured(window.target))
        run.run(settings.production, settings.every, collector.add)
        collector.series.save(file)

    def pull(self, window: Window, settings: Settings, file: Path) -> None:
        """Equilibrate at the start, pull to the target, and write the `Series` of the pull, every step of it."""
        run = self.simulation(window, settings)
        run.hold(window.start, window.start, window.seed + 2, window.seed)
        run.step(settings.equilibration)
        run.hold(window.start, window.target, window.seed, None)
        collector = Collector(self.measured(window.target))
        collector.add(*run.state())
        run.run(settings.pull, 1, collector.add)
        collector.series.save(file)

    # -- what is held ---------------------------------------------------------------------------

    def _set(self, rows: list[Constraint]) -> ConstraintSet:
        return ConstraintSet(rows, self.positions, **self._frame)

    def measured(self, values: ArrayLike) -> HeldCoordinates:
        """What samples are taken by."""
        return HeldCoordinates(
            self._set([*self.held, *self.at(values)]), self.coordinates, self.positions, bonds=self.turning
        )

    def at(self, values: ArrayLike) -> list[Constraint]:
        """The coordinates held at `values`."""
        pairs = zip(self.coordinates.values(), np.asarray(values), strict=True)
        return [item.with_target([float(value)]) for item, value in pairs]

    def towards(self, begin: Sequence[float], end: Sequence[float], duration: float) -> list[Constraint]:
        """The coordinates moved at a constant rate from time 0 on; at rest where both ends are the same."""
        if tuple(begin) == tuple(end):
            return self.at(begin)
        rows = zip(self.coordinates.values(), begin, end, strict=True)
        return [
            item.with_target(MovingTarget(lambda t, a=a, b=b: a + (b - a) / duration * t))  # type: ignore[misc]
            for item, a, b in rows
        ]

    def placed(self, values: ArrayLike) -> tuple[Motion, FloatArray]:
        """The engine of a window, and the initial structure with groups turned and moved so that it is there.

        Within a ring nothing turns without bending angles. There it goes to the nearest point by small steps;
        `InfeasibleError` where neither way keeps the bonds.
        """
        motion = Motion(self._set([*self.held, *self.at(values)]), self.positions)
        try:
            return motion, motion.restore_positions(self.positions, bonds=self.bonds)
        except InfeasibleError:
            x = self.positions
            way = nearest_image(np.asarray(values, dtype=np.float64) - self.start, self.periods)
            for share in np.linspace(0.0, 1.0, _WALK + 1)[1:]:
                rows = self._set([*self.held, *self.at(self.start + share * way)])
                x = Motion(rows, x).restore_positions(x, bonds=[])
            held = {frozenset(row) for item in self.coordinates.values() for row in item.atoms.tolist()}
            bonds = [pair for pair in self.bonds.tolist() if frozenset(pair) not in held]
            lengths = self._set([Distance(np.array(bonds).reshape(-1, 2))])
            change = lengths.measure(x) / lengths.measure(self.positions) - 1
            if np.abs(change).max(initial=0.0) >= _STRETCHED:
                raise
            return motion, motion.restore_positions(x, bonds=[])


def digest_of(*parts: Any) -> str:
    """The same for the same numbers, texts and constraints, in any process."""
    found = hashlib.sha256()
    for part in parts:
        if isinstance(part, Constraint):
            data = [getattr(part, name) for name in (*part.per_row, *part.shared)]
            made = [getattr(getattr(part, name), "__qualname__", name) for name in part.functions]
            held = "moving" if isinstance(part.target, MovingTarget) else part.target
            part = (part.family, part.atoms, held, *data, *made)
        if isinstance(part, list | tuple):
            found.update(digest_of(*part).encode())
        else:
            found.update(part.tobytes() if isinstance(part, np.ndarray) else repr(part).encode())
    return found.hexdigest()[:16]


def places_of(targets: ArrayLike | Iterable[Sequence[float]], names: Sequence[str]) -> FloatArray:
    """Values of the coordinates, one row for each window, shape (n, d)."""
    listed = list(targets) if isinstance(targets, Iterable) and not isinstance(targets, np.ndarray) else targets
    places = np.array(as_float_array(listed, "targets"))
    places = places[:, None] if places.ndim == len(names) == 1 else places
    if places.ndim != 2 or places.shape[1] != len(names) or not len(places) or not np.all(np.isfinite(places)):
        raise InputError("targets must be finite numbers, one row for each window", item="targets")
    return places


def approach_of(approach: ArrayLike, names: Sequence[str]) -> FloatArray:
    """From how far away each coordinate is pulled, shape (d,)."""
    given = as_float_array(approach, "approach")
    if given.shape not in ((), (len(names),)) or not np.isfinite(given).all():
        raise InputError(
            f"approach is {approach!r}; give a finite number, or one for each of {', '.join(names)}", item="approach"
        )
    return np.broadcast_to(given, (len(names),))
