"""Run a test system through methods: one table, a row a method and setting, with its error and its cost.

Every method starts from the same state with the same forces and is compared with the same reference solution at the
horizon. Times are of the processor, medians over rounds in which nobody looks and all methods take turns; what is too
long for rounds is timed once, and says so.
"""

from __future__ import annotations

import signal
import textwrap
import threading
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from time import perf_counter, process_time
from types import FrameType
from typing import Any

import numpy as np
import pandas as pd

from kcons.comparison.machine import environment, kernels_cached
from kcons.comparison.methods import METHODS, Method, choose
from kcons.comparison.progress import Watcher
from kcons.comparison.runs import Run
from kcons.comparison.test_systems import Reference, TestSystem
from kcons.comparison.test_systems.potential import Potential
from kcons.constraints.arguments import FromZero, Positive, checked
from kcons.constraints.compilation import announcer, clock
from kcons.errors import InputError, KconsError, UnsupportedError
from kcons.thermostats.correlated_series import slope

#: A run is observed about so many times.
RECORDS = 20
#: A first step below so many seconds may be slow only because it is the first.
FIRST_STEP = 0.5
#: A run is timed in rounds if it takes at most this part of a method's budget, and so many seconds.
ROUND_SHARE, ROUND_SECONDS = 0.2, 2.0
#: Rounds of a measurement at least and at most, and the seconds that those beyond the least may take.
ROUNDS, MOST_ROUNDS, MORE_SECONDS = 3, 16, 0.5
#: In a round the planned steps are made again and again until so many seconds are timed.
PASS_SECONDS = 0.01
#: What holds nothing goes back to the start after so many steps: it would fly apart.
BASELINE_STEPS = 4
#: Steps of one method cost the same at all settings: beyond this factor they are timed once more.
UNEVEN = 2.0
#: An MD engine is interrupted within a step after so many budgets.
PATIENCE = 3
#: Seconds after which an interruption that did not come through is tried again.
RING_AGAIN = 0.05

#: Columns of the table.
COLUMNS = {
    "method": "name by which it is chosen",
    "title": "what it is",
    "engine": "whose loop and forces: arrays, ASE or OpenMM",
    "adaptive": "whether the setting is a relative tolerance",
    "setting": "time step in the unit of time that is shown, or tolerance",
    "status": "ok; baseline (nothing held); partial (stopped for the budget); failed; not run",
    "note": "why",
    "steps": "steps made",
    "error": "root-mean-square distance of the atoms from the reference at the horizon",
    "sigma": "largest violation of a held value after the last step",
    "tangency": "largest |A v| over the root mean square of v, rows of unit norm",
    "slope": "of the energy against time, a degree of freedom and long unit of time",
    "slope_error": "its standard error",
    "setup_seconds": "before the first step",
    "step_seconds": "median processor time of a step",
    "rounds": "in how many rounds that was timed; 0: once, as it was observed",
    "evaluations": "force evaluations a long unit of time",
    "seconds": "processor time a long unit of time",
}


class OverBudgetError(Exception):
    """The time is up."""


@checked
def compare(
    system: TestSystem,
    methods: Iterable[str] | None = None,
    *,
    budget: Positive = 20.0,
    rounds: FromZero = ROUNDS,
    reference: Reference | None = None,
    done: pd.DataFrame | None = None,
    keep: Callable[[pd.DataFrame], None] | None = None,
    watcher: Watcher | None = None,
) -> pd.DataFrame:
    """Run a test system through methods.

    Parameters
    ----------
    system : TestSystem
    methods : iterable of str, optional
        Names as for `kcons.comparison.methods.choose`; the usual ones by default.
    budget : float
        Seconds for each method over all its settings. One that is predicted to exceed it is stopped after a step.
    rounds : int
        In how many rounds short runs are timed at least; 0 for none.
    reference : Reference, optional
        If it is known.
    done : DataFrame, optional
        An unfinished table of the same comparison: methods that it has are not run again.
    keep : callable, optional
        Gets the table after each method.
    watcher : Watcher, optional

    Returns
    -------
    DataFrame
        A row a method and setting, the cheapest settings first, with the columns of `COLUMNS`. Its `attrs` tell of the
        test system, the units, the reference, the machine, and how well times repeat ('margin': by what fraction
        medians of odd and of even rounds differ, for nine tenths of the rows; None where nothing was timed in rounds).

    Raises
    ------
    InputError
        Unknown method; a budget that is not positive.
    KconsError
        The reference solution cannot be computed.
    """
    if not isinstance(system, TestSystem):
        raise InputError(f"system is {system!r:.80}; give one of test_systems.build or from_file", item="system")
    chosen, watching = choose(methods, system), watcher or Watcher()
    if system.openmm is not None:
        system.openmm.patience = budget
    with watching.piece("loading kernels" if kernels_cached() else "compiling kernels (once)", 1):
        warm_up(system, chosen, budget)
    if reference is None:
        reference = reference_of(system, watching)
    about = {**described(system, reference), "budget": budget}
    rows = run_pending(chosen, lambda m: all_settings(system, m, reference, budget, watching), about, done, keep)
    return timed(system, rows, about, rounds=rounds, budget=budget, watcher=watching)


def timed(
    system: TestSystem,
    rows: list[dict[str, Any]],
    about: dict[str, Any],
    *,
    rounds: int,
    budget: float,
    watcher: Watcher,
) -> pd.DataFrame:
    """A table of rows whose short runs are timed together, in rounds."""
    timing = Rounds(system, rounds, min(ROUND_SHARE * budget, ROUND_SECONDS), PATIENCE * budget, watcher)
    return table_of(rows, {**about, "margin": timing.time(rows)})


def run_pending(
    chosen: Sequence[Any],
    run: Callable[[Any], list[dict[str, Any]]],
    about: dict[str, Any],
    done: pd.DataFrame | None,
    keep: Callable[[pd.DataFrame], None] | None,
    columns: Iterable[str] = COLUMNS,
) -> list[dict[str, Any]]:
    """The rows of an unfinished table, and those of all methods that it does not have; `keep` gets the table so far."""
    rows: list[dict[str, Any]] = [] if done is None else done.to_dict("records")
    there = {row["method"] for row in rows}
    for method in chosen:
        if method.name not in there:
            rows += run(method)
            if keep is not None:
                keep(table_of(rows, about, columns))
    return rows


def table_of(rows: list[dict[str, Any]], about: dict[str, Any], columns: Iterable[str] = COLUMNS) -> pd.DataFrame:
    """Rows as a table with all columns."""
    table = pd.DataFrame(rows, columns=list(columns))
    table["note"] = table["note"].astype(object).fillna("")
    table.attrs = about
    return table


def described(system: TestSystem, reference: Reference) -> dict[str, Any]:
    """What a reader of the table needs to know."""
    units = system.units
    return {
        "name": system.name,
        "title": system.title,
        "atoms": system.n_atoms,
        "rows": system.motion.constraint_set.n_rows,
        "rank": system.motion.rank,
        "degrees_of_freedom": system.motion.degrees_of_freedom,
        "horizon": system.horizon / units.time_unit,
        "length": units.length,
        "energy": units.energy,
        "time": units.time,
        "long_time": units.long_time,
        "forces": system.potential.name,
        "force_seconds": force_seconds(system),
        "error_unit": units.length,
        "reference": reference.how,
        "reference_error": reference.error,
        "environment": environment(),
    }


def reference_of(system: TestSystem, watcher: Watcher) -> Reference:
    """The reference solution, with its progress shown."""
    with watcher.piece("reference solution", 1):
        return system.reference(lambda done, total: watcher.advance(done / total))


def force_seconds(system: TestSystem) -> float:
    """Median wall time of the forces beyond that of a spring on one atom, which is that of a call of NumPy."""
    spring = Potential(lambda x: (0.5 * float(np.sum(x * x)), -x), "one spring")
    found: list[float] = []
    begun = perf_counter()
    while len(found) < 16 and perf_counter() - begun < 0.5:
        system.potential.forget()
        times = [perf_counter()]
        for potential, x in ((system.potential, system.positions), (spring, np.ones((1, 3)))):
            potential.watched(x)
            times.append(perf_counter())
        found.append(2 * times[1] - times[0] - times[2])
    return max(0.0, float(np.median(found[1:] or found)))


def processor_clock(system: TestSystem) -> Callable[[], float]:
    """Processor time; wall time where forces are computed on a GPU, for which the processor waits."""
    gpu = system.openmm is not None and system.openmm.platform not in ("Reference", "CPU")
    return perf_counter if gpu else process_time


def warm_up(system: TestSystem, methods: Iterable[Method], budget: float) -> None:
    """Compile or load every kernel that these methods need, outside of any timing."""
    dt = min(system.time_steps)
    for method in methods:
        if (method.engine != "OpenMM" or "kcons" in method.title) and not (method.adaptive or method.refusal(system)):
            # What goes wrong is shown where it is measured.
            with suppress(Exception), InterruptedAfter(PATIENCE * budget):
                run = method.start(system, dt)
                run.advance()
                run.advance(2)


# -- one run ----------------------------------------------------------------------------------------


def all_settings(
    system: TestSystem, method: Method, reference: Reference, budget: float, watcher: Watcher
) -> list[dict[str, Any]]:
    """Rows of one method at all its settings, as far as the budget goes."""
    reason = method.refusal(system)
    if reason is not None:
        return [{**about_row(system, method, np.nan), "status": "not run", "note": reason}]
    found: list[dict[str, Any]] = []
    begun = clock()
    slow: float | None = None
    for setting in method.settings(system):
        left = budget - (clock() - begun)
        planned = 0 if method.adaptive else round(system.horizon / setting)
        note = f"the budget of {budget:g} s is used up" if found and left <= 0 else ""
        # A tighter tolerance takes at least as many steps as a looser one.
        if not note and slow is not None and slow * (planned or found[-1]["steps"]) > left:
            note = _too_slow(slow, budget)
        if note:
            found.append({**about_row(system, method, setting), "status": "not run", "note": note})
            continue
        found.append(measure(system, method, setting, reference, budget, left, watcher))
        last = found[-1]
        if last["status"] == "not run" or (last["status"] == "partial" and not last.get("step_seconds")):
            break  # it cannot run this test system at any step, or not one step was done
        slow = last.get("step_seconds")
    return found


def about_row(system: TestSystem, method: Method, setting: float) -> dict[str, Any]:
    """What is known of a row before it is measured."""
    return {
        "method": method.name,
        "title": method.title,
        "engine": method.engine,
        "adaptive": method.adaptive,
        "setting": setting if method.adaptive else setting / system.units.time_unit,
        "note": "",
        "steps": 0,
        "rounds": 0,
    }


def measure(
    system: TestSystem,
    method: Method,
    setting: float,
    reference: Reference,
    budget: float,
    left: float | None = None,
    watcher: Watcher | None = None,
) -> dict[str, Any]:
    """The row of one method at one setting (internal units), with what is `left` of the budget for the method."""
    row, watching = about_row(system, method, setting), watcher or Watcher()
    what = f"{method.title}, {'rtol' if method.adaptive else 'dt'} {row['setting']:g}"
    log, begun = _Log(system), clock()
    system.potential.forget()
    run: Run | None = None
    try:
        with watching.piece(what, system.horizon), InterruptedAfter(PATIENCE * budget), np.errstate(all="ignore"):
            run = method.start(system, setting)
            if not isinstance(run, Run):
                raise KconsError(f"start gives a {type(run).__name__}; let it give a kcons.comparison.Run")
            row["setup_seconds"] = clock() - begun
            planned = None if method.adaptive else round(system.horizon / setting)
            row["note"] = log.follow(run, method, planned, begun + (budget if left is None else left), budget, watching)
        status = "partial" if row["note"] else "ok"
        row |= {"status": status, **log.judged(run, method, reference, status)}
    except OverBudgetError:
        row |= {"status": "partial", "note": f"step {log.steps + 1} was not done after {clock() - begun:.3g} s"}
    except Exception as error:  # whatever an MD engine raises is a result, and is shown
        if isinstance(error, UnsupportedError) and not log.steps:
            return {**row, "status": "not run", "note": textwrap.shorten(str(error), 300)}
        row |= {"status": "failed", "note": f"step {log.steps + 1}: {first_line(error)}"}  # a shorter one may succeed
    row["steps"] = log.steps
    return row if run is None or not log.seconds else row | log.costs(run)


@dataclass
class _Log:
    """What is written down of a run: the first step alone, then several at a time."""

    system: TestSystem
    steps: int = 0

    def __post_init__(self) -> None:
        self.times: list[float] = []
        self.energies: list[float] = []
        self.seconds: list[float] = []  # a step, of each advance
        self.counted = 0  # force evaluations

    def observe(self, run: Run) -> None:
        energy = run.energy()
        if energy is None:
            x, v = run.observe()
            kinetic = 0.5 * float(np.sum(self.system.masses[:, None] * v * v))
            energy = kinetic + self.system.potential.watched(x)[0]
        self.times.append(run.time)
        self.energies.append(energy)

    def follow(
        self, run: Run, method: Method, planned: int | None, deadline: float, budget: float, watcher: Watcher
    ) -> str:
        """Advance to the horizon; the reason if it was given up for the budget."""
        horizon = self.system.horizon * (1 - 1e-12)
        stride = 1 if planned is None or not method.holds else max(1, planned // RECORDS)
        self.observe(run)
        while run.time < horizon if planned is None else run.done < planned:
            if not method.holds:
                rewind(self.system, run)
            count = stride if self.steps and planned else 1
            count = count if planned is None else min(count, planned - run.done)
            before, begun = evaluations(self.system, run), clock()
            run.advance(count)
            now = clock()
            self.seconds.append((now - begun) / count)
            self.counted += evaluations(self.system, run) - before
            self.steps += count
            self.observe(run)
            watcher.advance(run.time)
            left = (planned - run.done) if planned else self.steps * (horizon - run.time) / max(run.time, 1e-300)
            doubtful = len(self.seconds) == 1 and self.seconds[0] < max(FIRST_STEP, 0.25 * budget)
            if left > 0 and not doubtful and (now > deadline or now + self.seconds[-1] * left > deadline):
                return _too_slow(self.seconds[-1], budget)
        end = f"{run.time / self.system.units.time_unit:g} {self.system.units.time}, not at the horizon"
        for wrong, said in (
            (abs(run.time / horizon - 1) > 1e-6, f"the run ends at {end}: make steps of dt, give states their time"),
            (not self.counted, "no force evaluation is counted: use the test system's potential or Run.evaluations"),
        ):
            if wrong and method.holds:
                raise KconsError(said)
        return ""

    def costs(self, run: Run) -> dict[str, float]:
        # The first step pays for what an MD engine sets up lazily.
        step = float(np.median(self.seconds[1:] or self.seconds))
        elapsed = run.time / self.system.units.long_time_unit
        spent = {"evaluations": self.counted / elapsed, "seconds": step * self.steps / elapsed} if elapsed > 0 else {}
        return {"step_seconds": step, **spent}

    def judged(self, run: Run, method: Method, reference: Reference, status: str) -> dict[str, Any]:
        """What a run that made steps says of its method."""
        if not method.holds:
            return {"status": "baseline" if status == "ok" else status}
        x, v = run.observe()
        if not (np.isfinite(x).all() and np.isfinite(v).all()):
            return {"status": "failed", "note": "positions are not finite"}
        sigma, tangency = self.system.residuals(x, v, run.time)
        found: dict[str, Any] = {"sigma": sigma, "tangency": tangency}
        if status == "ok":
            found["error"] = self.system.deviation(x, reference.positions)
        return {**found, **self.energy_slope()}

    def energy_slope(self) -> dict[str, float]:
        """Least-squares slope of the energy and its standard error, a degree of freedom and `long_time`."""
        if len(self.times) < 4 or not np.isfinite(self.energies).all():
            return {}
        t = np.array(self.times) / self.system.units.long_time_unit
        e = np.array(self.energies) / max(self.system.motion.degrees_of_freedom, 1)
        found = slope(t, e)
        return {"slope": found.value, "slope_error": found.error}


def evaluations(system: TestSystem, run: Run) -> int:
    """Force evaluations of a run so far."""
    return system.potential.evaluations if run.evaluations is None else run.evaluations


def _too_slow(step_seconds: float, budget: float) -> str:
    return f"at {step_seconds:.3g} s a step, the steps to the horizon exceed the budget of {budget:.3g} s"


def rewind(system: TestSystem, run: Run) -> None:
    """Back to the start, forces known."""
    run.rewind()
    if run.evaluations is None:
        # The end of the last step is no longer the last point known.
        system.potential.forces(system.positions)


# -- times ------------------------------------------------------------------------------------------


class Rounds:
    """Times of steps without observation, in rounds: every run once, then all again.

    What slows the machine down for a while affects all methods alike. Runs of at most `limit` seconds are timed in
    `least` rounds and more; one that takes longer than `patience` is interrupted.
    """

    def __init__(self, system: TestSystem, least: int, limit: float, patience: float, watcher: Watcher) -> None:
        self.system, self.least, self.limit, self.patience, self.watcher = system, least, limit, patience, watcher
        self.clock = processor_clock(system)

    def time(self, rows: list[dict[str, Any]]) -> float | None:
        """Put medians into rows of short runs; by how much such medians differ, or None."""
        short = [row for row in rows if self._short(row)] if self.least else []
        found: dict[int, list[float]] = {id(row): [] for row in short}
        if short:
            with self.watcher.piece("times, in rounds", MOST_ROUNDS):
                self._rounds(short, found)
                self._rounds(_uneven(short), found)
            for row in _uneven(short):
                _note(row, "steps cost more at some settings")
        return margin(found.values())

    def _rounds(self, rows: list[dict[str, Any]], found: dict[int, list[float]]) -> None:
        spent, due = {id(row): 0.0 for row in rows}, list(rows)
        for number in range(1, MOST_ROUNDS + 1):
            for row in due:
                begun = perf_counter()
                try:
                    found[id(row)].append(self._one(row))
                except Exception as error:  # whatever an MD engine raises is a result, and is shown
                    _note(row, f"timed once: {first_line(error)}")
                    found[id(row)].clear()
                    spent[id(row)] = np.inf
                spent[id(row)] += perf_counter() - begun
            self.watcher.advance(number)
            more = MORE_SECONDS * number / (number + 1) if number >= self.least else np.inf
            due = [row for row in due if spent[id(row)] < more]
            if not due:
                break
        for row in rows:
            if times := found[id(row)]:
                step = float(np.median(times))
                row["seconds"] *= step / row["step_seconds"]
                row["step_seconds"], row["rounds"] = step, len(times)

    def _short(self, row: dict[str, Any]) -> bool:
        if row["status"] not in ("ok", "baseline") or not row.get("step_seconds") or not row.get("seconds"):
            return False
        return row["step_seconds"] * row["steps"] + (row.get("setup_seconds") or 0.0) <= self.limit

    def _one(self, row: dict[str, Any]) -> float:
        """Seconds a step of a run that is started for it."""
        system, method = self.system, METHODS[row["method"]]
        system.potential.forget()
        with InterruptedAfter(self.patience), np.errstate(all="ignore"):
            run = method.start(system, row["setting"] * (1.0 if method.adaptive else system.units.time_unit))
            if method.adaptive:  # its steps are not alike
                begun = self.clock()
                run.advance(int(row["steps"]))
                return (self.clock() - begun) / row["steps"]
            steps = int(row["steps"]) if method.holds else min(int(row["steps"]), BASELINE_STEPS)
            run.advance()  # what is set up lazily
            passes: list[float] = []
            while sum(passes) < PASS_SECONDS:
                rewind(system, run)
                if run.evaluations is not None:
                    run.advance()  # it pays for the forces at the start
                before, begun = evaluations(system, run), self.clock()
                run.advance(steps)
                passes.append(self.clock() - begun)
        if not np.isfinite(run.observe()[0]).all():
            raise KconsError("positions are not finite")
        each = row["evaluations"] * row["setting"] * system.units.time_unit / system.units.long_time_unit
        if 2 * (made := evaluations(system, run) - before) < each * steps:
            raise KconsError(f"advance({steps}) makes {made} force evaluations, not {each * steps:.0f}: make all steps")
        return float(np.median(passes)) / steps


def _note(row: dict[str, Any], words: str) -> None:
    if words not in row["note"]:
        row["note"] = "; ".join(filter(None, [row["note"], words]))


def _uneven(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows of methods whose steps cost more than `UNEVEN` times as much at one setting as at another."""
    costs: dict[str, list[float]] = {}
    timed = [row for row in rows if row["rounds"] and not row["adaptive"]]
    for row in timed:
        costs.setdefault(row["method"], []).append(row["step_seconds"])
    return [row for row in timed if max(costs[row["method"]]) > UNEVEN * min(costs[row["method"]])]


def margin(times: Iterable[list[float]]) -> float | None:
    """By what fraction medians of odd and of even rounds differ, in nine tenths of the runs at most; None of one."""
    off = [abs(np.log(np.median(mine[0::2]) / np.median(mine[1::2]))) for mine in times if len(mine) > 1]
    return float(np.expm1(np.quantile(off, 0.9))) if off else None


# -- what goes wrong --------------------------------------------------------------------------------


class InterruptedAfter:
    """Raise OverBudgetError in the body after `seconds`, where the system can do that (Unix, main thread).

    Not while a kernel is being compiled, which happens once and must not begin again and again: then as soon as that is
    done. Python drops what is raised in `__del__` and in callbacks of weak references: it is raised again until the
    body is left.
    """

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self._works = hasattr(signal, "setitimer") and threading.current_thread() is threading.main_thread()

    def __enter__(self) -> None:
        if self._works:
            self._previous = signal.signal(signal.SIGALRM, self._ring)
            signal.setitimer(signal.ITIMER_REAL, max(self.seconds, 1e-3), RING_AGAIN)

    def _ring(self, _: int, frame: FrameType | None) -> None:
        # What is raised in the two others would leave the body, or not enter it, with the timer on.
        own = InterruptedAfter.__enter__.__code__, InterruptedAfter.__exit__.__code__
        if not announcer.compiling and (frame is None or frame.f_code not in own):
            raise OverBudgetError(f"not done after {self.seconds:.3g} s")

    def __exit__(self, *_: object) -> None:
        if self._works:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, self._previous)


def first_line(error: Exception) -> str:
    """Kind and first line of an error."""
    first = (str(error).strip().splitlines() or [""])[0]
    return textwrap.shorten(f"{type(error).__name__}: {first}", 280)
