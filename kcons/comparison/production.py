"""How long may the step of a production run be?

As long as configurations keep their temperature and the energy does not climb. Velocities at the ends of steps
underestimate fast motions, so that the kinetic energy does not tell. The temperature of configurations does:
<|grad U|^2>/<div grad U> by kind of motion, under Langevin dynamics at each step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from kcons.comparison.averages import KINDS, SAMPLERS, sample
from kcons.comparison.progress import Watcher
from kcons.comparison.ranking import RIGHT
from kcons.comparison.test_systems import TestSystem
from kcons.steppers import Rattle, State, System, run
from kcons.thermostats.correlated_series import slope

#: Seconds a force evaluation may take for each second of the budget of a step.
CHEAP = 1e-3
#: Records of the energy, and standard errors beyond which its slope is a climb.
RECORDS, CLIMBS = 40, 3.0
#: Friction, in inverse steps of 1 fs.
FRICTION = 0.005


@dataclass(frozen=True)
class StepCheck:
    """What was seen at one step.

    Attributes
    ----------
    step : float
        In the unit of time that is shown.
    off, error : float
        Of the temperature that is farthest off, relative, and its standard error; NaN where the run failed.
    kind : str
        Of which motion: shift, turn or internal.
    climb : float
        Slope of the energy over its standard error, at constant energy.
    note : str
        Why a run failed.
    """

    step: float
    off: float
    error: float
    kind: str
    climb: float
    note: str = ""

    @property
    def right(self) -> bool:
        return abs(self.off) + 2 * self.error <= RIGHT and self.climb <= CLIMBS

    @property
    def known(self) -> bool:
        """Whether this run can tell."""
        return (
            bool(self.note) or 2 * self.error <= RIGHT or abs(self.off) - 2 * self.error > RIGHT or self.climb > CLIMBS
        )


def check_steps(
    system: TestSystem, steps: Sequence[float], budget: float, *, watcher: Watcher | None = None
) -> list[StepCheck]:
    """Look at steps, from the shortest on, until one is wrong.

    Parameters
    ----------
    system : TestSystem
        Of molecules, in ASE's units.
    steps : sequence of float
        In the unit of time that is shown.
    budget : float
        Seconds for each step.
    watcher : Watcher, optional
    """
    watching, unit = watcher or Watcher(), system.units.time_unit
    found: list[StepCheck] = []
    for step in sorted(steps):
        with watching.piece(f"temperature of the configurations, {step:g} {system.units.time}", budget):
            try:
                climb = _climb(system, step * unit, 0.25 * budget)
                told = sample(system, SAMPLERS["langevin"], step * unit, FRICTION / unit, budget=0.75 * budget)
            except Exception as error:  # whatever forces or constraints raise ends the run, and is shown
                found.append(StepCheck(step, np.nan, np.nan, "", np.nan, f"{type(error).__name__}: {error}"))
                break
        kinds = [kind for kind in KINDS if kind in told]
        if not kinds:
            found.append(StepCheck(step, np.nan, np.nan, "", climb, told["note"]))
            break
        kind = max(kinds, key=lambda k: abs(told[k]) + 2 * told[f"{k}_error"])
        found.append(StepCheck(step, told[kind], told[f"{kind}_error"], kind, climb))
        if found[-1].known and not found[-1].right:
            break
    return found


def _climb(system: TestSystem, dt: float, seconds: float) -> float:
    """Slope of the energy at constant energy, in standard errors, of a run of about so many seconds."""
    made = System(system.motion, system.potential.forces)
    state, stepper = State(system.positions, system.velocities), Rattle()
    begun = perf_counter()
    state = run(made, state, dt, 10, stepper=stepper)
    each = (perf_counter() - begun) / 10
    every = max(1, int(seconds / max(each, 1e-7) / RECORDS))
    energies: list[float] = []
    for _ in range(RECORDS):
        state = run(made, state, dt, every, stepper=stepper)
        energies.append(system.potential.watched_energy(state.positions) + made.kinetic_energy(state.velocities))
    found = slope(np.arange(float(RECORDS)), np.array(energies))
    return found.value / found.error if found.error > 0 else 0.0


def sentence(checks: Sequence[StepCheck], unit: str, kelvin: float = 300.0) -> str:
    """What the steps come to."""
    right = [check for check in checks if check.right]
    last = checks[-1]
    doubt = next((check for check in checks if not check.known), None)
    if doubt is not None and (not right or doubt.step > right[-1].step):
        known = f"A step of {right[-1].step:g} {unit} is right for averages at {kelvin:g} K; at" if right else "At"
        return (
            f"{known} {doubt.step:g} {unit} the temperature of configurations is known to {200 * doubt.error:.1g} % "
            f"only (two standard errors): give a larger --budget to know it to {100 * RIGHT:g} %."
        )
    if not right:
        why = last.note or f"{last.kind} motions are off by {100 * last.off:+.1f} %"
        return f"No step that was tried, from {checks[0].step:g} {unit} on, is right for averages: {why}."
    words = (
        f"For averages at {kelvin:g} K the step may be {right[-1].step:g} {unit}: configurations have that temperature "
        f"within {100 * RIGHT:g} %, and the energy does not climb"
    )
    if last is right[-1]:
        return f"{words}; longer ones were not tried."
    why = last.note.split("\n")[0] if last.note else f"{last.kind} motions are off by {100 * last.off:+.1f} %"
    if not last.note and last.climb > CLIMBS and abs(last.off) + 2 * last.error <= RIGHT:
        why = "the energy climbs"
    return f"{words}. At {last.step:g} {unit} {why}."
