"""Run a scene through methods and measure, for each, what error it makes for what cost.

Every method starts from the same state with the same forces and is compared with the same reference
solution at the horizon. Times are medians over steps, after the kernels have been compiled and loaded.
"""

from __future__ import annotations

import os
import platform
import signal
import subprocess
import textwrap
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from time import perf_counter
from typing import Any, Literal

import numpy as np

from kcons.errors import InputError, UnsupportedError
from kcons.methods import chosen
from kcons.runs import Method, Run
from kcons.scenes import Reference, Scene
from kcons.steppers import Rattle, State, System

#: Packages whose versions go into the result.
PACKAGES = ("kcons", "numpy", "scipy", "numba", "ase", "openmm", "tblite", "matplotlib")

#: A first step below this may be slow only because it is the first.
FIRST_STEP_DOUBT = 0.5

#: A host is interrupted within a step after so many budgets.
PATIENCE = 3

Status = Literal["ok", "floor", "thermostat", "partial", "failed", "not run"]


@dataclass(frozen=True)
class Measurement:
    """One method at one time step (or tolerance). Times in seconds unless said; None where not known.

    Attributes
    ----------
    setting : float
        Time step in the scene's shown unit, or relative tolerance of an adaptive method.
    status : {'ok', 'floor', 'thermostat', 'partial', 'failed', 'not run'}
        'floor': nothing is held, only the cost is stated. 'thermostat': the trajectory is not to be that of the
        reference, so that there is no error. 'partial': stopped for the budget; cost only.
    error : float
        Root-mean-square distance an atom from the reference at the horizon.
    constraint_residual, velocity_residual : float
        max |sigma| in natural units, and max |A v|/v_rms with rows of unit norm, after the last step.
    energy_slope, energy_slope_error : float
        Linear fit of the total energy against time and its standard error, a degree of freedom and `long_time`.
    step_seconds, constraint_seconds : float
        Median wall time of a step, and of the constraints' part of it where a host tells.
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
    """

    scene: Mapping[str, Any]
    reference: Mapping[str, Any]
    settings: Mapping[str, Any]
    environment: Mapping[str, Any]
    measurements: Sequence[Measurement] = field(default_factory=list)
    remarks: Sequence[str] = ()

    def of(self, method: str, status: Status = "ok") -> list[Measurement]:
        """Measurements of one method, coarsest first."""
        return [m for m in self.measurements if m.method == method and m.status == status]

    def observed_order(self, method: str) -> float | None:
        """Slope of log(error) against log(time step) at the two finest steps whose error is above the reference's.

        None with fewer than two such steps. Coarser steps are left out: high orders show at small steps only.
        """
        floor = 5 * float(self.reference["error"])
        used = [m for m in self.of(method) if not m.adaptive and m.error is not None and m.error > max(floor, 1e-12)]
        if len(used) < 2:
            return None
        steps, errors = np.log([(m.setting, float(m.error or 0)) for m in used[-2:]]).T
        return float((errors[1] - errors[0]) / (steps[1] - steps[0]))

    def to_dict(self) -> dict[str, Any]:
        """Plain data, as it goes to JSON."""
        orders = {name: self.observed_order(name) for name in dict.fromkeys(m.method for m in self.measurements)}
        return {
            "format": "kcons-compare-1",
            "scene": dict(self.scene),
            "reference": dict(self.reference),
            "settings": dict(self.settings),
            "environment": dict(self.environment),
            "remarks": list(self.remarks),
            "observed_order": {name: order for name, order in orders.items() if order is not None},
            "measurements": [asdict(m) for m in self.measurements],
        }


class Watcher:
    """Told what is going on. This one keeps silent; the command line shows progress bars."""

    def begin(self, what: str, total: float) -> None:
        """A piece of work of `total` units starts."""

    def advance(self, done: float) -> None:
        """So much of it is done."""

    def end(self) -> None:
        """It is over."""


def compare(
    scene: Scene,
    *,
    methods: Iterable[str] | None = None,
    budget: float = 30.0,
    watcher: Watcher | None = None,
    settings: Mapping[str, Any] | None = None,
) -> Comparison:
    """Run `scene` through `methods`.

    Parameters
    ----------
    scene : Scene
    methods : iterable of str, optional
        Names out of `kcons.methods.METHODS`, 'openmm' for those of OpenMM, or 'all' alone; by default the usual
        ones for the scene.
    budget : float
        Seconds for each method over all its time steps. One that is predicted to exceed it is stopped
        after a step, which is reported as such.
    watcher : Watcher, optional
    settings : mapping, optional
        What else to record with the result.

    Raises
    ------
    InputError
        Unknown method; a budget that is not positive.
    KconsError
        If the reference solution cannot be computed.
    """
    if not budget > 0:
        raise InputError(f"the budget is {budget} s; give a positive number of seconds", item="budget")
    picked = chosen(methods, scene)
    if scene.openmm is not None:
        scene.openmm.patience = budget
    watching = watcher or Watcher()
    watching.begin("loading kernels" if kernels_cached() else "compiling kernels (once)", 1)
    warm_up(scene, picked)
    watching.advance(1)
    watching.end()

    watching.begin("reference solution", 1)
    reference = scene.reference(lambda done, total: watching.advance(done / total))
    watching.end()

    measurements: list[Measurement] = []
    for method in picked:
        reason = method.refuses(scene)
        if reason is not None:
            measurements.append(Measurement(method.name, method.title, 0.0, method.adaptive, "not run", reason))
            continue
        measurements += _all_settings(scene, method, reference, budget, watching)
    unit = scene.units.time_unit
    return Comparison(
        scene={
            "name": scene.name,
            "title": scene.title,
            "atoms": scene.n_atoms,
            "rows": scene.motion.constraint_set.n_rows,
            "rank": scene.motion.rank,
            "degrees_of_freedom": scene.motion.degrees_of_freedom,
            "horizon": scene.horizon / unit,
            "units": {
                "length": scene.units.length,
                "energy": scene.units.energy,
                "time": scene.units.time,
                "long_time": scene.units.long_time,
            },
            "forces": scene.potential.name,
        },
        reference={"how": reference.how, "error": reference.error},
        settings={"methods": [m.name for m in picked], "budget_seconds": budget, **(settings or {})},
        remarks=list(dict.fromkeys(m.remark for m in picked if m.remark)),
        environment=environment(),
        measurements=measurements,
    )


def warm_up(scene: Scene, methods: Iterable[Method] = ()) -> None:
    """Compile or load every kernel that the scene and these methods need, outside of any timing."""
    motion = scene.motion
    x, v = scene.positions, scene.velocities
    f = scene.potential.forces(x)
    Rattle().step(System(motion, scene.potential.forces), State(x, v), min(scene.time_steps))
    motion.acceleration(x, v, f)
    motion.project_forces(x, f)
    for method in methods:
        if method.refuses(scene) is None:
            with suppress(Exception):  # what goes wrong is shown where it is measured
                method.warm_up(scene)


# -- one method -------------------------------------------------------------------------------------


def _all_settings(
    scene: Scene, method: Method, reference: Reference, budget: float, watcher: Watcher
) -> list[Measurement]:
    found: list[Measurement] = []
    begun = perf_counter()
    given_up: Measurement | None = None
    for setting in method.settings(scene):
        shown = setting if method.adaptive else setting / scene.units.time_unit
        planned = None if method.adaptive else round(scene.horizon / setting)
        common: dict[str, Any] = dict(
            method=method.name, title=method.title, setting=shown, adaptive=method.adaptive, steps_planned=planned
        )
        if found and perf_counter() - begun > budget:
            note = f"the budget of {budget:g} s is used up"
            found.append(Measurement(status="not run", note=note, **common))
            continue
        last = given_up or (found[-1] if found else None)
        if last is not None and last.step_seconds is not None:
            # A tighter tolerance takes at least as many steps as a looser one.
            left = budget - (perf_counter() - begun)
            if given_up is not None or last.step_seconds * (planned or last.steps) > left:
                given_up = last
                found.append(Measurement(status="not run", note=_too_slow(last.step_seconds, budget), **common))
                continue
        watcher.begin(f"{method.title}, {'rtol' if method.adaptive else 'dt'} {shown:g}", scene.horizon)
        found.append(_measure(scene, method, setting, reference, budget, begun + budget, watcher, common))
        watcher.end()
        if found[-1].status == "not run":  # it cannot run this scene at any step
            break
        if found[-1].status == "partial":
            given_up = found[-1]
            if given_up.step_seconds is None:  # not one step was done: no use in trying shorter ones
                break
    return found


@dataclass
class _Log:
    """What is written down at every advance: by one step, or by several of a host that runs by itself."""

    times: list[float] = field(default_factory=list)
    energies: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    constraints: list[float] = field(default_factory=list)
    evaluations: int = 0
    steps: int = 0


class _OverBudgetError(Exception):
    """The time is up."""


def _measure(
    scene: Scene,
    method: Method,
    setting: float,
    reference: Reference,
    budget: float,
    deadline: float,
    watcher: Watcher,
    common: dict[str, Any],
) -> Measurement:
    log = _Log()
    note = ""
    status: Status = "ok"
    run: Run | None = None
    begun = perf_counter()
    setup = None
    scene.potential.forget()
    try:
        with _interrupted_after(PATIENCE * budget), np.errstate(all="ignore"):
            run = method.start(scene, setting)
            setup = perf_counter() - begun
            note = _run_to_horizon(scene, run, method.holds, log, budget, deadline, watcher)
            status = "partial" if note else "ok"
    except _OverBudgetError:
        status = "partial"
        note = f"step {log.steps + 1} was not done after {duration(perf_counter() - begun)}"
    except UnsupportedError as error:
        return Measurement(status="not run", note=textwrap.shorten(str(error), 300), **dict(common, setting=0.0))
    except Exception as error:  # whatever a peer raises is a result, and is shown
        status = "failed"
        first = (str(error).strip().splitlines() or [""])[0]
        note = textwrap.shorten(f"step {log.steps + 1}: {type(error).__name__}: {first}", 300)
    common = dict(common, steps=log.steps, setup_seconds=setup, **_costs(scene, method, run, log))
    if run is None or not log.seconds:
        return Measurement(status=status, note=note, **common)
    if not method.holds:
        return Measurement(status="floor" if status == "ok" else status, note=note, **common)
    x, v = run.positions, run.velocities
    if not (np.all(np.isfinite(x)) and np.all(np.isfinite(v))):
        return Measurement(status="failed", note="positions are not finite", **common)
    sigma, tangency = scene.residuals(x, v, run.time)
    if not method.follows:
        shown: Status = "thermostat" if status == "ok" else status
        return Measurement(status=shown, note=note, constraint_residual=sigma, velocity_residual=tangency, **common)
    slope, slope_error = _energy_slope(scene, log)
    return Measurement(
        status=status,
        note=note,
        error=scene.deviation(x, reference.positions) if status == "ok" else None,
        constraint_residual=sigma,
        velocity_residual=tangency,
        energy_slope=slope,
        energy_slope_error=slope_error,
        **common,
    )


def _run_to_horizon(
    scene: Scene, run: Run, holds: bool, log: _Log, budget: float, deadline: float, watcher: Watcher
) -> str:
    """Advance to the horizon; the reason if it was given up for the budget."""
    potential, masses = scene.potential, scene.masses[:, None]

    def write_down() -> None:
        log.times.append(run.time)
        energy = run.own_energy()
        if energy is None:
            v = run.velocities
            energy = potential.watched_energy(run.positions) + 0.5 * float(np.sum(masses * v * v))
        log.energies.append(energy)

    def evaluations_so_far() -> int:
        own = run.own_evaluations()
        return potential.evaluations if own is None else own

    write_down()
    while not run.finished:
        if not holds:
            run.rewind()
        evaluations, held = evaluations_so_far(), run.constraints.seconds
        start = perf_counter()
        run.advance()
        now = perf_counter()
        log.seconds.append((now - start) / run.steps)
        log.constraints.append((run.constraints.seconds - held) / run.steps)
        log.evaluations += evaluations_so_far() - evaluations
        log.steps += run.steps
        write_down()
        watcher.advance(run.time)
        if run.finished:
            break
        first = len(log.seconds) == 1
        to_go = run.steps * (scene.horizon - run.time) / (run.time - log.times[-2])
        doubtful = first and log.seconds[0] < FIRST_STEP_DOUBT
        if now + log.seconds[-1] * to_go > deadline and not doubtful and (len(log.seconds) <= 2 or now > deadline):
            return _too_slow(log.seconds[-1], budget)
    return ""


def _too_slow(step_seconds: float, budget: float) -> str:
    return f"at {duration(step_seconds)} a step, the steps to the horizon exceed the budget of {budget:.3g} s"


def _costs(scene: Scene, method: Method, run: Run | None, log: _Log) -> dict[str, float | None]:
    if run is None or not log.seconds or run.time <= 0:
        return {}
    # The first step pays for what a host sets up lazily.
    counted = slice(1, None) if len(log.seconds) > 1 else slice(None)
    step = run.own_step_seconds() or float(np.median(log.seconds[counted]))
    elapsed = run.time / scene.units.long_time_unit
    return {
        "step_seconds": step,
        "constraint_seconds": float(np.median(log.constraints[counted])) if method.holds and run.divided else None,
        "evaluations_per_time": log.evaluations / elapsed,
        "seconds_per_time": step * log.steps / elapsed,
    }


def _energy_slope(scene: Scene, log: _Log) -> tuple[float | None, float | None]:
    """Least-squares slope of the energy and its standard error, a degree of freedom and `long_time`."""
    if len(log.times) < 4:
        return None, None
    if not np.all(np.isfinite(log.energies)):
        return None, None
    t = np.array(log.times) / scene.units.long_time_unit
    e = np.array(log.energies) / max(scene.motion.degrees_of_freedom, 1)
    t, e = t - t.mean(), e - e.mean()
    slope = float(t @ e / (t @ t))
    left_over = float(np.sum((e - slope * t) ** 2))
    return slope, float(np.sqrt(left_over / (len(t) - 2) / (t @ t)))


def duration(seconds: float) -> str:
    """Three digits and a unit, for example '12.5 ms'."""
    for size, limit, unit in ((1e-9, 1e-6, "ns"), (1e-6, 1e-3, "µs"), (1e-3, 1.0, "ms"), (1.0, 600.0, "s")):
        if seconds < 0.9995 * limit:
            return f"{seconds / size:#.3g}".rstrip(".") + f" {unit}"
    return f"{seconds / 3600:.1f} h" if seconds >= 7200 else f"{seconds / 60:.0f} min"


@contextmanager
def _interrupted_after(seconds: float) -> Iterator[None]:
    """Raise _OverBudgetError in the body after `seconds`, where the system can do that (Unix, main thread)."""
    if not hasattr(signal, "setitimer") or threading.current_thread() is not threading.main_thread():
        yield
        return

    def ring(*_: Any) -> None:
        raise _OverBudgetError

    previous = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, max(seconds, 1e-3))
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, previous)


# -- where and with what ----------------------------------------------------------------------------


def environment() -> dict[str, Any]:
    """Machine, versions, commit and date."""
    versions: dict[str, str | None] = {}
    for name in PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = None
    return {
        "cpu": _processor(),
        "cores": os.cpu_count(),
        "threads": 1,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "versions": versions,
        "commit": _commit(),
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
    }


def kernels_cached() -> bool:
    """Whether compiled kernels of an earlier run are on disk beside the package (or where NUMBA_CACHE_DIR says)."""
    here = Path(os.environ.get("NUMBA_CACHE_DIR") or Path(__file__).parent)
    return next(here.rglob("*.nbi"), None) is not None


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def _commit() -> str | None:
    """Commit of the checkout this file belongs to, with '+' if it was changed since; None outside of one."""

    def git(*words: str) -> str:
        command = ["git", "-C", str(Path(__file__).parent), *words]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", Path(__file__).name)
        return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain", "--", ".") else "")
    except (OSError, subprocess.SubprocessError):
        return None
