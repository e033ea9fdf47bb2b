"""One window and its settings; many of them run by any executor, kept as they finish; what they have found, shown."""

from __future__ import annotations

import hashlib
import math
import os
import traceback
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor, as_completed
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import asdict, dataclass, field
from functools import cached_property
from io import BytesIO
from multiprocessing import get_context
from multiprocessing.connection import Connection
from os import PathLike
from pathlib import Path
from signal import SIG_IGN, SIGINT, signal
from threading import Thread
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import logsumexp

from kcons.constraints import Constraint, Distance, MovingTarget
from kcons.constraints.arguments import (
    ANGLE,
    LENGTH,
    Count,
    FromZero,
    Positive,
    Rng,
    as_float_array,
    checked,
    positive,
    seed_from,
    whole_number,
)
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray, nearest_image
from kcons.errors import InfeasibleError, InputError, KconsError
from kcons.free_energy.averages import agreement
from kcons.free_energy.held_coordinates import HeldCoordinates, named, warn_of_gaps
from kcons.free_energy.profiles.profile import Profile, Surface, fit_surface, integrate, plot_profile
from kcons.free_energy.profiles.pulls import MIN_PULLS, Pulled, pull_free_energy
from kcons.free_energy.series import Collector, MeanForce, Series, mean_force, thermal_multipliers
from kcons.motion.motion import Motion
from kcons.steppers.files import ResultFolder, text, write_files
from kcons.thermostats.correlated_series import FEW_INDEPENDENT

if TYPE_CHECKING:
    from rich.table import Table

#: What the sides of a window and the directions of a pull are called.
SIDES, DIRECTIONS = ("up", "down"), ("forward", "backward")
#: Steps of a structure on its way to a window where nothing can be turned, and what bonds may change by.
_WALK, _STRETCHED = 20, 0.1


@dataclass(frozen=True)
class Window:
    """Coordinates held at `target`, pulled there from `start`; both in the units of the MD engine.

    `side` is 'up' or 'down' for windows, 'forward' or 'backward' for pulls, which begin in equilibrium at `start` and
    are counted by `number`.
    """

    side: str
    start: tuple[float, ...]
    target: tuple[float, ...]
    rng: int
    number: int = 0

    @property
    def name(self) -> str:
        begin, end = ("_".join(f"{q:.9g}" for q in place) for place in (self.start, self.target))
        return f"window-{end}-{self.side}" if self.side in SIDES else f"pull-{begin}-to-{end}-{self.number:04d}"

    @property
    def seed(self) -> int:
        return int(np.random.SeedSequence([self.rng, *self.name.encode()]).generate_state(1)[0])


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
        self.coordinates = {name: item.with_target(None) for name, item in named(coordinates).items()}
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
        warn_of_gaps(self.coordinates, bonds, stacklevel=4)

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
        (place,) = places_of([np.atleast_1d(values)], self.names).tolist()
        return [item.with_target(value) for item, value in zip(self.coordinates.values(), place, strict=True)]

    def towards(self, begin: Sequence[float], end: Sequence[float], duration: float) -> list[Constraint]:
        """The coordinates moved at a constant rate from time 0 on; at rest where both ends are the same."""
        if tuple(begin) == tuple(end):
            return self.at(begin)
        ways = [lambda t, a=a, b=b: a + (b - a) / duration * t for a, b in zip(begin, end, strict=True)]  # type: ignore[misc]
        return [item.with_target(MovingTarget(way)) for item, way in zip(self.coordinates.values(), ways, strict=True)]

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
            for place in np.linspace(self.start, self.start + way, _WALK + 1)[1:]:
                x = Motion(self._set([*self.held, *self.at(place)]), x).restore_positions(x, bonds=[])
            held = {frozenset(row) for item in self.coordinates.values() for row in item.atoms.tolist()}
            lengths = self._set([Distance([pair for pair in self.bonds.tolist() if frozenset(pair) not in held])])
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
        said = f"targets must be finite numbers, one of {' and '.join(names)} for each window"
        raise InputError(said, item="targets")
    return places


#: Boltzmann's constant in kJ/mol/K.
BOLTZMANN = 0.00831446261815324
#: How often a window is begun again whose process was killed.
RETRIES = 3
#: Files of a folder of windows, those of `FreeEnergy` and of the command line included.
FILES = ("window-*.npz", "pull-*.npz", "free_energy.json", "profile.csv", "profile.png")
#: Differences of the two sides that are less probable than this are marked, and widen errors.
UNLIKELY = 0.01
#: What a window is in free_energy.json, by attributes of `WindowResult`.
_KEYS = {"value": "value", "mean force": "force", "covariance": "covariance"}
_KEYS |= {"raw multiplier": "raw", "p_value": "p_value", "samples": "n", "independent samples": "n_effective"}
#: Windows of a torsion do not go around a gap that is wider than any other by more than this.
_HOLE = 2.001
#: Of angles, of lengths, and of formulas and functions: as places are shown, and what mean forces are by.
_SHOWN = {True: "degrees", False: "angstrom", None: "own unit"}
_PER = {**_SHOWN, True: "radian"}


@dataclass(frozen=True, eq=False, kw_only=True)
class WindowResult(MeanForce):
    """The mean force where one or several coordinates were held, in kJ/mol, angstrom and radian.

    Where both sides differ by more than chance (p < 0.01), neither knows its own error: half their difference is one
    error more.

    Attributes
    ----------
    sides : dict of str to MeanForce
        From below and from above, in the units of the MD engine.
    p_value : float
        Probability of a larger difference between the sides if both were equilibrated; NaN with one side.
    """

    sides: dict[str, MeanForce]
    p_value: float


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
    kept : int
        Runs of these windows that were finished before.
    """

    names: tuple[str, ...]
    periods: FloatArray
    windows: list[WindowResult]
    failed: dict[str, str] = field(default_factory=dict)
    angles: tuple[bool | None, ...] = ()
    kept: int = 0

    @cached_property
    def profile(self) -> Profile:
        """Free energy along the only coordinate, kJ/mol."""
        if len(self.names) != 1:
            raise InputError(f"there are {len(self.names)} coordinates; see surface", item="coordinates")
        if self.failed and not self.windows:
            name, why = next(iter(self.failed.items()))
            raise InputError(f"all windows failed, so that there is no profile; {name}: {why}", item="failed")
        f, e = (np.array([getattr(w, name)[0] for w in self.windows]) for name in ("force", "error"))
        x, (period,) = self._places()
        return integrate(x[:, 0], f, e, period=period)

    @cached_property
    def surface(self) -> Surface:
        """Free energy in all coordinates, kJ/mol."""
        x, periods = self._places()
        f = np.array([w.force for w in self.windows])
        return fit_surface(x, f, np.array([w.covariance for w in self.windows]), periods=periods)

    def _places(self) -> tuple[FloatArray, list[float | None]]:
        """Where the windows are, shape (n, d), and the period of each coordinate that they go all around."""
        x = np.array([w.value for w in self.windows]).reshape(-1, len(self.names))
        columns = zip(x.T, self.periods.tolist(), strict=True)
        return x, [period if self._in_one_turn(column, period) else None for column, period in columns]

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

    def _profile(self) -> Profile | str:
        """The profile along the only coordinate; otherwise, where there could be one, why there is none."""
        try:
            return self.profile if len(self.names) == 1 else ""
        except InputError as error:
            return f"no profile: {error}"

    def table(self) -> Table:
        """The windows, one in a line; print it by rich."""
        from rich.table import Column, Table

        titles = [f"{name} ({_SHOWN[angle]})" for name, angle in zip(self.names, self.angles, strict=True)]
        titles += [f"dF/d {name}" for name in self.names] if len(self.names) > 1 else ["dF/dq"]
        titles += ["raw multiplier", "independent samples", "p of both sides"]
        made = Table(*(Column(title, justify="right") for title in titles))
        made.title = f"mean force (kJ/mol per {' or '.join(dict.fromkeys(_PER[angle] for angle in self.angles))})"
        for window in self.windows:
            made.add_row(
                *self._shown(window),
                *map(with_error, window.force, window.error),
                ", ".join(f"{raw:.2f}" for raw in window.raw),
                f"{window.n_effective:.0f}",
                "" if np.isnan(window.p_value) else f"{window.p_value:.2g}{'!' * bool(window.p_value < UNLIKELY)}",
            )
        return made

    def _shown(self, window: WindowResult) -> list[str]:
        return [f"{np.degrees(q) if angle else q:.4g}" for q, angle in zip(window.value, self.angles, strict=True)]

    def _places_where(self, what: Callable[[WindowResult], bool]) -> str:
        return "; ".join(", ".join(self._shown(window)) for window in self.windows if what(window))

    def summary(self) -> str:
        """A sentence or two."""
        lines = [f"{len(self.windows)} windows" + f", {self.kept} of their runs kept from before" * bool(self.kept)]
        if doubtful := self._places_where(lambda window: window.p_value < UNLIKELY):
            lines.append(
                f"runs from below and from above differ by more than chance at {doubtful} (marked !): something slow "
                "is not equilibrated there; sample longer, or look for the other coordinate"
            )
        if poor := self._places_where(lambda window: window.n_effective < FEW_INDEPENDENT):
            lines.append(
                f"fewer than {FEW_INDEPENDENT} independent samples at {poor}: errors there are not to be relied on; "
                "sample longer"
            )
        profile = self._profile()
        if isinstance(profile, Profile):
            gap = profile.difference(*(float(profile.x[pick(profile.F)]) for pick in (np.argmin, np.argmax)))
            lines.append(f"from the lowest to the highest point {with_error(*gap)} kJ/mol")
        elif profile:
            lines.append(profile)
        lines += [f"{name} failed: {why}" for name, why in self.failed.items()]
        return "\n".join(lines)

    def numbers(self) -> dict[str, Any]:
        """All of it as plain data."""
        return {
            "names": list(self.names),
            "units": "kJ/mol, angstrom, radian; of formulas and functions their own",
            "windows": [{key: np.asarray(getattr(w, of)).tolist() for key, of in _KEYS.items()} for w in self.windows],
            "failed": self.failed,
        }

    def write(self, folder: Path) -> list[Path]:
        """free_energy.json, and for one coordinate profile.csv and profile.png; returns their paths."""
        contents, profile = {"free_energy.json": text(self.numbers()).encode()}, self._profile()
        if isinstance(profile, Profile):
            (name,), (angle,), table, picture = self.names, self.angles, BytesIO(), BytesIO()
            table.write(f"{name} ({_PER[angle]}),F (kJ/mol),error (kJ/mol)\n".encode())
            np.savetxt(table, np.column_stack([profile.x, profile.F, profile.error]), fmt="%.8g", delimiter=",")
            figure = plot_profile(profile, coordinate=f"{name} / {_PER[angle]}", energy="(kJ/mol)")
            figure.savefig(picture, dpi=150, format="png")
            contents |= {"profile.csv": table.getvalue(), "profile.png": picture.getvalue()}
        for left in {"profile.csv", "profile.png"} - contents.keys():  # of other windows
            (folder / left).unlink(missing_ok=True)
        return write_files(folder, contents)


def with_error(value: float, error: float) -> str:
    """A number and its standard error to two significant digits, as text; of the number at most six decimals."""
    digits = min(max(1 - math.floor(math.log10(error)), 0), 6) if error else 2
    return f"{round(value, digits) + 0.0:.{digits}f} ± {f'{error:.1e}' if digits == 6 else f'{error:.{digits}f}'}"


def combine_sides(target: FloatArray, sides: dict[str, MeanForce], sampler: Sampler) -> WindowResult:
    """The mean of both sides, and how probable their difference is."""
    per = sampler.kJ / sampler.scales
    forces, raws, covariances, n, effective = (
        np.array([getattr(side, name) for side in sides.values()])
        for name in ("force", "raw", "covariance", "n", "n_effective")
    )
    forces, together = forces * per, covariances.sum(axis=0) * np.outer(per, per)
    covariance, chance = together / len(sides) ** 2, math.nan
    if len(sides) == 2:
        chance = agreement(forces[0], forces[1], together)
        if chance < UNLIKELY:
            half = (forces[0] - forces[1]) / 2
            covariance = covariance + np.outer(half, half)
    means = (forces.mean(axis=0), covariance, per * raws.mean(axis=0), int(n.sum()), float(effective.sum()))
    return WindowResult(next(iter(sides.values())).names, target, *means, sides=sides, p_value=chance)


class Windows:
    """Windows of one sampler in one folder.

    Parameters
    ----------
    sampler : Sampler
        `AseWindows` or `OpenMMWindows`.
    folder : path
        Where finished windows are kept, one file each. A later run with the same sampler and settings goes on there;
        one at a time.
    settings : Settings, optional
    both_sides : bool
        Sample each window twice, pulled there from below and from above: their difference shows whether it is
        equilibrated.
    approach : float or array_like, shape (d,)
        From how far away it is pulled, in angstrom and radian.
    rng : int, numpy.random.Generator or None
        A folder goes on with the same number only.
    executor : Executor, optional
        Anything with the interface of `concurrent.futures`, such as ``Client(address).get_executor(pure=False)`` of
        Dask. By default processes of this machine.
    workers : int, optional
        How many of these; by default one for each core.
    progress : callable, optional
        ``progress(finished, all)``.

    Raises
    ------
    KconsError
        A coordinate that is undefined at the structure or depends on other constraints.
    OccupiedError
        The folder has windows of other settings, or other files of their names; in `run`, `improve` and `pull`,
        another run writes there.
    """

    def __init__(
        self,
        sampler: Sampler,
        folder: str | PathLike[str],
        settings: Settings | None = None,
        *,
        both_sides: bool = True,
        approach: ArrayLike = 0.1,
        rng: Rng = 1,
        executor: Executor | None = None,
        workers: int | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        self.sampler, self.executor, self.progress = sampler, executor, progress
        self.workers = os.cpu_count() or 1 if workers is None else whole_number(workers, "workers")
        self.settings = settings or Settings()
        self.both_sides, self.seed = both_sides, seed_from(rng)
        self._targets: dict[tuple[float, ...], None] = {}
        self._failed: dict[str, str] = {}
        self._made: set[str] = set()  # not kept from before
        given = as_float_array(approach, "approach")
        if given.shape not in ((), (len(sampler.names),)) or not np.isfinite(given).all():
            remedy = f"give a finite number, or one for each of {', '.join(sampler.names)}"
            raise InputError(f"approach is {approach!r}; {remedy}", item="approach")
        self.approach: FloatArray = np.broadcast_to(given, (len(sampler.names),))
        mine: dict[str, Any] = {"coordinates": list(sampler.names), "system": sampler.digest}
        mine |= {"settings": asdict(self.settings), "seed": self.seed, "both sides": both_sides}
        mine |= {"approach": self.approach.tolist(), "start": sampler.start.tolist()}
        self._results = ResultFolder(folder, "settings.json", mine, FILES, "windows")
        self._results.refuse_others()
        self.folder = self._results.path

    # -- running --------------------------------------------------------------------------------

    def taken(self) -> AbstractContextManager[None]:
        """Keep other runs out of the folder, over several calls. Each of `run`, `improve` and `pull` does so itself."""
        return self._results.taken()

    def run(self, targets: ArrayLike | Iterable[Sequence[float]]) -> FreeEnergy:
        """Sample windows at `targets`, but for those that are finished already.

        Parameters
        ----------
        targets : array_like, shape (n,) or (n, d)
            In angstrom and radian.

        Returns
        -------
        FreeEnergy
            Of all windows that were asked for. One failed window does not stop the others; `failed` says why.
        """
        with self.taken():
            return self._run(map(tuple, places_of(targets, self.sampler.names).tolist()))

    def _run(self, places: Iterable[tuple[float, ...]]) -> FreeEnergy:
        # Places that are one but for rounding have one file, which counts once.
        known = {self._jobs(place)[0].name: place for place in self._targets}
        asked = dict.fromkeys(known.setdefault(self._jobs(place)[0].name, place) for place in places)
        self._targets |= asked
        jobs = [job for place in asked for job in self._jobs(place)]
        missing = [job for job in jobs if not self.file(job).exists()]
        self._made.update(job.name for job in missing)
        failed = self._sample(missing, len(jobs))
        for job in jobs:
            self._failed.pop(job.name, None)
        self._failed |= failed
        return self.result()

    def improve(self, error: float, most: int, *, below: float | None = None, at_once: int = 1) -> FreeEnergy:
        """Add windows where they help most until the profile's largest standard error is below `error` (kJ/mol).

        Parameters
        ----------
        error : float
        most : int
            Never more than so many windows.
        below : float, optional
            Of `Profile.next_windows`: errors higher up do not count.
        at_once : int
            How many are added before the profile is looked at again: as many as there are workers.
        """
        positive(error, "error")
        whole_number(most, "most")
        with self.taken():
            result = self.result()
            while len(self._targets) < most:
                profile = result.profile
                if profile.error[profile.lower_than(np.inf if below is None else below)].max() <= error:
                    break
                places = profile.next_windows(min(at_once, most - len(self._targets)), below=below)
                failed, known = len(self._failed), len(self._targets)
                result = self._run((place,) for place in places)
                if len(self._failed) > failed or len(self._targets) == known:
                    break
        return result

    def _jobs(self, place: tuple[float, ...]) -> list[Window]:
        """The runs of a window; without a pull they begin where they end."""
        target = np.array(place)
        # Angles end at 0 and 180 degrees: half the way there at most.
        ends = np.array([angle is True for angle in self.sampler.angles]) & (self.sampler.periods == 0)
        room = np.where(ends, np.minimum(target, np.pi - target) / 2, np.inf)
        approach = np.clip(self.approach if self.settings.pull else 0.0, -room, room)
        ways = zip(SIDES[: 1 + self.both_sides], (-1, 1), strict=False)
        return [self._job(side, target + sign * approach, target) for side, sign in ways]

    def _job(self, side: str, *ends: FloatArray, number: int = 0) -> Window:
        """A run from one place to another; the same one whenever it is asked for."""
        start, target = (tuple((end / self.sampler.scales).tolist()) for end in ends)
        return Window(side, start, target, self.seed, number)

    def pull(self, start: ArrayLike, end: ArrayLike, count: int = 20) -> Pulled:
        """F(end) - F(start) from the works of pulls both ways, kJ/mol, by BAR.

        Each pull begins in equilibrium (`Settings.equilibration`), takes `Settings.pull` steps at a constant rate, and
        is recorded at every step. Finished ones are kept.

        Parameters
        ----------
        start, end : float or array_like, shape (d,)
            In angstrom and radian.
        count : int
            Pulls in each direction, 5 or more.

        Raises
        ------
        InputError
            No steps to pull in; a pull failed. Those that are finished are kept.
        """
        whole_number(count, "count", MIN_PULLS)
        if not self.settings.pull:
            raise InputError("settings.pull is 0; give the steps of a pull", item="pull")
        ends = np.vstack([places_of([np.atleast_1d(end)], self.sampler.names) for end in (start, end)])
        if np.array_equal(*ends):
            raise InputError("start and end of the pulls are the same; give two places", item="end")
        ways = zip(DIRECTIONS, (ends, ends[::-1]), strict=True)
        jobs = [[self._job(way, *places, number=number) for number in range(count)] for way, places in ways]
        missing = [job for each in jobs for job in each if not self.file(job).exists()]
        with self.taken():
            failed = self._sample(missing, 2 * count)
        if failed:
            said = f"{len(failed)} of {2 * count} pulls failed; {': '.join(next(iter(failed.items())))}"
            raise InputError(f"{said}. Ask again: finished ones are kept", item="pull")
        kJ, kT = self.sampler.kJ, BOLTZMANN * self.settings.temperature
        pulls = [[Series.load(self.file(job)) for job in each] for each in jobs]
        forward, backward = (
            np.array([series.work_of(thermal_multipliers(series, kT / kJ))[-1] * kJ for series in each])
            for each in pulls
        )
        # Pulls give the free energy of the held system; ln <Z^(-1/2)> at both ends makes it that of the coordinates.
        first, last = (logsumexp([-0.5 * series.log_det_z[0] for series in each]) for each in pulls)
        shift = kT * float(first - last)
        return pull_free_energy(forward + shift, backward - shift, thermal_energy=kT)

    def file(self, window: Window) -> Path:
        """Where a finished window is kept."""
        return self.folder / f"{window.name}.npz"

    def _sample(self, jobs: Sequence[Window], total: int) -> dict[str, str]:
        """Run windows or pulls, again where a process was killed; why those failed that did."""
        failed: dict[str, str] = {}
        left = list(jobs)
        for _ in range(1 + RETRIES if left else 0):
            try:
                with nullcontext(self.executor) if self.executor else _processes(self.workers, len(left)) as pool:
                    how = self.sampler, self.settings
                    running = {pool.submit(_sampled, *how, job, self.file(job)): job for job in left}
                    for future in as_completed(running):
                        error = future.exception()
                        if isinstance(error, BrokenExecutor):
                            continue
                        left.remove(running[future])
                        if error is not None:
                            failed[running[future].name] = "".join(traceback.format_exception_only(error)).strip()
                        if self.progress is not None:
                            self.progress(total - len(left), total)
            except BrokenExecutor:
                if self.executor is not None:
                    raise  # nothing can be sent to it any more
            if not left:
                break
        return failed | {job.name: _KILLED for job in left}

    # -- what came of it ------------------------------------------------------------------------

    def result(self) -> FreeEnergy:
        """Mean forces of the windows that are finished."""
        kT = BOLTZMANN * self.settings.temperature / self.sampler.kJ
        found, problems, kept = [], dict(self._failed), 0
        for target in self._targets:
            sides: dict[str, MeanForce] = {}
            for job in filter(lambda job: self.file(job).exists(), self._jobs(target)):
                kept += job.name not in self._made
                try:
                    with warnings.catch_warnings():
                        warnings.simplefilter("ignore", UserWarning)  # few independent samples: said of the window
                        sides[job.side] = mean_force(Series.load(self.file(job)), kT)
                except KconsError as error:
                    problems[job.name] = f"{type(error).__name__}: {error}"
            if sides:
                found.append(combine_sides(np.array(target), sides, self.sampler))
        found.sort(key=lambda w: w.value.tolist())
        return FreeEnergy(self.sampler.names, self.sampler.periods, found, problems, tuple(self.sampler.angles), kept)


#: What is said of a window whose process was killed.
_KILLED = "its process was killed each time (a script that starts processes does so below if __name__ == '__main__':)"


def _sampled(sampler: Sampler, settings: Settings, window: Window, file: Path) -> None:
    """In a worker: one window, unless another run has finished it meanwhile."""
    if not file.exists():
        (sampler.sample if window.side in SIDES else sampler.pull)(window, settings, file)


@contextmanager
def _processes(workers: int, jobs: int) -> Iterator[ProcessPoolExecutor]:
    """Processes of this machine, one thread each: they start anew, since OpenMM and OpenMP do not survive a fork.

    They end with what waits for them: at once where an error or a signal ends the block, or this process is killed.
    """
    context = get_context("spawn")
    theirs, mine = context.Pipe(duplex=False)
    with theirs, mine, ProcessPoolExecutor(min(workers, jobs), context, _begin_worker, (theirs,)) as pool:
        try:
            yield pool
        except BaseException:
            mine.close()
            pool.shutdown(cancel_futures=True)
            raise


def _begin_worker(run: Connection) -> None:
    for name in ("OMP_NUM_THREADS", "OPENMM_CPU_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    signal(SIGINT, SIG_IGN)  # Ctrl-C comes to all processes of a terminal; the run ends its workers itself
    Thread(target=_end_with, args=(run,), daemon=True).start()


def _end_with(run: Connection) -> None:
    """End this process as soon as nobody holds the other end of a pipe."""
    try:
        run.poll(None)  # nothing is ever sent
    finally:
        os._exit(1)
