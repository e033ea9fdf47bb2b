"""Run a test system through samplers: how far the temperature of the configurations is off, at which step.

What is right is known: every temperature of the configurations (of shifts and of turns of whole clusters, and of what
is left) is the one asked for. Where a second test system gives cheap forces for the same atoms, samplers with several
time steps use those often, and what the expensive ones are more once a step.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from kcons.comparison.measure import COLUMNS, described, first_line, processor_clock, run_pending, table_of
from kcons.comparison.methods import lines_on_arrays
from kcons.comparison.progress import Watcher
from kcons.comparison.test_systems import Reference, TestSystem
from kcons.constraints.arguments import Positive, Rng, checked, positive, seed_from
from kcons.errors import InputError, unknown
from kcons.steppers import BlanesMoan4, State, Stepper, System
from kcons.thermostats import (
    Counts,
    ForceGroups,
    HamiltonianMonteCarlo,
    Isokinetic,
    IsokineticSpheres,
    Langevin,
    LangevinRespa,
    NoseHooverChain,
    TemperatureSplit,
    mean,
)

#: Fewest samples from which errors are taken.
MIN_SAMPLES = 64
#: Share of a run that is left out at its start.
LEFT_OUT = 0.1
#: Standard error of the temperature, relative, for which costs are stated.
GOAL = 0.01
#: Costs follow from correlation times, which are known to a third.
COST_SCATTER = 1 / 3
#: Most steps of the cheap forces in a step.
MOST = 64
#: Frictions that are tried, and time between two samples and length of a flight of Hamiltonian Monte Carlo: in steps
#: of the cheap forces.
FRICTIONS, INTERVAL, FLIGHT = (1 / 12.5, 1 / 50), 8, 30
#: Kinds of motion that have a temperature.
KINDS = ("shift", "turn", "internal")

#: Columns of the table, beside those of `compare`.
AVERAGES = {
    "friction": "in inverse long units of time; 0 where there is none",
    **{kind: f"temperature of {kind} motions over the one asked for, less 1" for kind in KINDS},
    **{f"{kind}_error": "its standard error" for kind in KINDS},
    "energy": "mean potential energy",
    "energy_error": "its standard error",
    "samples": "configurations that were looked at",
    "cheap": "evaluations of the cheap forces, of all steps",
    "accepted": "share of accepted moves of Monte Carlo",
}

ALL_COLUMNS = (*COLUMNS, *AVERAGES)


@dataclass(frozen=True)
class Setting:
    """What a stepper is made for; `inner` is the longest step of the cheap forces."""

    thermal_energy: float
    step: float
    friction: float
    inner: float
    seed: int

    @property
    def inner_steps(self) -> int:
        """How many steps of the cheap forces go into one."""
        return max(1, math.ceil(self.step / self.inner - 1e-9))


@dataclass(frozen=True)
class Sampler:
    """A way to sample; see `add_sampler`."""

    name: str
    make: Callable[[Setting], Stepper]
    title: str
    several: bool = False
    frictions: bool = True


SAMPLERS: dict[str, Sampler] = {}


def add_sampler(name: str, make: Callable[[Setting], Stepper], title: str, **options: bool) -> None:
    """Register a thermostat for `compare_averages` and ``kcons compare --criterion temperature``.

    Parameters
    ----------
    name : str
        By which it is chosen. A sampler of that name is replaced.
    make : callable
        A `Setting` to a stepper.
    title : str
        What tables call it.
    **options
        several: whether it uses cheap forces, as the force groups 'slow' and 'fast'; frictions: whether it has one.
    """
    SAMPLERS[name] = Sampler(name, make, title, **options)


def _langevin(s: Setting) -> Stepper:
    return Langevin(s.thermal_energy, s.friction, s.seed, substeps=1)


def _respa(s: Setting, **options: Any) -> Stepper:
    """Where slow kicks are in the middle of a step, states lie halfway between them."""
    if s.inner_steps == 1:
        return _langevin(s)
    fast = s.inner_steps + (s.inner_steps % 2 if options else 0)  # of an odd number none ends in the middle
    steps = {"slow": 1, "fast": fast}
    return LangevinRespa(s.thermal_energy, s.friction, s.seed, steps=steps, substeps=1, **options)


def _spheres(s: Setting) -> Stepper:
    options: dict[str, Any] = {} if s.inner_steps == 1 else {"steps": {"slow": 1, "fast": s.inner_steps}}
    return IsokineticSpheres(s.thermal_energy, s.friction, s.seed, substeps=1, **options)


def _monte_carlo(s: Setting) -> Stepper:
    count = max(1, round(FLIGHT * s.inner / s.step))
    few = max(1, count // 2)
    return HamiltonianMonteCarlo(s.thermal_energy, (few, 2 * count - few), s.seed, stepper=BlanesMoan4())


add_sampler("langevin", _langevin, "Langevin, g-BAOAB")
add_sampler("isokinetic", lambda s: Isokinetic(s.thermal_energy), "isokinetic, 2K = (g - 1) kT", frictions=False)
add_sampler(
    "isokinetic-notes",
    lambda s: Isokinetic(s.thermal_energy, convention="notes"),
    "isokinetic, 2K = 3N kT",
    frictions=False,
)
add_sampler(
    "nose-hoover", lambda s: NoseHooverChain(s.thermal_energy, 150 * s.inner), "Nosé-Hoover chain", frictions=False
)
add_sampler("hmc", _monte_carlo, "Hamiltonian Monte Carlo, order 4", frictions=False)
add_sampler("langevin-respa", _respa, "Langevin, several steps", several=True)
add_sampler("langevin-halfway", lambda s: _respa(s, slow_kicks="middle"), "the same, read between kicks", several=True)
add_sampler("spheres", _spheres, "isokinetic spheres", several=True)

#: Samplers that run unless methods are named, without and with cheap forces.
USUAL = ("langevin", "isokinetic", "isokinetic-notes", "nose-hoover")
USUAL_WITH_CHEAP = ("langevin", "langevin-respa", "langevin-halfway", "spheres", "hmc")


def choose_samplers(names: Iterable[str] | None, cheap: bool = False) -> list[Sampler]:
    """Samplers by name; the usual ones by default, all of them for 'all'."""
    wanted = list((USUAL_WITH_CHEAP if cheap else USUAL) if names is None else names)
    if wanted == ["all"]:
        wanted = [name for name, sampler in SAMPLERS.items() if cheap or not sampler.several]
    if not wanted or isinstance(names, str):
        raise InputError(f"methods is {names!r:.80}; give a list of {', '.join(SAMPLERS)}", item="methods")
    for name in wanted:
        if name not in SAMPLERS:
            raise InputError(f"there is no thermostat {unknown(name, SAMPLERS)}", item="methods")
        if SAMPLERS[name].several and not cheap:
            raise InputError(f"{name} uses cheap forces beside expensive ones: give --slow and --fast", item="methods")
    return [SAMPLERS[name] for name in dict.fromkeys(wanted)]


def inner_step(system: TestSystem) -> float:
    """Longest step of the cheap forces: the second of the test system."""
    return sorted(system.time_steps, reverse=True)[:2][-1]


@checked
def compare_averages(
    system: TestSystem,
    methods: Iterable[str] | None = None,
    *,
    cheap: TestSystem | None = None,
    steps: Sequence[float] | None = None,
    budget: Positive = 20.0,
    rng: Rng = 1,
    done: pd.DataFrame | None = None,
    keep: Callable[[pd.DataFrame], None] | None = None,
    watcher: Watcher | None = None,
) -> pd.DataFrame:
    """Run samplers at several steps, with frictions of 1 in 12.5 and 1 in 50 steps of the cheap forces.

    Parameters
    ----------
    system : TestSystem
        With a temperature. Its forces are the expensive ones.
    methods : iterable of str, optional
        Names out of `SAMPLERS`.
    cheap : TestSystem, optional
        The same atoms and constraints with cheap forces.
    steps : sequence of float, optional
        In the unit of time that is shown; by default those of the test system, or 1, 2 and 4 steps of the cheap forces
        (samplers that do not use these: 1 and 2).
    budget : float
        Seconds of processor time for each sampler over all its runs.
    rng : int, numpy.random.Generator or None
    done, keep, watcher
        As for `kcons.comparison.compare`.

    Returns
    -------
    DataFrame
        A row a run, with the columns of `COLUMNS` and `AVERAGES`. 'error' is the largest deviation of a temperature
        with two standard errors; 'seconds' and 'evaluations' are processor time and evaluations of the expensive forces
        until every temperature is known to 1 %.

    Raises
    ------
    InputError
        Unknown sampler; a system without a temperature; other atoms or constraints with the cheap forces; steps or a
        budget that are not positive.
    """
    if not system.thermal_energy:
        raise InputError(f"{system.name} has no temperature: compare its trajectories instead", item="criterion")
    chosen, watching, seed = choose_samplers(methods, cheap is not None), watcher or Watcher(), seed_from(rng)
    if cheap is not None:
        if system.masses.shape != cheap.masses.shape or not np.allclose(system.masses, cheap.masses, rtol=1e-2):
            raise InputError("expensive and cheap forces are of different atoms; give two of a file", item="fast")
        if system.motion.rank != cheap.motion.rank:
            raise InputError("expensive and cheap forces come with different constraints", item="fast")
    unit, inner = system.units.time_unit, inner_step(system)
    steps = [positive(step, "dt") for step in steps or ()]
    rates = [rate / inner for rate in FRICTIONS]
    planned: dict[str, list[tuple[float, float]]] = {}
    for sampler in chosen:
        usual = [k * inner for k in ((1, 2, 4) if sampler.several else (1, 2))] if cheap else system.time_steps
        lengths = sorted([dt * unit for dt in steps] if steps else usual)
        pairs = [(step, rate) for step in lengths for rate in (rates if sampler.frictions else rates[:1])]
        for pair in pairs:
            _refuse(system, *pair)  # before the first run, whose results would be lost
        planned[sampler.name] = pairs
    reference = Reference(system.positions, 0.0, "the temperature asked for")
    about = {
        **described(system, reference),
        "what": "deviation of the temperature of the configurations",
        "error_unit": "",
        "per": f"until the temperature is known to {100 * GOAL:g} %",
        "budget": budget,
        "margin": COST_SCATTER,
    }

    def runs(sampler: Sampler) -> list[dict[str, Any]]:
        options: dict[str, Any] = {"cheap": cheap, "budget": budget / len(planned[sampler.name]), "rng": seed}
        found = []
        for step, rate in planned[sampler.name]:
            with watching.piece(f"{sampler.title}, {step / unit:.3g} {system.units.time}", 1):
                found.append(sample(system, sampler, step, rate, watcher=watching, **options))
        return found

    return table_of(run_pending(chosen, runs, about, done, keep, ALL_COLUMNS), about, ALL_COLUMNS)


def _refuse(system: TestSystem, step: float, friction: float) -> None:
    """Raise `InputError` for a step or a friction that no run can have."""
    positive(step, "dt")
    positive(friction, "friction")
    if step > MOST * inner_step(system) * (1 + 1e-9):
        shown = f"{step / system.units.time_unit:g} {system.units.time}"
        raise InputError(f"a step of {shown} is too long", item="dt")


@checked
def sample(
    system: TestSystem,
    sampler: Sampler,
    step: float,
    friction: float,
    *,
    cheap: TestSystem | None = None,
    length: Positive | None = None,
    budget: Positive | None = None,
    rng: Rng = 1,
    watcher: Watcher | None = None,
) -> dict[str, Any]:
    """The row of one sampler at one step and friction, in internal units.

    `length` is the time to sample, besides a tenth of it that is left out at the start; or `budget` seconds of
    processor time are sampled.
    """
    if (length is None) == (budget is None):
        raise InputError("give either length or budget", item="length")
    _refuse(system, step, friction)
    row: dict[str, Any] = {
        "method": sampler.name,
        "title": sampler.title,
        "engine": "arrays",
        "adaptive": False,
        "setting": step / system.units.time_unit,
        "friction": friction * system.units.long_time_unit if sampler.frictions else 0.0,
        "note": "",
        "rounds": 0,
    }
    run = _Sampling(
        system, cheap, sampler, Setting(system.thermal_energy, step, friction, inner_step(system), seed_from(rng))
    )
    begun, warm = run.clock(), True
    try:
        while True:
            run.advance(warm)
            spent = run.clock() - begun
            share = run.state.time / ((1 + LEFT_OUT) * length) if length else spent / (budget or 1.0)
            warm = warm and share < LEFT_OUT
            if watcher is not None:
                watcher.advance(min(1.0, share))
            if share >= 1.0:
                break
    except Exception as error:  # a step that is too long for a sampler is a result, and is shown
        note = f"step {run.state.step + 1}: {first_line(error)}"
        return {**row, **run.told(), "status": "failed", "note": note}
    if len(run.energies) < MIN_SAMPLES:
        note = f"{len(run.energies)} samples are too few for an error"
        return {**row, **run.told(), "status": "partial", "note": note}
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", UserWarning)
        found = run.averages()
    note = "; ".join(dict.fromkeys(str(w.message) for w in said))
    return {**row, **run.told(), **found, "status": "ok", "note": note}


class _Sampling:
    """A run, and what was seen along it."""

    def __init__(self, system: TestSystem, cheap: TestSystem | None, sampler: Sampler, setting: Setting) -> None:
        self.potential, self.kt, self.step = system.potential, setting.thermal_energy, setting.step
        self.cheap = None if cheap is None else cheap.potential
        for potential in filter(None, (self.potential, self.cheap)):
            potential.forget()
        force: Any = self.potential.forces
        if sampler.several and self.cheap is not None and setting.inner_steps > 1:
            force = ForceGroups.difference(self.cheap.forces, force)
        self.stepper = sampler.make(setting)
        self.system = System(system.motion, force, potential=self.potential.energy)
        self.state = State(system.positions, system.velocities)
        flight = isinstance(self.stepper, HamiltonianMonteCarlo)  # which is a step
        self.every = 1 if flight else max(1, round(INTERVAL * setting.inner / self.step))
        # Looked at with forces of its own, which count for nobody.
        watched = System(system.motion, lambda x, t: system.potential.watched(x)[1])
        self.split, self.energies = TemperatureSplit(watched, rng=setting.seed), list[float]()
        self.clock = processor_clock(system)
        self.steps, self.seconds, self.before = 0, 0.0, (0, 0)

    @property
    def counts(self) -> tuple[int, int]:
        """Evaluations of the expensive and of the cheap forces so far."""
        return self.potential.evaluations, 0 if self.cheap is None else self.cheap.evaluations

    def advance(self, warm: bool) -> None:
        """To the next sample, which is left out while the run warms up."""
        begun = self.clock()
        for _ in range(self.every):
            self.state = self.stepper.step(self.system, self.state, self.step)
        if warm:
            self.before = self.counts
            return
        self.seconds += self.clock() - begun
        self.steps += self.every
        energy = self.potential.watched(self.state.positions)[0]
        if not math.isfinite(energy):
            raise ArithmeticError("the energy is not finite")
        self.split.add(self.state.positions)
        self.energies.append(energy)

    def told(self) -> dict[str, Any]:
        found: dict[str, Any] = {"steps": self.steps, "samples": len(self.energies)}
        found["cheap"] = self.counts[1] - self.before[1]
        if self.steps:
            found["step_seconds"] = self.seconds / self.steps
        if isinstance(self.stepper, HamiltonianMonteCarlo):
            found["accepted"] = Counts.of(self.state).acceptance
        return found

    def averages(self) -> dict[str, Any]:
        split, energy = self.split.result(), mean(self.energies)
        known = {kind: value for kind in KINDS if (value := getattr(split, kind)) is not None}
        found: dict[str, Any] = {"energy": energy.value, "energy_error": energy.error}
        for kind, value in known.items():
            found |= {kind: value.value / self.kt - 1, f"{kind}_error": value.error / self.kt}
        waits = (max((value.error / self.kt for value in known.values()), default=math.nan) / GOAL) ** 2
        found["error"] = max((abs(found[k]) + 2 * found[f"{k}_error"] for k in known), default=math.nan)
        return {**found, "seconds": waits * self.seconds, "evaluations": waits * (self.counts[0] - self.before[0])}


def code(system: TestSystem, name: str, setting: float, friction: float, made_by: str) -> str:
    """Lines of Python that run a sampler on a test system, as `kcons.comparison.code`; '' with cheap forces."""
    if SAMPLERS[name].several:
        return ""
    dt, rate = setting * system.units.time_unit, (friction or 1.0) / system.units.long_time_unit
    stepper = SAMPLERS[name].make(Setting(system.thermal_energy, dt, rate, inner_step(system), 1))
    imports = f"from kcons.thermostats import {type(stepper).__name__}"
    if "BlanesMoan4" in repr(stepper):
        imports = f"from kcons.steppers import BlanesMoan4\n{imports}"
    last = f"stepper = {stepper!r}\nend = run(system, start, {float(f'{dt:.15g}')!r}, 1000, stepper=stepper)\n"
    lines = lines_on_arrays(imports, last).replace("$made_by", made_by)
    return lines.replace("potential.forces)", "potential.forces, potential=test_system.potential.energy)")
