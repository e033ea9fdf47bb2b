"""How long may the step of a production run be?

As long as configurations keep their temperature and the energy does not climb. Velocities at the ends of steps
underestimate fast motions, so that the kinetic energy does not tell. The temperature of configurations does:
<|grad U|^2>/<div grad U> by kind of motion, under Langevin dynamics at each step.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from time import perf_counter
from typing import Any

import numpy as np

from kcons.comparison.averages import KINDS, SAMPLERS, sample
from kcons.comparison.measure import first_line
from kcons.comparison.progress import Watcher
from kcons.comparison.ranking import RIGHT
from kcons.comparison.test_systems import TestSystem
from kcons.steppers import State, System, run
from kcons.thermostats.correlated_series import slope

#: Seconds a force evaluation may take for each second of the budget of a step.
CHEAP = 1e-3
#: Records of the energy, and standard errors beyond which its slope is a climb.
RECORDS, CLIMBS = 40, 3.0
#: Standard errors beyond which a temperature is wrong: several are looked at, and errors of short runs are rough.
WRONG = 4.0
#: Friction, in inverse steps of 1 fs.
FRICTION = 0.005


def check_steps(
    system: TestSystem, steps: Sequence[float], budget: float, *, watcher: Watcher | None = None
) -> list[dict[str, Any]]:
    """Look at steps (in the unit that is shown), from the shortest on, until one is wrong; `budget` seconds for each.

    Rows are those of `kcons.comparison.averages.sample` with 'climb': the slope of the energy at constant energy over
    its standard error.
    """
    watching, unit = watcher or Watcher(), system.units.time_unit
    found: list[dict[str, Any]] = []
    for step in sorted(steps):
        with watching.piece(f"temperature of the configurations, {step:g} {system.units.time}", budget):
            try:
                climb = _climb(system, step * unit, 0.25 * budget)
                row = sample(system, SAMPLERS["langevin"], step * unit, FRICTION / unit, budget=0.75 * budget)
            except Exception as error:  # whatever forces or constraints raise ends the run, and is shown
                row, climb = {"setting": step, "status": "failed", "note": first_line(error)}, 0.0
        found.append({**row, "climb": climb})
        if known(found[-1]) and not right(found[-1]):
            break
    return found


def _climb(system: TestSystem, dt: float, seconds: float) -> float:
    """Slope of the energy at constant energy, in standard errors, of a run of about so many seconds."""
    made = System(system.motion, system.potential.forces)
    state = run(made, State(system.positions, system.velocities), dt, 2)  # loads kernels
    begun = perf_counter()
    state = run(made, state, dt, 10)
    each = (perf_counter() - begun) / 10
    every = max(1, int(seconds / max(each, 1e-7) / RECORDS))
    energies: list[float] = []
    for _ in range(RECORDS):
        state = run(made, state, dt, every)
        energies.append(system.potential.watched(state.positions)[0] + made.kinetic_energy(state.velocities))
    later = np.array(energies[RECORDS // 2 :])  # a start that is not at equilibrium changes the energy, once
    found = slope(np.arange(float(len(later))), later)
    return found.value / found.error if found.error > 0 else 0.0


def right(row: Mapping[str, Any]) -> bool:
    """Whether every temperature is right within 1 %, two standard errors included, and the energy does not climb."""
    return row["status"] == "ok" and row["error"] <= RIGHT and row["climb"] <= CLIMBS


def known(row: Mapping[str, Any]) -> bool:
    """Whether this run can tell that."""
    if row["status"] == "failed" or row["climb"] > CLIMBS:
        return True
    if row["status"] != "ok":  # too few samples for an error
        return False
    _, off, error = _worst(row)
    return 2 * error <= RIGHT or abs(off) - WRONG * error > RIGHT


def _worst(row: Mapping[str, Any]) -> tuple[str, float, float]:
    """The kind of motion whose temperature is farthest off, by how much, and the standard error of that."""
    kinds = [kind for kind in KINDS if kind in row]
    kind = max(kinds, key=lambda k: abs(row[k]) + 2 * row[f"{k}_error"])
    return kind, row[kind], row[f"{kind}_error"]


def sentence(rows: Sequence[Mapping[str, Any]], unit: str, kelvin: float = 300.0) -> str:
    """What the steps come to."""
    good = [row["setting"] for row in rows if right(row)]
    doubt = next((row for row in rows if not known(row)), None)
    if doubt is not None and (not good or doubt["setting"] > good[-1]):
        before = f"A step of {good[-1]:g} {unit} is right for averages at {kelvin:g} K; at" if good else "At"
        if doubt["status"] != "ok":
            return f"{before} {doubt['setting']:g} {unit} {doubt['note']}: give a larger --budget."
        known_to = float(f"{200 * _worst(doubt)[2]:.2g}")  # 140, not 1.4e+02
        return (
            f"{before} {doubt['setting']:g} {unit} the temperature of configurations is known to "
            f"{known_to:g} % only (two standard errors): a larger --budget makes it {100 * RIGHT:g} %."
        )
    last = rows[-1]
    if last["status"] == "failed":
        why = last["note"].split("\n")[0]
    elif not last.get("error", 0.0) > RIGHT:
        why = "the energy climbs"
    else:
        kind, off, error = _worst(last)
        why = f"{kind} motions are off by {100 * off:+.1f} % (± {200 * error:.1g}, two standard errors)"
    if not good:
        return f"No step that was tried, from {rows[0]['setting']:g} {unit} on, is right for averages: {why}."
    words = (
        f"For averages at {kelvin:g} K the step may be {good[-1]:g} {unit}: configurations have that temperature "
        f"within {100 * RIGHT:g} %, and the energy does not climb"
    )
    if right(last):
        return f"{words}; longer ones were not tried."
    return f"{words}. At {last['setting']:g} {unit} {why}."
