"""The methods: steppers of kcons on arrays, ASE's dynamics, SciPy, and by name those of OpenMM."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from ase import Atoms
from ase.md.verlet import VelocityVerlet
from scipy.integrate import DOP853

from kcons import steppers
from kcons.ase import Constraints
from kcons.comparison.methods.engines import InAse, OfStates, OnArrays, ase_constraints
from kcons.comparison.methods.method import ENGINE_CALLS, Method, Run, independent_rows, matched_steps
from kcons.comparison.methods.openmm import OPENMM_METHODS
from kcons.comparison.methods.peers import PEERS
from kcons.comparison.test_systems import TestSystem
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, KconsError, did_you_mean
from kcons.motion.motion import Motion
from kcons.steppers import Rattle, State, Stepper, System
from kcons.steppers.adaptive.tolerated import ToTolerance

#: The steppers of kcons by the names they have as methods, the plain one first, those for comparison last.
STEPPERS: Mapping[str, type[Stepper]] = {
    "rattle": steppers.Rattle,
    "geodesic": steppers.Geodesic,
    "suzuki4": steppers.Suzuki4,
    "yoshida4": steppers.Yoshida4,
    "kahan-li6": steppers.KahanLi6,
    "blanes-moan4": steppers.BlanesMoan4,
    "blanes-moan6": steppers.BlanesMoan6,
    "blanes-moan6a": steppers.BlanesMoan6a,
    "projected-verlet": steppers.ProjectedVerlet,
    "projected-rk4": steppers.ProjectedRungeKutta4,
    "baumgarte": steppers.Baumgarte,
}

#: The steppers that run unless methods are named: the plain one, and of each order a composition and a splitting.
USUAL_STEPPERS = ("rattle", "suzuki4", "kahan-li6", "blanes-moan4", "blanes-moan6")

#: Rate of a stepper's feedback, in inverse time steps: fast, and well within what is stable.
FEEDBACK = 0.1

#: ASE's hooks.
ASE_HOOKS = ("adjust_positions", "adjust_momenta", "adjust_forces", "redistribute_forces_md")


# -- kcons ------------------------------------------------------------------------------------------


class _CoreRun(OnArrays):
    def __init__(self, test_system: TestSystem, motion: Motion, stepper: Stepper, dt: float) -> None:
        stepper.check(system := System(motion, test_system.potential.forces, friction=test_system.friction))
        start = system.with_forces(State(test_system.positions, test_system.velocities))
        super().__init__(system, start, stepper, dt, round(test_system.horizon / dt))
        self.constraints.watch(motion, ENGINE_CALLS)
        self._potential = test_system.potential

    def rewind(self) -> None:
        super().rewind()
        # The end of the last step is no longer the last point known.
        self._potential.forces(self._start.positions)


@dataclass(frozen=True)
class CoreStepper(Method):
    """A stepper of `kcons.steppers`, arrays in and arrays out.

    A stepper with s force evaluations a step takes steps s times as long as RATTLE, so that all cost about the same.

    Attributes
    ----------
    make : callable
        The stepper for a given time step.
    """

    marches: ClassVar[bool] = True

    make: Callable[[float], Stepper] = lambda dt: Rattle()
    damps: bool = True

    @property
    def stepper(self) -> Stepper:
        """The stepper for a step of 1: order, cost and name are the same for all."""
        return self.make(1.0)

    def settings(self, test_system: TestSystem) -> tuple[float, ...]:
        return matched_steps(test_system, self.stepper.force_evaluations)

    def warm_up(self, test_system: TestSystem) -> None:
        dt = min(test_system.time_steps)
        system = System(test_system.motion, test_system.potential.forces, friction=test_system.friction)
        start = State(test_system.positions, test_system.velocities)
        stepper = self.make(dt)
        stepper.step(system, start, dt)
        steppers.run(system, start, dt, 2, stepper=stepper)

    def start(self, test_system: TestSystem, setting: float) -> Run:
        # What does not keep the positions on the surface cannot have rows that depend on each other there.
        held = test_system.constraint_set if self.stepper.symplectic else independent_rows(test_system)
        stepper = self.make(setting)
        return _CoreRun(test_system, Motion(held, test_system.positions), stepper, setting)


class CoreVerlet(Method):
    """RATTLE with nothing held: what a step costs before any constraint."""

    marches = True

    def warm_up(self, test_system: TestSystem) -> None:
        run = self.start(test_system, min(test_system.time_steps))
        run.advance()
        run.march(2)

    def start(self, test_system: TestSystem, setting: float) -> Run:
        nothing = Motion(ConstraintSet([], test_system.positions, test_system.masses), test_system.positions)
        return _CoreRun(test_system, nothing, Rattle(), setting)


def of_steppers(found: Mapping[str, Any]) -> list[CoreStepper]:
    """A method for each stepper by name: classes that can do without arguments but the `rate` of a feedback."""
    return [
        CoreStepper(
            name,
            f"kcons {'RATTLE' if kind is Rattle else kind.__name__}",
            usual=name in USUAL_STEPPERS,
            make=_maker(kind),
        )
        for name, kind in found.items()
    ]


def _maker(kind: Callable[..., Stepper]) -> Callable[[float], Stepper]:
    if "rate" in inspect.signature(kind).parameters:
        return lambda dt: kind(rate=FEEDBACK / dt)
    return lambda dt: kind()


class _AdaptiveRun(OfStates):
    def __init__(self, test_system: TestSystem, scheme: ToTolerance) -> None:
        super().__init__()
        motion = Motion(test_system.constraint_set, test_system.positions)
        self.constraints.watch(motion, ENGINE_CALLS)
        system = System(motion, test_system.potential.forces, friction=test_system.friction)
        self._state = State(test_system.positions, test_system.velocities)
        self._horizon = test_system.horizon
        self.grows = isinstance(scheme, steppers.Multistep)
        self._states = scheme.states(system, self._state, test_system.horizon)

    def advance(self) -> None:
        self._state = next(self._states)
        self.divided = self.constraints.seconds > 0.0

    @property
    def time(self) -> float:
        return self._state.time

    @property
    def finished(self) -> bool:
        return self.time == self._horizon


@dataclass(frozen=True)
class Adaptive(Method):
    """`kcons.steppers.Extrapolation` and `Multistep`, which choose size and order; their settings are tolerances.

    Attributes
    ----------
    scheme : callable (tolerance) -> ToTolerance
    """

    scheme: Callable[[float], ToTolerance] = steppers.Extrapolation

    def start(self, test_system: TestSystem, setting: float) -> Run:
        return _AdaptiveRun(test_system, self.scheme(setting))


# -- ASE --------------------------------------------------------------------------------------------


class _AseRun(InAse):
    def __init__(self, test_system: TestSystem, dt: float, *constraints: Any) -> None:
        atoms = test_system.atoms()
        self._test_system, self._momenta = test_system, atoms.get_momenta()
        atoms.set_constraint(constraints)
        super().__init__(atoms, VelocityVerlet(atoms, timestep=dt), dt, round(test_system.horizon / dt))
        # set_constraint keeps the objects themselves, so that their hooks can be timed.
        for item in atoms.constraints:
            self.constraints.watch(item, ASE_HOOKS)
        test_system.potential.forces(atoms.positions)

    def rewind(self) -> None:
        self._atoms.positions[:] = self._test_system.positions
        # Constraints would change them by what rounding leaves.
        self._atoms.set_momenta(self._momenta, apply_constraint=False)
        self._test_system.potential.forces(self._test_system.positions)


class AseMethod(Method):
    """ASE's VelocityVerlet."""

    marches = True


class AseKcons(AseMethod):
    """ASE's VelocityVerlet with `kcons.ase.Constraints`."""

    def warm_up(self, test_system: TestSystem) -> None:
        self.start(test_system, min(test_system.time_steps)).advance()

    def start(self, test_system: TestSystem, setting: float) -> Run:
        held = Constraints(test_system.constraint_set.constraints)
        return _AseRun(test_system, setting, held)


class AseVerlet(AseMethod):
    """ASE's VelocityVerlet with nothing held."""

    def start(self, test_system: TestSystem, setting: float) -> Run:
        return _AseRun(test_system, setting)


class AseBonds(AseMethod):
    """ASE's VelocityVerlet with FixBondLengths at its own tolerance, angles held by their end distances."""

    def refuses(self, test_system: TestSystem) -> str | None:
        return super().refuses(test_system) or (None if test_system.bonds is not None else "it holds distances only")

    def start(self, test_system: TestSystem, setting: float) -> Run:
        assert test_system.bonds is not None
        lengths = _distances(test_system.atoms(), test_system.bonds)
        return _AseRun(
            test_system, setting, *ase_constraints(test_system.fixed, test_system.bonds, lengths, internals=False)
        )


class AseInternals(AseMethod):
    """ASE's VelocityVerlet with FixInternals at its own tolerance."""

    def refuses(self, test_system: TestSystem) -> str | None:
        return super().refuses(test_system) or (
            None if test_system.bonds is not None else "it holds internal coordinates only"
        )

    def start(self, test_system: TestSystem, setting: float) -> Run:
        bonds = test_system.bonds if test_system.angle_bonds is None else test_system.angle_bonds
        assert bonds is not None
        atoms = test_system.atoms()
        lengths = _distances(atoms, bonds)
        degrees = [atoms.get_angle(*triple) for triple in test_system.angles]
        held = ase_constraints(test_system.fixed, bonds, lengths, test_system.angles, degrees, internals=True)
        return _AseRun(test_system, setting, *held)


def _distances(atoms: Atoms, pairs: IntArray) -> FloatArray:
    x = atoms.positions
    return np.asarray(np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1))


# -- SciPy ------------------------------------------------------------------------------------------


class _OdeRun(Run):
    def __init__(self, test_system: TestSystem, rtol: float, *, project: bool) -> None:
        super().__init__()
        # Off the surface, where this equation drifts, rows that depend on each other contradict each other.
        motion = Motion(independent_rows(test_system), test_system.positions)
        self.constraints.watch(motion, ENGINE_CALLS)
        shape, half = test_system.positions.shape, test_system.positions.size

        def rate(t: float, y: FloatArray) -> FloatArray:
            x, v = y[:half].reshape(shape), y[half:].reshape(shape)
            f = self._force = test_system.potential.forces(x, t)
            if test_system.friction:
                f = f - test_system.friction * test_system.masses[:, None] * v
            return np.concatenate([y[half:], motion.acceleration(x, v, f, t).ravel()])

        speed = float(np.sqrt(np.mean(test_system.velocities**2)))
        # Errors are measured against one unit of length and the thermal speed, not against each entry.
        scale = np.concatenate([np.ones(half), np.full(half, speed if speed > 0 else 1.0)])
        start = np.concatenate([test_system.positions.ravel(), test_system.velocities.ravel()])
        self._shape, self._half = shape, half
        self._motion, self._project, self._damping = motion, project, test_system.friction * test_system.masses[:, None]
        self._solver = DOP853(rate, 0.0, start, test_system.horizon, rtol=max(rtol, 1e-13), atol=rtol * scale)

    def advance(self) -> None:
        message = self._solver.step()
        if self._solver.status == "failed":
            raise KconsError(f"DOP853 gave up at t = {self._solver.t:g}: {message}")
        if self._project:
            self._land()

    @property
    def time(self) -> float:
        return float(self._solver.t)

    def _land(self) -> None:
        """Back onto the constraints, by less than the tolerance: the force known there need not be computed again."""
        motion, t = self._motion, self.time
        x = motion.project_positions(self.positions, self.positions, time=t)
        v = motion.project_velocities(x, self.velocities, time=t)
        a = motion.acceleration(x, v, self._force - self._damping * v, t)
        self._solver.y = np.concatenate([x.ravel(), v.ravel()])
        self._solver.f = np.concatenate([v.ravel(), a.ravel()])

    @property
    def finished(self) -> bool:
        return bool(self._solver.status == "finished")

    @property
    def positions(self) -> FloatArray:
        return np.asarray(self._solver.y[: self._half]).reshape(self._shape)

    @property
    def velocities(self) -> FloatArray:
        return np.asarray(self._solver.y[self._half :]).reshape(self._shape)


@dataclass(frozen=True)
class ProjectedOde(Method):
    """SciPy's DOP853 on a = M_par^+ f + M^-1 A^T (A M^-1 A^T)^-1 b (notes eq. 105).

    Attributes
    ----------
    project : bool
        Whether the engine brings positions and velocities back onto the constraints after each step (Hairer, Lubich
        and Wanner, Geometric Numerical Integration, IV.4); otherwise nothing stops a drift.
    """

    project: bool = False

    def start(self, test_system: TestSystem, setting: float) -> Run:
        return _OdeRun(test_system, setting, project=self.project)


METHODS: Mapping[str, Method] = {
    method.name: method
    for method in (
        *of_steppers(STEPPERS),
        Adaptive("extrapolation", "kcons Extrapolation", adaptive=True, damps=True),
        Adaptive("multistep", "kcons Multistep", adaptive=True, damps=True, usual=False, scheme=steppers.Multistep),
        AseKcons("ase-kcons", "ASE Verlet + kcons", md_engine="ase"),
        AseBonds("ase-bonds", "ASE Verlet + FixBondLengths", md_engine="ase"),
        AseInternals("ase-internals", "ASE Verlet + FixInternals", md_engine="ase"),
        ProjectedOde("dop853", "SciPy DOP853 on eq. 105", adaptive=True, md_engine="scipy", damps=True),
        ProjectedOde("dop853-projected", "kcons + DOP853, projected", adaptive=True, damps=True, project=True),
        CoreVerlet("verlet", "baseline: Verlet, nothing held", holds=False),
        AseVerlet("ase-verlet", "baseline: ASE Verlet, nothing held", holds=False, md_engine="ase"),
        *OPENMM_METHODS,
        *PEERS,
    )
}


def chosen(names: Iterable[str] | None = None, test_system: TestSystem | None = None) -> list[Method]:
    """Methods by name, by default the usual ones for the test system.

    'all' alone stands for all, 'openmm' for the usual ones of OpenMM that can run the test system.

    Raises
    ------
    InputError
        Unknown name.
    """
    if names is None:
        return usual(test_system)
    wanted = list(names)
    if wanted == ["all"]:
        return list(METHODS.values())
    picked: dict[str, Method] = {}
    for name in wanted:
        if name == "openmm":
            group = [m for m in METHODS.values() if m.usual and m.md_engine == name]
            able = [m for m in group if test_system is None or m.refuses(test_system) is None]
            picked |= {m.name: m for m in able or group}
        elif name in METHODS:
            picked[name] = METHODS[name]
        else:
            known = ", ".join((*METHODS, "openmm", "all"))
            raise InputError(
                f"there is no method {name!r}{did_you_mean(name, METHODS)}; there are {known}", item="methods"
            )
    if not picked:
        raise InputError(f"no method is named; there are {', '.join(METHODS)}", item="methods")
    return list(picked.values())


def usual(test_system: TestSystem | None = None) -> list[Method]:
    """Methods that run by default, of guests only those that can run the test system.

    For test systems whose forces are OpenMM's, all usual methods of OpenMM that can run them, and no others.
    """
    found = [method for method in METHODS.values() if method.usual]
    if test_system is not None and test_system.openmm is not None and test_system.openmm.home:
        return [method for method in found if method.md_engine == "openmm" and method.refuses(test_system) is None]
    md_engines = [m for m in found if m.md_engine != "openmm" or m.guest]
    return [m for m in md_engines if not m.guest or (test_system is not None and m.refuses(test_system) is None)]
