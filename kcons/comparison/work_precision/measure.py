"""Run a test system through methods and measure, for each, what error it makes for what cost.

Every method starts from the same state with the same forces and is compared with the same reference
solution at the horizon. Times are medians over steps, after the kernels have been compiled and loaded; with `rounds`,
those of short runs are medians over rounds without observation (`kcons.comparison.work_precision.timing_rounds`).
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from kcons.comparison.methods.method import Method, OverBudgetError, Run, first_line, interrupted_after
from kcons.comparison.methods.methods import METHODS, chosen
from kcons.comparison.study.machine import environment, kernels_cached
from kcons.comparison.study.study import Watcher, interruptible
from kcons.comparison.study.tables import duration
from kcons.comparison.test_systems import Reference, TestSystem
from kcons.comparison.test_systems.potential import Potential
from kcons.comparison.work_precision import timing_rounds
from kcons.comparison.work_precision.measurement import Comparison, Measurement, Status
from kcons.comparison.work_precision.timing_rounds import Rounds
from kcons.constraints.compilation import clock
from kcons.errors import InputError, UnsupportedError
from kcons.steppers import Rattle, State, System
from kcons.thermostats.correlated_series import slope

#: A first step below so many seconds, or this part of the budget, may be slow only because it is the first.
FIRST_STEP_DOUBT, FIRST_STEP_SHARE = 0.5, 0.25

#: A run is timed again if it takes at most this part of a method's budget, and so many seconds.
REPEAT_SHARE, REPEAT_SECONDS = 0.2, 2.0
#: Points at which the forces are timed, and for how many seconds at most.
FORCE_POINTS, FORCE_SECONDS = 15, 0.5

#: An MD engine is interrupted within a step after so many budgets.
PATIENCE = 3


def compare(
    test_system: TestSystem,
    *,
    methods: Iterable[str] | None = None,
    budget: float = 30.0,
    watcher: Watcher | None = None,
    settings: Mapping[str, Any] | None = None,
    rounds: Rounds | None = None,
    reference: Reference | None = None,
    partial: bool = False,
) -> Comparison:
    """Run `test_system` through `methods`.

    Parameters
    ----------
    test_system : TestSystem
    methods : iterable of str, optional
        Names out of `methods.METHODS`, 'openmm' for those of OpenMM, or 'all' alone; by default the usual
        ones for the test system.
    budget : float
        Seconds for each method over all its time steps. One that is predicted to exceed it is stopped
        after a step, which is reported as such.
    watcher : Watcher, optional
    settings : mapping, optional
        What else to record with the result.
    rounds : Rounds, optional
        Runs that are short enough are timed again in rounds, after all others; how well times repeat is then known.
    reference : Reference, optional
        If it is known.
    partial : bool
        Whether Ctrl-C ends the comparison with what has been measured, which `settings["interrupted"]` then says.

    Raises
    ------
    InputError
        Unknown method; a budget that is not positive.
    KconsError
        If the reference solution cannot be computed.
    """
    if not budget > 0:
        raise InputError(f"the budget is {budget} s; give a positive number of seconds", item="budget")
    picked = chosen(methods, test_system)
    if test_system.openmm is not None:
        test_system.openmm.patience = budget
    watching = watcher or Watcher()
    with watching.piece("loading kernels" if kernels_cached() else "compiling kernels (once)", 1):
        warm_up(test_system, picked)

    if reference is None:
        reference = reference_of(test_system, watching)

    bench = Bench(test_system, reference, budget, watching, rounds)
    measurements: list[Measurement] = []
    margin = None
    with interruptible(lambda: len({m.method for m in measurements}), len(picked), "methods", partial) as interrupted:
        for method in picked:
            measurements += bench.all_settings(method)
        measurements, margin = bench.timed_again(measurements)
    unit = test_system.units.time_unit
    return Comparison(
        scene={
            "name": test_system.name,
            "title": test_system.title,
            "atoms": test_system.n_atoms,
            "rows": test_system.motion.constraint_set.n_rows,
            "rank": test_system.motion.rank,
            "degrees_of_freedom": test_system.motion.degrees_of_freedom,
            "horizon": test_system.horizon / unit,
            "units": {
                "length": test_system.units.length,
                "energy": test_system.units.energy,
                "time": test_system.units.time,
                "long_time": test_system.units.long_time,
            },
            "forces": test_system.potential.name,
            **({"error": "energy above the optimum"} if test_system.shortfall is not None else {}),
        },
        reference={"how": reference.how, "error": reference.error},
        settings={"methods": [m.name for m in picked], "budget_seconds": budget, **(settings or {}), **interrupted},
        remarks=[*interrupted.values(), *dict.fromkeys(m.remark for m in picked if m.remark)],
        environment=environment(),
        measurements=measurements,
        timing={
            "force_seconds": force_seconds(test_system),
            "repeats": 0 if rounds is None else rounds.least,
            "margin": margin,
        },
    )


def reference_of(test_system: TestSystem, watcher: Watcher) -> Reference:
    """The reference solution, with its progress shown."""
    with watcher.piece("reference solution", 1):
        return test_system.reference(lambda done, total: watcher.advance(done / total))


def force_seconds(test_system: TestSystem) -> float:
    """Median wall time of the forces beyond that of a spring on one atom, which is that of a call of NumPy.

    They take turns: a machine that slows down in between does it to both.
    """
    spring = Potential(lambda x: (0.5 * float(np.sum(x * x)), -x), "one spring")
    both = ((test_system.potential, test_system.positions), (spring, np.ones((1, 3))))
    for potential, x in both:
        potential.watched_energy(x)
        potential.forget()
    found: list[float] = []
    spent = 0.0
    while len(found) < FORCE_POINTS and spent < FORCE_SECONDS:
        times = []
        for potential, x in both:
            begun = clock()
            potential.watched_energy(x)
            times.append(clock() - begun)
        spent += sum(times)
        found.append(times[0] - times[1])
    return max(0.0, float(np.median(found)))


def warm_up(test_system: TestSystem, methods: Iterable[Method] = ()) -> None:
    """Compile or load every kernel that the test system and these methods need, outside of any timing."""
    motion = test_system.motion
    x, v = test_system.positions, test_system.velocities
    f = test_system.potential.forces(x)
    Rattle().step(System(motion, test_system.potential.forces), State(x, v), min(test_system.time_steps))
    motion.acceleration(x, v, f)
    motion.project_forces(x, f)
    for method in methods:
        if method.refuses(test_system) is None:
            with suppress(Exception):  # what goes wrong is shown where it is measured
                method.warm_up(test_system)


@dataclass(frozen=True)
class Bench:
    """Where the methods that run one test system are measured; `warm_up` comes first.

    Attributes
    ----------
    test_system : TestSystem
    reference : Reference
    budget : float
        Seconds for each method.
    watcher : Watcher
    rounds : Rounds or None
        In which short runs are timed again; None: times stay as they were observed.
    """

    test_system: TestSystem
    reference: Reference
    budget: float
    watcher: Watcher = field(default_factory=Watcher)
    rounds: Rounds | None = None

    def all_settings(self, method: Method) -> list[Measurement]:
        """One method at all its settings, as far as the budget goes."""
        reason = method.refuses(self.test_system)
        if reason is not None:
            return [Measurement(method.name, method.title, 0.0, method.adaptive, "not run", reason)]
        found: list[Measurement] = []
        budget, begun = self.budget, clock()
        given_up: Measurement | None = None
        for setting in method.settings(self.test_system):
            common = _about(self.test_system, method, setting)
            if found and clock() - begun > budget:
                note = f"the budget of {budget:g} s is used up"
                found.append(Measurement(status="not run", note=note, **common))
                continue
            last = given_up or (found[-1] if found else None)
            if last is not None and last.step_seconds is not None:
                # A tighter tolerance takes at least as many steps as a looser one.
                left = budget - (clock() - begun)
                if given_up is not None or last.step_seconds * (common["steps_planned"] or last.steps) > left:
                    given_up = last
                    found.append(Measurement(status="not run", note=_too_slow(last.step_seconds, budget), **common))
                    continue
            found.append(self.measure(method, setting, begun=begun))
            if found[-1].status == "not run":  # it cannot run this test system at any step
                break
            if found[-1].status == "partial":
                given_up = found[-1]
                if given_up.step_seconds is None:  # not one step was done: no use in trying shorter ones
                    break
        return found

    def timed_again(self, measurements: list[Measurement]) -> tuple[list[Measurement], float | None]:
        """Times of short runs from rounds that nobody observes, and how well they repeat.

        See `kcons.comparison.work_precision.timing_rounds.timed` and `margin` there.
        """
        if self.rounds is None:
            return measurements, None
        with self.watcher.piece("times of short runs, in rounds", self.rounds.most):
            return timing_rounds.timed(
                self.test_system,
                measurements,
                METHODS,
                self.rounds,
                limit=min(REPEAT_SHARE * self.budget, REPEAT_SECONDS),
                patience=PATIENCE * self.budget,
                whole=lambda method, setting: replace(self, watcher=Watcher()).measure(method, setting, watched=False),
                told=self.watcher.advance,
            )

    def measure(
        self, method: Method, setting: float, *, begun: float | None = None, watched: bool = True
    ) -> Measurement:
        """One method at one setting.

        Parameters
        ----------
        method : Method
        setting : float
            A time step in internal units, or a tolerance.
        begun : float, optional
            When the budget began to run, on the clock of `clock`; now by default.
        watched : bool
            Whether the constraints' part is timed, which costs a little.
        """
        test_system, budget = self.test_system, self.budget
        log = _Log()
        common = _about(test_system, method, setting)
        what = f"{method.title}, {'rtol' if method.adaptive else 'dt'} {common['setting']:g}"
        note = ""
        status: Status = "ok"
        run: Run | None = None
        now = clock()
        deadline = (now if begun is None else begun) + budget
        setup = None
        test_system.potential.forget()
        try:
            with (
                self.watcher.piece(what, test_system.horizon),
                interrupted_after(PATIENCE * budget),
                np.errstate(all="ignore"),
            ):
                run = method.start(test_system, setting)
                setup = clock() - now
                if not watched:
                    run.constraints.release()
                note = _run_to_horizon(test_system, run, method.holds, log, budget, deadline, self.watcher)
                status = "partial" if note else "ok"
        except OverBudgetError:
            status = "partial"
            note = f"step {log.steps + 1} was not done after {duration(clock() - now)}"
        except Exception as error:  # whatever a peer raises is a result, and is shown
            if isinstance(error, UnsupportedError) and not log.steps:
                note = textwrap.shorten(str(error), 300)
                return Measurement(status="not run", note=note, **dict(common, setting=0.0))
            status = "failed"  # a shorter step may succeed
            note = f"step {log.steps + 1}: {first_line(error)}"
        common = dict(common, steps=log.steps, setup_seconds=setup, **_costs(test_system, method, run, log))
        if run is None or not log.seconds:
            return Measurement(status=status, note=note, **common)
        return _judged(test_system, method, run, log, self.reference, status, note, common)


# -- one run ----------------------------------------------------------------------------------------


def _about(test_system: TestSystem, method: Method, setting: float) -> dict[str, Any]:
    """What is known of a measurement before it."""
    return {
        "method": method.name,
        "title": method.title,
        "setting": setting if method.adaptive else setting / test_system.units.time_unit,
        "adaptive": method.adaptive,
        "steps_planned": None if method.adaptive else round(test_system.horizon / setting),
    }


@dataclass
class _Log:
    """What is written down at every advance: by one step, or by several of an MD engine that runs by itself."""

    times: list[float] = field(default_factory=list)
    energies: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    constraints: list[float] = field(default_factory=list)
    evaluations: int = 0
    steps: int = 0


def _judged(
    test_system: TestSystem,
    method: Method,
    run: Run,
    log: _Log,
    reference: Reference,
    status: Status,
    note: str,
    common: dict[str, Any],
) -> Measurement:
    """What a run that made steps says of its method."""
    if not method.holds:
        return Measurement(status="baseline" if status == "ok" else status, note=note, **common)
    x, v = run.positions, run.velocities
    if not (np.all(np.isfinite(x)) and np.all(np.isfinite(v))):
        return Measurement(status="failed", note="positions are not finite", **common)
    sigma, tangency = test_system.residuals(x, v, run.time)
    if not method.follows:
        shown: Status = "thermostat" if status == "ok" else status
        return Measurement(status=shown, note=note, constraint_residual=sigma, velocity_residual=tangency, **common)
    slope, slope_error = _energy_slope(test_system, log)
    return Measurement(
        status=status,
        note=note,
        error=test_system.deviation(x, reference.positions) if status == "ok" else None,
        constraint_residual=sigma,
        velocity_residual=tangency,
        energy_slope=slope,
        energy_slope_error=slope_error,
        **common,
    )


def _run_to_horizon(
    test_system: TestSystem, run: Run, holds: bool, log: _Log, budget: float, deadline: float, watcher: Watcher
) -> str:
    """Advance to the horizon; the reason if it was given up for the budget."""
    potential, masses = test_system.potential, test_system.masses[:, None]

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
        start = clock()
        run.advance()
        now = clock()
        log.seconds.append((now - start) / run.steps)
        log.constraints.append((run.constraints.seconds - held) / run.steps)
        log.evaluations += evaluations_so_far() - evaluations
        log.steps += run.steps
        write_down()
        watcher.advance(run.time)
        if run.finished:
            break
        first = len(log.seconds) == 1
        to_go = run.steps * (test_system.horizon - run.time) / (run.time - log.times[-2])
        doubtful = first and log.seconds[0] < max(FIRST_STEP_DOUBT, FIRST_STEP_SHARE * budget)
        told = len(log.seconds) <= 2 and not run.grows
        if now + log.seconds[-1] * to_go > deadline and not doubtful and (told or now > deadline):
            return _too_slow(log.seconds[-1], budget)
    return ""


def _too_slow(step_seconds: float, budget: float) -> str:
    return f"at {duration(step_seconds)} a step, the steps to the horizon exceed the budget of {budget:.3g} s"


def _costs(test_system: TestSystem, method: Method, run: Run | None, log: _Log) -> dict[str, float | None]:
    if run is None or not log.seconds or run.time <= 0:
        return {}
    # The first step pays for what an MD engine sets up lazily.
    counted = slice(1, None) if len(log.seconds) > 1 else slice(None)
    run.constraints.release()
    step = run.own_step_seconds() or float(np.median(log.seconds[counted]))
    elapsed = run.time / test_system.units.long_time_unit
    return {
        "step_seconds": step,
        "constraint_seconds": float(np.median(log.constraints[counted])) if method.holds and run.divided else None,
        "evaluations_per_time": log.evaluations / elapsed,
        "seconds_per_time": step * log.steps / elapsed,
    }


def _energy_slope(test_system: TestSystem, log: _Log) -> tuple[float | None, float | None]:
    """Least-squares slope of the energy and its standard error, a degree of freedom and `long_time`."""
    if len(log.times) < 4:
        return None, None
    if not np.all(np.isfinite(log.energies)):
        return None, None
    t = np.array(log.times) / test_system.units.long_time_unit
    e = np.array(log.energies) / max(test_system.motion.degrees_of_freedom, 1)
    found = slope(t, e)
    return found.value, found.error
