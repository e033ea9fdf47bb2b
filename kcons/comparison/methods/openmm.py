"""Methods of OpenMM: its own integrators over tolerances, and those of kcons in it.

OpenMM runs by itself, several steps at a time; its Context has the start and the platform of the test
system.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from time import perf_counter
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from kcons.comparison.methods.engines import InOpenMM
from kcons.comparison.methods.method import ENGINE_CALLS, Method, Run, exponent, matched_steps
from kcons.comparison.test_systems import TestSystem
from kcons.comparison.test_systems.openmm_engine import OpenMMEngine
from kcons.constraints.target import FloatArray

if TYPE_CHECKING:
    import openmm

#: Tolerances of OpenMM's own solvers; the second is the default of its integrators.
TOLERANCES = (1e-4, 1e-5, 1e-6, 1e-8, 1e-10, 1e-12)
DEFAULT = 1e-5
#: Tolerance under the integrators of kcons.
TIGHT = 1e-12
#: Of the thermostats: K, and collisions a ps.
TEMPERATURE, COLLISIONS = 300.0, 1.0

#: A run is watched at about so many times.
RECORDS = 12
#: Steps that take less than this are timed in blocks: of so many seconds, and of so few and so many steps. A call of
#: `step` has costs of its own, which those who make a million steps do not see.
SHORT_STEP, BLOCK_SECONDS, BLOCK_STEPS = 0.03, 0.05, (500, 2000)
BLOCKS = 3
#: Fewer steps a block where these would take longer, but no fewer than that.
LONG_BLOCK, LEAST_STEPS = 0.6, 10

HALF_STEP = (
    "OpenMM's own integrators keep velocities half a step off the positions; |Av| is that of the velocities that "
    "OpenMM gives."
)
NO_TRAJECTORY = "thermostat: a trajectory of its own, so that no error can be stated."


class _EngineRun(InOpenMM):
    """A Context that is stepped to the horizon.

    Parameters
    ----------
    evaluations : int
        Force evaluations a step.
    half_step : bool
        Whether velocities are kept half a step behind.
    """

    divided = False

    def __init__(
        self,
        test_system: TestSystem,
        context: openmm.Context,
        integrator: openmm.Integrator,
        dt: float,
        *,
        evaluations: int = 1,
        half_step: bool = False,
        records: int | None = RECORDS,
    ) -> None:
        md_engine = test_system.openmm
        assert md_engine is not None
        super().__init__(context, integrator, dt, round(test_system.horizon / dt), md_engine.length, md_engine.speed)
        self._evaluations, self._half_step = evaluations, half_step
        self._stride = 1 if records is None else max(1, self._planned // records)
        self._groups = integrator.getIntegrationForceGroups()
        self._end: tuple[FloatArray, FloatArray] | None = None
        self._spent = 0.0
        self._x, self._v = test_system.positions * md_engine.length, test_system.velocities * md_engine.speed
        context.setPositions(self._x)
        if half_step:
            # Then the first position is the one that RATTLE reaches.
            self._v = self._v - 0.5 * dt * md_engine.time * self._forces() / test_system.masses[:, None]
        context.setVelocities(self._v)

    def advance(self) -> None:
        # The first step stands alone: it pays for what is set up lazily.
        self.steps = min(self._stride if self._done else 1, self._planned - self._done)
        begun = perf_counter()
        self._integrator.step(self.steps)
        if self._done:
            self._spent += perf_counter() - begun
        self._done += self.steps
        if self.finished and hasattr(self._integrator, "check"):
            self._integrator.check()  # what OpenMM's solvers do not tell

    def stretch(self, step_seconds: float, pass_seconds: float) -> int:
        return _block(step_seconds, pass_seconds)

    def rewind(self) -> None:
        self.context.setPositions(self._x)
        self.context.setVelocities(self._v)

    def settle(self) -> None:
        self._integrator.step(1)

    def observe(self) -> tuple[FloatArray, FloatArray]:
        return super().observe() if self._end is None else self._end

    def own_energy(self) -> float | None:
        if not self._half_step:
            return None
        if hasattr(self._integrator, "scheme"):
            # To ask would compute the forces that the next step is to pay for.
            return float("nan")
        # OpenMM's own integrators compute forces anew in every step. They know how to move velocities by half a step.
        state = self.context.getState(energy=True, groups=self._groups)
        energy = state.getKineticEnergy() + state.getPotentialEnergy()
        return float(energy._value) / self._speed**2

    def own_evaluations(self) -> int:
        return self._done * self._evaluations

    def own_step_seconds(self) -> float | None:
        # Without the first step.
        timed = self._planned - 1
        if not self.finished or not timed or self._spent > SHORT_STEP * timed:
            return None
        self._end = self.observe()
        if not np.isfinite(self._end[0]).all():
            return None
        size = _block(self._spent / timed, BLOCK_SECONDS)
        found = []
        try:
            for _ in range(BLOCKS):
                begun = perf_counter()
                self._integrator.step(size)
                found.append((perf_counter() - begun) / size)
        except Exception:  # beyond the horizon anything may happen
            return None
        return float(np.median(found))

    def _forces(self) -> FloatArray:
        state = self.context.getState(forces=True, groups=self._groups)
        return np.asarray(state.getForces(asNumpy=True)._value)


def _block(step_seconds: float, seconds: float) -> int:
    wanted = np.clip(seconds / step_seconds, *BLOCK_STEPS)
    return int(max(min(wanted, LONG_BLOCK / step_seconds), LEAST_STEPS))


class _CarriedRun(_EngineRun):
    """Rows carried to kcons' engine, which is asked through Python and can be timed."""

    divided = True


@dataclass(frozen=True)
class OpenMMMethod(Method):
    """What all methods of OpenMM have in common."""

    marches: ClassVar[bool] = True

    md_engine: str = "openmm"

    def refuses(self, test_system: TestSystem) -> str | None:
        reason = super().refuses(test_system)
        if reason is not None:
            return reason
        if find_spec("openmm") is None:
            return "OpenMM is not installed; python -m pip install openmm"
        if test_system.openmm is None:
            return "the test system has no OpenMM System"
        return self._lacks(test_system)

    def _lacks(self, test_system: TestSystem) -> str | None:
        """What of the test system the method cannot hold."""
        return None if test_system.bonds is not None else "a System holds distances only"


def _openmm(test_system: TestSystem) -> OpenMMEngine:
    assert test_system.openmm is not None
    return test_system.openmm


def only_water(test_system: TestSystem) -> bool:
    """Whether OpenMM's System holds nothing but rigid water."""
    from kcons.openmm.carried.hold import take_constraints

    md_engine = _openmm(test_system)
    return not md_engine.surfaces and not take_constraints(md_engine.copy())


# -- OpenMM's own -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Own:
    """An integrator of OpenMM.

    Attributes
    ----------
    name : str
    arguments : tuple of float
        What it takes before the time step: temperature and collisions.
    """

    name: str
    arguments: tuple[float, ...] = ()

    def __call__(self) -> Any:
        import openmm

        integrator = getattr(openmm, self.name)(*self.arguments, 0.001)
        if self.name == "LangevinMiddleIntegrator":
            integrator.setRandomNumberSeed(1)
        return integrator

    def code(self, dt: str) -> str:
        """The expression that makes it."""
        return f"{self.name}({', '.join([*(f'{a:g}' for a in self.arguments), dt])})"


VERLET = Own("VerletIntegrator")
MIDDLE = Own("LangevinMiddleIntegrator", (TEMPERATURE, 0.0))
NOSE_HOOVER = Own("NoseHooverIntegrator")
MIDDLE_BATH = Own("LangevinMiddleIntegrator", (TEMPERATURE, COLLISIONS))
NOSE_HOOVER_BATH = Own("NoseHooverIntegrator", (TEMPERATURE, COLLISIONS))


@dataclass(frozen=True)
class BuiltIn(OpenMMMethod):
    """An integrator of OpenMM with the System's constraints held by SETTLE, SHAKE and CCMA.

    Attributes
    ----------
    make : Own
    tolerance : float
    """

    make: Own = VERLET
    tolerance: float = DEFAULT

    def start(self, test_system: TestSystem, setting: float) -> Run:
        md_engine, integrator = _openmm(test_system), self.make()
        integrator.setStepSize(setting * md_engine.time)
        integrator.setConstraintTolerance(self.tolerance)
        context = md_engine.context(md_engine.system if self.holds else md_engine.copy(constraints=False), integrator)
        records = RECORDS if self.holds else None
        return _EngineRun(test_system, context, integrator, setting, half_step=True, records=records)

    def _lacks(self, test_system: TestSystem) -> str | None:
        if not self.follows and test_system.units.energy != "eV":
            return "the units of the test system know no kelvin"
        return super()._lacks(test_system) if self.holds else None


# -- kcons in OpenMM --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Projected(OpenMMMethod):
    """`ProjectedIntegrator` on the System's constraints.

    Attributes
    ----------
    scheme : str
    """

    scheme: str = "rattle"

    def settings(self, test_system: TestSystem) -> tuple[float, ...]:
        return matched_steps(test_system, self._evaluations)

    @property
    def _evaluations(self) -> int:
        from kcons.openmm.integrator.schemes import to_scheme

        scheme = to_scheme(self.scheme)
        return 1 if scheme is None else scheme.force_evaluations

    def start(self, test_system: TestSystem, setting: float) -> Run:
        from kcons.openmm import ProjectedIntegrator

        md_engine = _openmm(test_system)
        integrator = ProjectedIntegrator(md_engine.step(setting), self.scheme, tolerance=TIGHT)
        context = md_engine.context(md_engine.system, integrator)
        return self._run(_EngineRun, test_system, context, integrator, setting)

    def _run(
        self, kind: type[_EngineRun], test_system: TestSystem, context: openmm.Context, integrator: Any, dt: float
    ) -> _EngineRun:
        return kind(
            test_system, context, integrator, dt, evaluations=self._evaluations, half_step=integrator.scheme is None
        )


@dataclass(frozen=True)
class Compiled(OpenMMMethod):
    """`RattleIntegrator`: OpenMM's own leapfrog steps, with both ends at the positions.

    Attributes
    ----------
    tolerance : float
    """

    tolerance: float = TIGHT

    def start(self, test_system: TestSystem, setting: float) -> Run:
        from kcons.openmm import RattleIntegrator

        md_engine = _openmm(test_system)
        integrator = RattleIntegrator(md_engine.step(setting), tolerance=self.tolerance)
        context = md_engine.context(md_engine.system, integrator)
        # Each time somebody looks costs a force evaluation: only the end is looked at.
        return _EngineRun(test_system, context, integrator, setting, records=1)


@dataclass(frozen=True)
class Held(Projected):
    """`ProjectedIntegrator` with the constraints carried to kcons' own solver by `hold`.

    Rigid water stays with OpenMM, unless there is nothing else.
    """

    def _lacks(self, test_system: TestSystem) -> str | None:
        return None if _openmm(test_system).surfaces else super()._lacks(test_system)

    def warm_up(self, test_system: TestSystem) -> None:
        self.start(test_system, min(test_system.time_steps)).advance()

    def start(self, test_system: TestSystem, setting: float) -> Run:
        from kcons.openmm import ProjectedIntegrator, hold

        md_engine, system = _openmm(test_system), _openmm(test_system).copy()
        rows: Sequence[Any] = md_engine.surfaces
        part = hold(
            system, rows, test_system.positions * md_engine.length, take="all", keep_water=not only_water(test_system)
        )
        integrator = ProjectedIntegrator(md_engine.step(setting), self.scheme, parts=[part], tolerance=TIGHT)
        context = md_engine.context(system, integrator)
        run = self._run(_CarriedRun, test_system, context, integrator, setting)
        run.constraints.watch(part.motion, ENGINE_CALLS)
        return run


@dataclass(frozen=True)
class OnSurfaces(Projected):
    """`SurfaceIntegrator`: surfaces computed by OpenMM itself."""

    def _lacks(self, test_system: TestSystem) -> str | None:
        return None if _openmm(test_system).surfaces else "no particle is held on a surface"

    def start(self, test_system: TestSystem, setting: float) -> Run:
        from kcons.openmm import SurfaceIntegrator

        md_engine, system = _openmm(test_system), _openmm(test_system).copy()
        integrator = SurfaceIntegrator(
            md_engine.step(setting), self.scheme, surfaces=md_engine.surfaces, system=system, tolerance=TIGHT
        )
        return self._run(_EngineRun, test_system, md_engine.context(system, integrator), integrator, setting)


# -- by name ----------------------------------------------------------------------------------------

_KINDS = {
    "openmm-verlet": ("OpenMM Verlet", VERLET),
    "openmm-middle": ("OpenMM LangevinMiddle, no friction", MIDDLE),
    "openmm-nose-hoover": ("OpenMM NoseHoover, no bath", NOSE_HOOVER),
}


def _built_in() -> list[OpenMMMethod]:
    found: list[OpenMMMethod] = []
    for kind, (title, make) in _KINDS.items():
        for tolerance in TOLERANCES:
            plain = tolerance == DEFAULT
            told = exponent(tolerance)
            found.append(
                BuiltIn(
                    kind if plain else f"{kind}-{told}",
                    f"{title}, {told}",
                    usual=kind == "openmm-verlet" or plain,
                    guest=kind == "openmm-verlet" and plain,
                    remark=HALF_STEP,
                    make=make,
                    tolerance=tolerance,
                )
            )
    baths = (
        ("openmm-middle-bath", "OpenMM LangevinMiddle, 300 K", MIDDLE_BATH),
        ("openmm-nose-hoover-bath", "OpenMM NoseHoover, 300 K", NOSE_HOOVER_BATH),
    )
    found += [BuiltIn(name, title, follows=False, remark=NO_TRAJECTORY, make=make) for name, title, make in baths]
    return found


def _of_kcons() -> list[OpenMMMethod]:
    usual = ("rattle", "suzuki4", "blanes-moan4", "kahan-li6", "blanes-moan6")
    others = ("geodesic", "yoshida4", "blanes-moan6a", "leapfrog")
    found: list[OpenMMMethod] = []
    for scheme in (*usual, *others):
        projected = Projected(
            f"openmm-kcons-{scheme}",
            f"OpenMM + kcons {scheme}",
            usual=scheme in usual,
            guest=scheme == "rattle",
            remark=HALF_STEP if scheme == "leapfrog" else "",
            scheme=scheme,
        )
        found.append(projected)
    for tolerance in (1e-4, DEFAULT, 1e-6, TIGHT):
        told = exponent(tolerance)
        name = "openmm-rattle" if tolerance == TIGHT else f"openmm-rattle-{told}"
        found.append(Compiled(name, f"OpenMM + kcons compiled RATTLE, {told}", tolerance=tolerance))
    for scheme in ("rattle", "blanes-moan4", "blanes-moan6"):
        title = f"OpenMM + kcons {scheme}, own solver"
        found.append(Held(f"openmm-held-{scheme}", title, usual=scheme != "blanes-moan4", scheme=scheme))
    for scheme in ("rattle", "geodesic", "suzuki4", "blanes-moan6"):
        title = f"OpenMM + kcons {scheme}, surfaces"
        found.append(OnSurfaces(f"openmm-surface-{scheme}", title, guest=scheme == "rattle", scheme=scheme))
    return found


OPENMM_METHODS: tuple[OpenMMMethod, ...] = (
    *_built_in(),
    *_of_kcons(),
    BuiltIn("openmm-free", "baseline: OpenMM Verlet, nothing held", holds=False),
)
