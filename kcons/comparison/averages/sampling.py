"""Run a fluid through thermostats and measure how far its averages are from the right ones, after how much time.

The temperature of the configurations is known: it is the one asked for. The mean energy is compared with that of plain
Metropolis sampling. Every run starts from an equilibrated configuration that Metropolis sampling left behind.
"""

from __future__ import annotations

import math
import textwrap
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

import numpy as np

from kcons.comparison.averages.step_zero import Extrapolated, extrapolate
from kcons.comparison.machine import environment
from kcons.comparison.progress import Watcher
from kcons.comparison.study.asked import interruptible, noted, picked
from kcons.comparison.test_systems.fluid import Fluid
from kcons.constraints.compilation import clock
from kcons.constraints.target import FloatArray
from kcons.errors import InputError
from kcons.steppers import State, Stepper
from kcons.thermostats import (
    Estimate,
    Isokinetic,
    Langevin,
    NoseHooverChain,
    configurational_temperature,
    freedom,
    mean,
    thermal_velocities,
)

#: Fewest samples from which an error is taken.
FEWEST = 64
#: Parts of a run after which it is shown how far it has come.
PARTS = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)
#: Relative standard error of the temperature for which the cost is stated.
GOAL = 0.01
#: Metropolis moves of each molecule before any is counted, between two records, and in one go.
_WARM, _EVERY, _BATCH = 3000, 10, 500

Status = Literal["ok", "partial", "failed"]


@dataclass(frozen=True)
class Thermostat:
    """A way to sample.

    Attributes
    ----------
    name, title : str
    make : callable
        Fluid and seed to the stepper.
    """

    name: str
    title: str
    make: Callable[[Fluid, int], Stepper]


# Total momentum is zero and conserved in a periodic fluid; only noise changes it.
METHODS: Mapping[str, Thermostat] = {
    method.name: method
    for method in (
        Thermostat(
            "isokinetic",
            "isokinetic, 2K = (g - 1) kT",
            lambda fluid, seed: Isokinetic(fluid.thermal_energy, momentum="conserved"),
        ),
        Thermostat(
            "isokinetic-notes",
            "isokinetic, 2K = 3N kT",
            lambda fluid, seed: Isokinetic(fluid.thermal_energy, convention="notes", momentum="conserved"),
        ),
        Thermostat(
            "langevin",
            "Langevin, g-BAOAB",
            lambda fluid, seed: Langevin(fluid.thermal_energy, fluid.friction, seed, substeps=1),
        ),
        Thermostat(
            "nose-hoover",
            "Nosé-Hoover chain",
            lambda fluid, seed: NoseHooverChain(fluid.thermal_energy, fluid.period, momentum="conserved"),
        ),
    )
}


@dataclass(frozen=True)
class Moment:
    """How far a run has come after part of its time: errors of the averages with their standard errors."""

    steps: int
    evaluations: int
    seconds: float
    temperature_error: float
    temperature_standard_error: float
    energy_error: float
    energy_standard_error: float


@dataclass(frozen=True)
class Sampled:
    """One thermostat at one time step.

    Attributes
    ----------
    setting : float
        Time step in the unit that the fluid shows.
    status : {'ok', 'partial', 'failed'}
        'partial': too few samples for an error.
    steps, samples, evaluations : int
    seconds : float
        Wall time of the steps, without that of the samples.
    step_seconds : float
    temperature_error, temperature_standard_error : float
        kT of the configurations over kT asked for, less 1.
    energy_error, energy_standard_error : float
        Mean potential energy a molecule less that of Metropolis sampling; the error of both.
    kinds : mapping of str to (float, float)
        The same as `temperature_error` for 'shift' and 'turn' of whole molecules, as far as there are any.
    seconds_to_goal, evaluations_to_goal : float
        Wall time and force evaluations until the standard error of the temperature is `GOAL`.
    growth : list of Moment
        The same after parts of the run.
    """

    method: str
    title: str
    setting: float
    status: Status
    note: str = ""
    steps: int = 0
    samples: int = 0
    evaluations: int = 0
    seconds: float = 0.0
    step_seconds: float | None = None
    temperature_error: float | None = None
    temperature_standard_error: float | None = None
    energy_error: float | None = None
    energy_standard_error: float | None = None
    kinds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    seconds_to_goal: float | None = None
    evaluations_to_goal: float | None = None
    growth: Sequence[Moment] = ()


@dataclass(frozen=True)
class SamplingComparison:
    """All that was found.

    Attributes
    ----------
    scene : mapping
        Name, title, sizes, degrees of freedom, kT, units, and by how much 2K = 3N kT is off.
    reference : mapping
        Mean energy a molecule by Metropolis sampling, its standard error, the number of moves of each molecule.
    settings, environment : mapping
    measurements : list of Sampled
    """

    scene: Mapping[str, Any]
    reference: Mapping[str, Any]
    settings: Mapping[str, Any]
    environment: Mapping[str, Any]
    measurements: Sequence[Sampled] = field(default_factory=list)

    def of(self, method: str) -> list[Sampled]:
        """Measurements of one thermostat that have an error, coarsest first."""
        return [m for m in self.measurements if m.method == method and m.status == "ok"]

    def extrapolated(self, method: str) -> dict[str, Extrapolated]:
        """Errors of one thermostat at step zero: 'temperature', 'energy', and those of `kinds`; see `extrapolate`.

        Empty for fewer than two steps. The error of the reference comes on top of that of the energy, and is in it.
        """
        runs = self.of(method)
        if len({m.setting for m in runs}) < 2:
            return {}
        steps, known = [m.setting for m in runs], float(self.reference["standard_error"])
        series: dict[str, list[tuple[float, float]]] = {name: [m.kinds[name] for m in runs] for name in runs[0].kinds}
        series["temperature"] = [(m.temperature_error or 0.0, m.temperature_standard_error or 0.0) for m in runs]
        # All runs are compared with one reference, whose error they share.
        own = [math.sqrt(max((m.energy_standard_error or 0.0) ** 2 - known**2, 0.0)) for m in runs]
        series["energy"] = [(m.energy_error or 0.0, error) for m, error in zip(runs, own, strict=True)]
        found = {}
        for name, averages in series.items():
            if all(error > 0 for _, error in averages):
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # said in the table
                    found[name] = extrapolate(steps, averages)
        if "energy" in found:
            found["energy"] = replace(found["energy"], error=math.hypot(found["energy"].error, known))
        return found

    def to_dict(self) -> dict[str, Any]:
        """Plain data, as it goes to JSON."""
        names = dict.fromkeys(m.method for m in self.measurements)
        at_zero = {name: {what: asdict(e) for what, e in self.extrapolated(name).items()} for name in names}
        return {
            "format": "kcons-sampling-1",
            "extrapolated": {name: found for name, found in at_zero.items() if found},
            "scene": dict(self.scene),
            "reference": dict(self.reference),
            "settings": dict(self.settings),
            "environment": dict(self.environment),
            "measurements": [asdict(m) for m in self.measurements],
        }


def chosen(names: Iterable[str] | None) -> list[Thermostat]:
    """Thermostats by name; all of them by default, or for 'all'.

    Raises
    ------
    InputError
        Unknown name, or none.
    """
    wanted = ["all"] if names is None else list(names)
    return [METHODS[name] for name in picked(None if wanted == ["all"] else wanted, METHODS, "thermostat", "methods")]


def compare(
    fluid: Fluid,
    *,
    methods: Iterable[str] | None = None,
    budget: float = 20.0,
    most: int | None = None,
    seed: int = 1,
    watcher: Watcher | None = None,
    settings: Mapping[str, Any] | None = None,
    partial: bool = False,
) -> SamplingComparison:
    """Sample `fluid` by thermostats.

    Parameters
    ----------
    fluid : Fluid
    methods : iterable of str, optional
        Names out of `METHODS`; all by default.
    budget : float
        Seconds for each thermostat over all its time steps, of which each gets an equal share, and for Metropolis
        sampling.
    most : int, optional
        Samples after which a run ends even if there is time left: then results can be repeated.
    seed : int
        Of velocities, noise and Monte Carlo moves.
    watcher : Watcher, optional
    settings : mapping, optional
        What else to record with the result.
    partial : bool
        Whether Ctrl-C ends the comparison with the runs that are done, which `settings["interrupted"]` then says.

    Raises
    ------
    InputError
        Unknown method; a budget that is not positive; fewer than 64 samples.
    """
    if not budget > 0:
        raise InputError(f"the budget is {budget} s; give a positive number of seconds", item="budget")
    if most is not None and most < FEWEST:
        raise InputError(f"{most} samples are too few for an error; give {FEWEST} or more", item="most")
    thermostats = chosen(methods)
    watching = watcher or Watcher()
    with watching.piece("Metropolis sampling", budget):
        energy, start, moves = _metropolis(fluid, budget, most, seed, watching)

    measurements: list[Sampled] = []
    share = budget / len(fluid.time_steps)
    planned = len(thermostats) * len(fluid.time_steps)
    with interruptible(lambda: len(measurements), planned, "runs", partial) as interrupted:
        for method in thermostats:
            for dt in fluid.time_steps:
                with watching.piece(f"{method.title}, {dt / fluid.units.time_unit:.3g} {fluid.units.time}", share):
                    measurements.append(_measured(fluid, method, dt, start, energy, share, most, seed, watching))
    return SamplingComparison(
        scene=_described(fluid, start, seed),
        reference={
            "how": "Metropolis sampling",
            "energy": energy.value / fluid.n_molecules,
            "standard_error": energy.error / fluid.n_molecules,
            "moves_of_each_molecule": moves,
        },
        settings={
            "methods": [m.name for m in thermostats],
            "budget_seconds": budget,
            "most": most,
            **(settings or {}),
            **interrupted,
        },
        environment=environment(),
        measurements=measurements,
    )


def _described(fluid: Fluid, start: FloatArray, seed: int) -> dict[str, Any]:
    system = fluid.system()
    state = system.with_forces(State(start, _velocities(fluid, start, seed)))
    assert state.forces is not None
    g = freedom(system, state, state.forces, None, "conserved").count
    return {
        "name": fluid.name,
        "title": fluid.title,
        "atoms": len(fluid.positions),
        "molecules": fluid.n_molecules,
        "rank": fluid.motion.rank,
        "degrees_of_freedom": g,
        "thermal_energy": fluid.thermal_energy,
        "notes_temperature_error": 3 * len(fluid.positions) / (g - 1) - 1,
        "units": {"length": fluid.units.length, "energy": fluid.units.energy, "time": fluid.units.time},
    }


def _velocities(fluid: Fluid, x: FloatArray, seed: int) -> FloatArray:
    return thermal_velocities(fluid.system(), x, fluid.thermal_energy, seed, zero_momentum=True)


def _metropolis(
    fluid: Fluid, budget: float, most: int | None, seed: int, watcher: Watcher
) -> tuple[Estimate, FloatArray, int]:
    """Mean energy, a configuration at equilibrium, and moves of each molecule."""
    moved = (fluid.shift, fluid.turn)
    _, x, _ = fluid.forces.metropolis(fluid.positions, fluid.thermal_energy, _WARM, _EVERY, seed, *moved)
    begun = clock()
    energies: list[FloatArray] = []
    limit = math.inf if most is None else most * _EVERY
    while len(energies) * _BATCH < limit:
        part, x, _ = fluid.forces.metropolis(x, fluid.thermal_energy, _BATCH, _EVERY, (seed, len(energies)), *moved)
        energies.append(part)
        used = clock() - begun
        watcher.advance(min(used, budget))
        if most is None and used > budget and len(energies) * len(part) >= FEWEST:
            break
    return mean(np.concatenate(energies)), x, _BATCH * len(energies)


class _Counted:
    """Forces that are counted."""

    def __init__(self, force: Callable[[FloatArray, float], FloatArray]) -> None:
        self.force, self.calls = force, 0

    def __call__(self, x: FloatArray, time: float) -> FloatArray:
        self.calls += 1
        return self.force(x, time)


def _measured(
    fluid: Fluid,
    method: Thermostat,
    dt: float,
    start: FloatArray,
    energy: Estimate,
    share: float,
    most: int | None,
    seed: int,
    watcher: Watcher,
) -> Sampled:
    counted = _Counted(fluid.forces.force)
    log = _Log(every=max(1, round(fluid.interval / dt)))
    failure = ""
    try:
        system, stepper = fluid.system(counted), method.make(fluid, seed)
        # The first step compiles, and starts the thermostat.
        state = stepper.step(system, State(start, _velocities(fluid, start, seed)), dt)
        counted.calls = 0
        begun = clock()
        while most is None or len(log.seconds) < most:
            then = clock()
            for _ in range(log.every):
                state = stepper.step(system, state, dt)
            now = clock()
            log.add(now - then, counted.calls, fluid, state.positions)
            if not all(map(math.isfinite, (*log.slopes[-1], log.energies[-1]))):
                raise ArithmeticError("energies are not finite")
            watcher.advance(min(now - begun, share))
            if most is None and now - begun > share:
                break
    except Exception as error:  # a step too large for a thermostat is a result, and is shown
        first = (str(error).strip().splitlines() or [""])[0]
        failure = textwrap.shorten(f"step {len(log.seconds) * log.every + 1}: {type(error).__name__}: {first}", 300)
    count = len(log.seconds)
    common: dict[str, Any] = {
        "method": method.name,
        "title": method.title,
        "setting": dt / fluid.units.time_unit,
        "steps": count * log.every,
        "samples": count,
        "evaluations": log.calls[-1] if count else 0,
        "seconds": float(sum(log.seconds)),
        "step_seconds": float(np.median(log.seconds)) / log.every if count else None,
    }
    if failure:
        return Sampled(status="failed", note=failure, **common)
    if count < FEWEST:
        note = f"{count} samples in the budget are too few for an error; give it more"
        return Sampled(status="partial", note=note, **common)
    counts = [round(part * count) for part in PARTS]
    # Errors of parts of a run rest on fewer samples than that of the whole, which has a note if they are too few.
    told = [noted(lambda n=n: _moment(log, n, fluid, energy)) for n in counts if n >= FEWEST]  # type: ignore[misc]
    growth = [moment for moment, _ in told]
    kinds, doubt = noted(lambda: _kinds(log, fluid))
    last = growth[-1]
    waits = (last.temperature_standard_error / GOAL) ** 2
    return Sampled(
        status="ok",
        note="; ".join(dict.fromkeys(filter(None, (told[-1][1], doubt)))),
        temperature_error=last.temperature_error,
        temperature_standard_error=last.temperature_standard_error,
        energy_error=last.energy_error,
        energy_standard_error=last.energy_standard_error,
        # By the median: other work on the machine comes in bursts.
        seconds_to_goal=waits * last.steps * common["step_seconds"],
        evaluations_to_goal=waits * last.evaluations,
        kinds=kinds,
        growth=growth,
        **common,
    )


def _kinds(log: _Log, fluid: Fluid) -> dict[str, tuple[float, float]]:
    """Temperatures of shifts and of turns over the one asked for, less 1, with their errors."""
    shift, bend, turn, twist = np.transpose(log.slopes)
    found = {"shift": configurational_temperature(shift, bend)}
    if turn.any():
        found["turn"] = configurational_temperature(turn, twist)
    kt = fluid.thermal_energy
    return {name: (thermal.value / kt - 1, thermal.error / kt) for name, thermal in found.items()}


class _Log:
    def __init__(self, every: int) -> None:
        self.every = every
        self.seconds: list[float] = []
        self.calls: list[int] = []
        #: Squares and curvatures of shifts, then of turns.
        self.slopes: list[tuple[float, float, float, float]] = []
        self.energies: list[float] = []

    def add(self, seconds: float, calls: int, fluid: Fluid, x: FloatArray) -> None:
        slopes = fluid.forces.split_sample(x)
        self.seconds.append(seconds)
        self.calls.append(calls)
        self.slopes.append(slopes)
        self.energies.append(fluid.forces.potential(x))


def _moment(log: _Log, count: int, fluid: Fluid, energy: Estimate) -> Moment:
    shift, bend, turn, twist = np.transpose(log.slopes[:count])
    thermal = configurational_temperature(shift + turn / fluid.arm**2, bend + twist / fluid.arm**2)
    found = mean(log.energies[:count])
    return Moment(
        steps=count * log.every,
        evaluations=log.calls[count - 1],
        seconds=float(sum(log.seconds[:count])),
        temperature_error=thermal.value / fluid.thermal_energy - 1,
        temperature_standard_error=thermal.error / fluid.thermal_energy,
        energy_error=(found.value - energy.value) / fluid.n_molecules,
        energy_standard_error=math.hypot(found.error, energy.error) / fluid.n_molecules,
    )
