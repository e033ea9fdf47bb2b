"""Times of steps without observation, in rounds: every method once, then all again.

A run of few short steps that is observed after each tells the time of cold caches and of the observer. Here a method
starts afresh in every round, warms up, and makes its planned steps again and again until enough of them are timed. The
rounds of all methods take turns, so that what slows the machine down for a while is shared by all.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from kcons.comparison.methods.method import Method, OverBudgetError, Run, first_line, interrupted_after
from kcons.comparison.test_systems import TestSystem
from kcons.comparison.work_precision.measurement import Measurement
from kcons.constraints.compilation import clock
from kcons.errors import KconsError

#: Steps before the clock starts, of runs short enough.
WARM_STEPS = 4
#: What holds nothing goes back to the start after so many steps: it would fly apart.
BASELINE_BLOCK = 4


@dataclass(frozen=True)
class Rounds:
    """How often, and for how long, steps are timed.

    Attributes
    ----------
    least, most : int
        Rounds of one measurement.
    seconds : float
        Beyond the least, no more rounds of a measurement than fit into this, start and all.
    pass_seconds : float
        In a round, passes over the planned steps are made until so much is timed.
    """

    least: int = 3
    most: int = 16
    seconds: float = 0.6
    pass_seconds: float = 0.01


#: Those of the whole comparison, of one test system, and of a quick run.
FULL_ROUNDS = Rounds()
ROUNDS = Rounds(least=2, most=8, seconds=0.3)
QUICK_ROUNDS = Rounds(least=1, most=4, seconds=0.02, pass_seconds=0.002)


@dataclass
class Times:
    """What the rounds of one measurement gave.

    Attributes
    ----------
    steps : list of float
        Seconds a step, one entry a round.
    spent : float
        Seconds in all.
    failure : str
        What went wrong, which ends the rounds of this measurement; '' if nothing did.
    """

    steps: list[float] = field(default_factory=list)
    spent: float = 0.0
    failure: str = ""

    def due(self, rounds: Rounds) -> bool:
        """Whether there is another round for it."""
        done = len(self.steps)
        if self.failure or done >= rounds.most:
            return False
        return done < rounds.least or self.spent * (done + 1) / done <= rounds.seconds


def timed(
    test_system: TestSystem,
    measurements: Sequence[Measurement],
    methods: Mapping[str, Method],
    rounds: Rounds,
    *,
    limit: float,
    patience: float,
    whole: Callable[[Method, float], Measurement],
    told: Callable[[float], None] = lambda number: None,
) -> tuple[list[Measurement], float | None]:
    """Measurements with the median over rounds as the time of a step, and how well such medians repeat.

    Parameters
    ----------
    test_system : TestSystem
    measurements : sequence of Measurement
        Those that failed, or take longer than `limit`, stay as they are.
    methods : mapping of name to Method
    rounds : Rounds
    limit : float
        Seconds of the longest run that is made again, start and all.
    patience : float
        Seconds after which a round is interrupted.
    whole : callable
        Measures a method at a setting once more, in internal units: for those that cannot `march`.
    told : callable, optional
        Hears how many rounds are over.

    Returns
    -------
    measurements : list of Measurement
        What fails in a round keeps the time that was observed, and says so in its note.
    margin : float or None
        See `margin`.
    """
    chosen = [k for k, m in enumerate(measurements) if _short(m, limit)]

    def task(m: Measurement) -> Callable[[], float]:
        method, setting = methods[m.method], m.setting if m.adaptive else m.setting * test_system.units.time_unit

        def by_march() -> float:
            test_system.potential.forget()
            with interrupted_after(patience), np.errstate(all="ignore"):
                return marched(method.start(test_system, setting), m, method.holds, rounds.pass_seconds)

        def by_run() -> float:
            again = whole(method, setting)
            if again.status != m.status or not again.step_seconds:
                raise KconsError(f"{again.status}: {again.note}")
            return again.step_seconds

        return by_march if method.marches else by_run

    found = list(measurements)
    times = interleaved([task(found[k]) for k in chosen], rounds, told)
    for k, mine in zip(chosen, times, strict=True):
        m = found[k]
        if mine.failure:
            found[k] = replace(m, note="; ".join(filter(None, (m.note, f"time as observed: {mine.failure}"))))
            continue
        if not methods[m.method].marches:
            # The run that was observed is one of the same kind.
            mine.steps.insert(0, float(m.step_seconds or 0.0))
        step = float(np.median(mine.steps))
        each = float(m.seconds_per_time or 0.0) / float(m.step_seconds or 1.0)
        found[k] = replace(m, step_seconds=step, seconds_per_time=each * step)
    return found, margin(mine.steps for mine in times if not mine.failure)


def interleaved(
    tasks: Sequence[Callable[[], float]], rounds: Rounds, told: Callable[[float], None] = lambda number: None
) -> list[Times]:
    """Every task once, then all again; a task that raises has failed, and is left out from there on.

    Parameters
    ----------
    tasks : sequence of callable
        Each returns the seconds that a step took.
    rounds : Rounds
    told : callable, optional
        Hears how many rounds are over.
    """
    found = [Times() for _ in tasks]
    for number in range(1, rounds.most + 1):
        due = [(task, mine) for task, mine in zip(tasks, found, strict=True) if mine.due(rounds)]
        if not due:
            break
        for task, mine in due:
            begun = clock()
            try:
                mine.steps.append(task())
            except Exception as error:  # whatever a peer raises is a result, and is shown
                mine.failure = f"round {number}: {first_line(error)}"
            mine.spent += clock() - begun
        told(number)
    return found


def marched(run: Run, m: Measurement, holds: bool, pass_seconds: float) -> float:
    """Seconds a step of a run that was just started: the median over passes of its planned steps, or more.

    Raises
    ------
    KconsError
        It ran to where nothing is finite.
    """
    run.constraints.release()
    step_seconds = float(m.step_seconds or 0.0)
    run.march(min(m.steps, WARM_STEPS) if WARM_STEPS * step_seconds < pass_seconds else 1)
    if not holds:
        return _passes(run, min(m.steps, BASELINE_BLOCK), pass_seconds)
    longer = run.stretch(max(step_seconds, 1e-9), pass_seconds)
    if longer > m.steps:
        try:
            return _passes(run, longer, pass_seconds)
        except OverBudgetError:
            raise
        except Exception:  # beyond the horizon anything may happen: then no farther than to it
            run.rewind()
    return _passes(run, m.steps, pass_seconds)


def _passes(run: Run, steps: int, pass_seconds: float) -> float:
    found: list[float] = []
    while sum(found) < pass_seconds:
        run.rewind()
        run.settle()
        begun = clock()
        run.march(steps)
        found.append(clock() - begun)
    if not np.isfinite(run.positions).all():
        raise KconsError("positions are not finite")
    return float(np.median(found)) / steps


def margin(times: Iterable[Sequence[float]]) -> float | None:
    """How well medians over rounds repeat: by what fraction those of odd and of even rounds differ at most, in nine
    tenths of the measurements; None if none has two rounds.

    Parameters
    ----------
    times : iterable of sequence of float
        Seconds a step, round by round.
    """
    off = [
        abs(math.log(float(np.median(mine[0::2])) / float(np.median(mine[1::2])))) for mine in times if len(mine) > 1
    ]
    return float(np.expm1(np.quantile(off, 0.9))) if off else None


def _short(m: Measurement, limit: float) -> bool:
    if m.status not in ("ok", "baseline") or not m.step_seconds:
        return False
    return m.step_seconds * m.steps + float(m.setup_seconds or 0.0) <= limit
