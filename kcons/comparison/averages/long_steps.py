"""How long may a step be: bias of averages against evaluations of the expensive forces.

A system has expensive forces (slow) and cheap ones (fast) that are nearly the same. Methods with one time step use the
expensive ones alone; those with several use the cheap ones often, and what expensive ones are more once a step. What is
right is known: all temperatures of the configurations are the one asked for, and for fluids the energy is that of
Metropolis sampling.
"""

from __future__ import annotations

import math
import textwrap
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from kcons.comparison.averages.layers import Layers
from kcons.comparison.machine import environment
from kcons.comparison.progress import Watcher
from kcons.comparison.study.asked import interruptible, noted, picked
from kcons.comparison.test_systems.system import Units
from kcons.constraints.arguments import positive
from kcons.errors import InputError
from kcons.steppers import BlanesMoan4, State, Stepper, System
from kcons.thermostats import (
    Counts,
    ForceGroups,
    HamiltonianMonteCarlo,
    IsokineticSpheres,
    Langevin,
    LangevinRespa,
    TemperatureSplit,
    mean,
    thermal_velocities,
)
from kcons.thermostats.multistep import autocorrelation_time

#: Fewest samples from which errors are taken.
FEWEST = 64
#: Share of a run that is left out at its start.
LEFT_OUT = 0.1
#: Standard errors up to which there is no bias that a run can see.
DOUBT = 3.0
#: Largest inner steps in one step.
MOST = 64


# -- methods ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Method:
    """A way to sample with two kinds of forces.

    Attributes
    ----------
    name, title : str
    make : callable
        Layers, step, friction and seed to a stepper.
    several : bool
        Whether it uses the cheap forces.
    frictions : bool
        Whether it has a friction.
    """

    name: str
    title: str
    make: Callable[[Layers, float, float, int], Stepper]
    several: bool = True
    frictions: bool = True


def _groups(layers: Layers, step: float) -> dict[str, int]:
    return {"slow": 1, "fast": layers.inner_steps(step)}


def _langevin(layers: Layers, step: float, friction: float, seed: int) -> Stepper:
    return Langevin(layers.thermal_energy, friction, seed, substeps=1)


def _respa(layers: Layers, step: float, friction: float, seed: int) -> Stepper:
    if layers.inner_steps(step) == 1:
        return _langevin(layers, step, friction, seed)
    return LangevinRespa(layers.thermal_energy, friction, seed, steps=_groups(layers, step), substeps=1)


def _halfway(layers: Layers, step: float, friction: float, seed: int) -> Stepper:
    """With slow kicks in the middle of a step, so that states lie halfway between them."""
    steps = _groups(layers, step)
    if steps["fast"] == 1:
        return _langevin(layers, step, friction, seed)
    steps["fast"] += steps["fast"] % 2  # of an odd number none ends in the middle
    return LangevinRespa(layers.thermal_energy, friction, seed, steps=steps, slow_kicks="middle", substeps=1)


def _spheres(layers: Layers, step: float, friction: float, seed: int) -> Stepper:
    if layers.inner_steps(step) == 1:
        return IsokineticSpheres(layers.thermal_energy, friction, seed, substeps=1)
    return IsokineticSpheres(layers.thermal_energy, friction, seed, steps=_groups(layers, step), substeps=1)


def _monte_carlo(layers: Layers, step: float, friction: float, seed: int) -> Stepper:
    count = max(1, round(layers.flight / step))
    few = max(1, count // 2)
    return HamiltonianMonteCarlo(layers.thermal_energy, (few, count + count - few), seed, stepper=BlanesMoan4())


METHODS: Mapping[str, Method] = {
    method.name: method
    for method in (
        Method("langevin", "Langevin, one step", _langevin, several=False),
        Method("langevin-respa", "Langevin, several steps", _respa),
        Method("langevin-halfway", "the same, read between kicks", _halfway),
        Method("spheres", "isokinetic spheres", _spheres),
        Method("hmc", "Hamiltonian Monte Carlo, order 4", _monte_carlo, several=False, frictions=False),
    )
}


def chosen(names: Iterable[str] | None) -> list[Method]:
    """Methods by name; all of them by default, or for 'all'.

    Raises
    ------
    InputError
        Unknown name, or none.
    """
    wanted = ["all"] if names is None else list(names)
    return [METHODS[name] for name in picked(None if wanted == ["all"] else wanted, METHODS, "method", "methods")]


# -- runs -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Stepped:
    """One method at one step.

    Attributes
    ----------
    method : str
    step, friction : float
        In the units of time that are shown; friction 0 where there is none.
    status : {'ok', 'partial', 'failed'}
    length : float
        Time that was sampled.
    evaluations, cheap : int
        Of the expensive and of the cheap forces meanwhile.
    kinds : mapping of str to (float, float)
        Temperatures of shifts, turns and internal motions over the one asked for, less 1, with standard errors.
    energy : (float, float)
        Mean potential energy a molecule with its standard error.
    energy_off : (float, float) or None
        The same less the reference, with the error of both.
    correlation : float
        Statistical inefficiency of the energy, in evaluations of the expensive forces for an independent sample.
    observed : mapping of str to (float, float, float)
        Means of the observables of the layers with standard errors, and evaluations for an independent sample.
    seconds : float
        Processor time.
    """

    method: str
    step: float
    friction: float
    status: str
    note: str = ""
    length: float = 0.0
    evaluations: int = 0
    cheap: int = 0
    samples: int = 0
    kinds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    energy: tuple[float, float] = (math.nan, math.nan)
    energy_off: tuple[float, float] | None = None
    correlation: float = math.nan
    observed: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    accepted: float | None = None
    seconds: float = 0.0

    @property
    def per_time(self) -> float:
        """Evaluations of the expensive forces in a unit of time."""
        return self.evaluations / self.length

    @property
    def bias(self) -> float:
        """Largest bias of a temperature of the configurations, relative, beyond what three standard errors explain."""
        return max((abs(off) - DOUBT * error for off, error in self.kinds.values()), default=0.0)

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)


def measure(
    layers: Layers,
    method: Method,
    step: float,
    friction: float,
    *,
    length: float | None = None,
    budget: float | None = None,
    seed: int = 1,
    watcher: Watcher | None = None,
) -> Stepped:
    """Run one method at one step.

    Parameters
    ----------
    layers : Layers
    method : Method
    step, friction : float
    length : float, optional
        Time to sample, besides a tenth of it that is left out at the start.
    budget : float, optional
        Instead: seconds of processor time.
    seed : int
    watcher : Watcher, optional

    Raises
    ------
    InputError
        Neither or both of `length` and `budget`; a step or friction that is not positive.
    """
    if (length is None) == (budget is None):
        raise InputError("give either length or budget", item="length")
    for value, name in ((length, "length"), (budget, "budget")):
        if value is not None:
            positive(value, name)
    _refuse(layers, step, friction)
    shown: dict[str, Any] = {
        "method": method.name,
        "step": step / layers.units.time_unit,
        "friction": friction * layers.units.time_unit if method.frictions else 0.0,
    }
    run = _Run(layers, method, step, friction, seed)
    failure = run.through(length, budget, watcher or Watcher())
    shown |= run.told()
    if failure:
        return Stepped(status="failed", note=failure, **shown)
    if run.samples < FEWEST:
        return Stepped(status="partial", note=f"{run.samples} samples are too few for an error", **shown)
    averages, note = noted(run.averages)
    return Stepped(status="ok", note=note, **shown, **averages)


def _refuse(layers: Layers, step: float, friction: float) -> None:
    """Raise `InputError` for a step or a friction that no run can have."""
    positive(step, "dt")
    positive(friction, "friction")
    if layers.inner_steps(step) > MOST:
        raise InputError(f"a step of {step / layers.units.time_unit:g} {layers.units.time} is too long", item="dt")


class _Run:
    """A run, and what was seen along it."""

    def __init__(self, layers: Layers, method: Method, step: float, friction: float, seed: int) -> None:
        self.layers, self.step = layers, step
        slow, fast = layers.slow, layers.fast
        slow.forget()
        fast.forget()
        force: Any = slow.forces
        self.stepper = method.make(layers, step, friction, seed)
        if method.several and layers.inner_steps(step) > 1:
            force = ForceGroups.difference(fast.forces, slow.forces)
        self.system = System(layers.motion, force, potential=slow.energy)
        self.single = method.frictions
        x = layers.positions
        self.state = State(x, thermal_velocities(self.system, x, layers.thermal_energy, seed))
        # Looked at with forces of its own, which count for nobody.
        self.watched = System(layers.motion, lambda x, t: slow.watched(x)[1])
        self.split = TemperatureSplit(self.watched, seed=seed)
        self.energies: list[float] = []
        self.seen: dict[str, list[float]] = {name: [] for name in layers.observables}
        self.time = self.length = self.seconds = 0.0
        self.before = (0, 0)

    @property
    def samples(self) -> int:
        return len(self.energies)

    def through(self, length: float | None, budget: float | None, watcher: Watcher) -> str:
        """Until it ends; what went wrong, if anything did."""
        layers = self.layers
        every = max(1, round(layers.interval / self.step)) if self.single else 1
        begun = time.process_time()
        warm = True
        try:
            while True:
                for _ in range(every):
                    self.state = self.stepper.step(self.system, self.state, self.step)
                self.seconds = time.process_time() - begun
                passed = self.state.time
                share = passed / ((1 + LEFT_OUT) * length) if length is not None else self.seconds / (budget or 1.0)
                if warm:
                    if share >= LEFT_OUT:
                        warm = False
                        self.time, self.before = passed, (layers.slow.evaluations, layers.fast.evaluations)
                    continue
                self.length = passed - self.time
                self._look()
                watcher.advance(min(1.0, share))
                if share >= 1.0:
                    return ""
        except Exception as error:  # a step that is too long for a method is a result, and is shown
            first = (str(error).strip().splitlines() or [""])[0]
            at = self.state.step + 1
            return textwrap.shorten(f"step {at}: {type(error).__name__}: {first}", 300)

    def _look(self) -> None:
        x = self.state.positions
        energy = self.layers.slow.watched(x)[0]
        if not math.isfinite(energy):
            raise ArithmeticError("the energy is not finite")
        self.split.add(x)
        self.energies.append(energy)
        for name, observable in self.layers.observables.items():
            self.seen[name].append(float(observable(x)))

    def told(self) -> dict[str, Any]:
        slow, fast = self.layers.slow.evaluations - self.before[0], self.layers.fast.evaluations - self.before[1]
        found: dict[str, Any] = {"evaluations": slow, "cheap": fast, "samples": self.samples, "seconds": self.seconds}
        found["length"] = self.length / self.layers.units.time_unit
        if isinstance(self.stepper, HamiltonianMonteCarlo):
            found["accepted"] = Counts.of(self.state).acceptance
        return found

    def averages(self) -> dict[str, Any]:
        layers = self.layers
        kt, per = layers.thermal_energy, layers.molecules
        told = self.split.result()
        kinds = {"shift": told.shift, "turn": told.turn, "internal": told.internal}
        energy = mean(self.energies)
        off = None
        if layers.reference is not None:
            error = math.hypot(energy.error, layers.reference.error)
            off = ((energy.value - layers.reference.value) / per, error / per)
        calls = (layers.slow.evaluations - self.before[0]) / self.samples
        return {
            "kinds": {name: (k.value / kt - 1, k.error / kt) for name, k in kinds.items() if k is not None},
            "energy": (energy.value / per, energy.error / per),
            "energy_off": off,
            "correlation": autocorrelation_time(self.energies) * calls,
            "observed": {name: (*mean(seen), autocorrelation_time(seen) * calls) for name, seen in self.seen.items()},
        }


@dataclass(frozen=True)
class StepComparison:
    """All that was found.

    Attributes
    ----------
    title : str
    units : Units
    reference : (float, float) or None
        Mean energy a molecule, where it is known, with its standard error.
    runs : sequence of Stepped
    settings, environment : mapping
    """

    title: str
    units: Units
    reference: tuple[float, float] | None
    runs: Sequence[Stepped]
    settings: Mapping[str, Any]
    environment: Mapping[str, Any]

    def to_dict(self) -> dict[str, Any]:
        """Plain data, as it goes to JSON; what is not a number is left out."""
        return {
            "format": "kcons-long-steps-1",
            "title": self.title,
            "units": {"length": self.units.length, "energy": self.units.energy, "time": self.units.time},
            "reference": self.reference,
            "settings": dict(self.settings),
            "environment": dict(self.environment),
            "runs": [_plain(run.to_dict()) for run in self.runs],
        }


def _plain(data: dict[str, Any]) -> dict[str, Any]:
    """Without what is not a number, which JSON does not have."""
    return {name: value for name, value in data.items() if not np.isnan(_first(value))}


def _first(value: Any) -> float:
    while isinstance(value, tuple | list) and value:
        value = value[0]
    return value if isinstance(value, float) else 0.0


def compare(
    layers: Layers,
    *,
    methods: Iterable[str] | None = None,
    steps: Sequence[float] | None = None,
    frictions: Sequence[float] | None = None,
    budget: float = 20.0,
    seed: int = 1,
    watcher: Watcher | None = None,
    settings: Mapping[str, Any] | None = None,
    partial: bool = False,
) -> StepComparison:
    """Run methods at several steps and frictions.

    Parameters
    ----------
    layers : Layers
    methods : iterable of str, optional
        Names out of `METHODS`; all by default.
    steps : sequence of float, optional
        Those of `layers` by default; methods with one time step take the first two of them only.
    frictions : sequence of float, optional
        Of which `best` keeps the best; 1 in 50 and 1 in 12.5 inner steps by default, 5 and 20 a ps for 4 fs.
    budget : float
        Seconds of processor time for each method over all its runs.
    seed : int
    watcher : Watcher, optional
    settings : mapping, optional
        What else to record with the result.
    partial : bool
        Whether Ctrl-C ends the comparison with the runs that are done, which `settings["interrupted"]` then says.

    Raises
    ------
    InputError
        Unknown method; steps, frictions or a budget that are not positive.
    """
    if not budget > 0:
        raise InputError(f"the budget is {budget} s; give a positive number of seconds", item="budget")
    for step in steps or ():
        if not (math.isfinite(step) and step > 0):
            shown = f"{step / layers.units.time_unit:g} {layers.units.time}"
            raise InputError(f"time step {shown}: give a positive number", item="steps")
    wanted, watching = chosen(methods), watcher or Watcher()
    asked = sorted(layers.steps if steps is None else steps)
    rates = (1 / (12.5 * layers.inner), 1 / (50 * layers.inner)) if frictions is None else tuple(frictions)
    planned: list[tuple[Method, float, float, float]] = []
    for method in wanted:
        lengths = asked if method.several or steps is not None else asked[:2]
        pairs = [(step, rate) for step in lengths for rate in (rates if method.frictions else rates[:1])]
        planned += [(method, *pair, budget / len(pairs)) for pair in pairs]
    for _, step, rate, _ in planned:
        _refuse(layers, step, rate)  # before the first run, whose results would be lost
    runs: list[Stepped] = []
    with interruptible(lambda: len(runs), len(planned), "runs", partial) as interrupted:
        for method, step, rate, share in planned:
            shown = f"{method.title}, {step / layers.units.time_unit:.3g} {layers.units.time}"
            with watching.piece(shown, 1):
                runs.append(measure(layers, method, step, rate, budget=share, seed=seed, watcher=watching))
    known = layers.reference
    return StepComparison(
        title=layers.title,
        units=layers.units,
        reference=None if known is None else (known.value / layers.molecules, known.error / layers.molecules),
        runs=runs,
        settings={
            "methods": [m.name for m in wanted],
            "budget_seconds": budget,
            "seed": seed,
            **(settings or {}),
            **interrupted,
        },
        environment=environment(),
    )


def best(runs: Iterable[Stepped]) -> list[Stepped]:
    """Of runs of each method and step the one with the friction that comes out best.

    That is the one of least bias of any temperature; of those without a visible one the one whose samples cost least,
    for the average that takes most.
    """
    kept: dict[tuple[str, float], Stepped] = {}
    for run in runs:
        key = run.method, run.step
        if key not in kept or _merit(run) < _merit(kept[key]):
            kept[key] = run
    return list(kept.values())


def _merit(run: Stepped) -> tuple[float, float]:
    if run.status != "ok":
        return math.inf, math.inf
    return max(run.bias, 0.0), max([run.correlation, *(calls for _, _, calls in run.observed.values())])
