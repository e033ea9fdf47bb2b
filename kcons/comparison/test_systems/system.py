"""The contract of a test system: a system to run, small or at size N, that knows its own solution."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from ase import Atoms, units

from kcons.comparison.test_systems.openmm_engine import OpenMMEngine
from kcons.comparison.test_systems.potential import Potential, PotentialCalculator
from kcons.constraints.arguments import Rng, finite_array, generator_of
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import InputError
from kcons.motion.motion import Motion
from kcons.steppers import BlanesMoan6, State, System


@dataclass(frozen=True)
class Units:
    """Names of the units that a test system's numbers carry, and how long their units of time are internally.

    Time steps are shown in `time`; costs and slopes are stated per `long_time`.
    """

    length: str
    energy: str
    time: str
    time_unit: float
    long_time: str
    long_time_unit: float


#: What ASE computes in; times are shown in femtoseconds.
ASE_UNITS = Units("Å", "eV", "fs", units.fs, "ps", 1000 * units.fs)
#: Radius, m v0² and R/v0 of the test systems that have no unit of their own.
REDUCED = Units("R", "ε", "τ", 1.0, "τ", 1.0)
#: For test systems that are given by bare numbers.
BARE = Units("length", "energy", "τ", 1.0, "τ", 1.0)

#: Progress: called with (steps done, steps in all).
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Reference:
    """Where the trajectory is at the horizon."""

    #: Shape (n_atoms, 3).
    positions: FloatArray
    #: Estimated root-mean-square error an atom; 0 for closed forms.
    error: float
    #: How it was obtained.
    how: str


@dataclass(frozen=True)
class TestSystem:
    """One system with its start, its forces and its reference solution."""

    #: For pytest, which collects classes of such names.
    __test__ = False

    name: str
    title: str
    #: What is held; also the masses and the cell.
    constraint_set: ConstraintSet
    #: Start, on the constraints and tangent to them, shape (n_atoms, 3).
    positions: FloatArray
    velocities: FloatArray
    potential: Potential
    #: For ASE.
    symbols: str | Sequence[str]
    #: Time at which trajectories are compared; short enough that chaos does not decide.
    horizon: float
    #: Default steps, internal units; each divides the horizon.
    time_steps: Sequence[float]
    #: Default relative tolerances for adaptive integrators.
    tolerances: Sequence[float] = (1e-2, 1e-4, 1e-6)
    units: Units = ASE_UNITS
    #: Pairs whose distances, all held, are the same thing as the constraint set, shape (n, 2); None if there are none.
    bonds: IntArray | None = None
    #: Atoms that the constraint set holds by FixedAtoms; MD engines that hold `bonds` fix them in their own way.
    fixed: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    #: Method name -> why it cannot run this test system.
    refusals: Mapping[str, str] = field(default_factory=dict)
    #: The reference at a given time, in closed form or by an independent integrator; without it the test system is
    #: converged at a step far below those compared.
    solution: Callable[[float], Reference] | None = None
    #: Shape (3,) or (3, 3).
    cell: FloatArray | None = None
    #: How OpenMM runs it: the same masses and forces as a System.
    openmm: OpenMMEngine | None = None
    #: The finest step compared, times this, decides about the work of a converged reference.
    reference_pace: float = 1.0
    #: k_B T of its velocities; 0 for test systems that have no temperature.
    thermal_energy: float = 0.0

    def __post_init__(self) -> None:
        for name in ("positions", "velocities"):  # which no run can change for the next one
            object.__setattr__(self, name, array := np.array(getattr(self, name), dtype=float))
            array.setflags(write=False)
        if not len(self.time_steps):
            raise InputError("there is no time step; give one or more", item="dt")
        for dt in self.time_steps:
            count = max(1, round(self.horizon / dt)) if dt > 0 else 1
            if not abs(self.horizon - count * dt) <= 1e-6 * self.horizon:
                step, horizon = (f"{t / self.units.time_unit:g} {self.units.time}" for t in (dt, self.horizon))
                remedy = f"give a positive step of at most the horizon, such as {horizon} / {count}"
                raise InputError(f"time step {step} does not divide the horizon of {horizon}; {remedy}", item="dt")

    @cached_property
    def motion(self) -> Motion:
        """The engine for this test system, set up once; `InputError` for a start off the constraints."""
        motion = Motion(self.constraint_set, self.positions)
        System(motion, None).initial_state(self.positions, self.velocities)
        return motion

    @property
    def masses(self) -> FloatArray:
        return self.constraint_set.masses

    @property
    def n_atoms(self) -> int:
        return len(self.positions)

    def atoms(self) -> Atoms:
        """ASE atoms at the start, with the test system's forces and nothing held."""
        atoms = Atoms(self.symbols, positions=self.positions, masses=self.masses)
        if self.cell is not None:
            atoms.set_cell(self.cell)
            atoms.pbc = True
        atoms.calc = PotentialCalculator(self.potential)
        atoms.set_velocities(self.velocities)
        return atoms

    def with_time_steps(self, shown: Sequence[float]) -> TestSystem:
        """The same test system with other steps, in the unit of time it shows."""
        return replace(self, time_steps=sorted({dt * self.units.time_unit for dt in shown}, reverse=True))

    def shortened(self, factor: int) -> TestSystem:
        """The same test system with its horizon divided by `factor` and only the steps that still divide it."""
        horizon = self.horizon / factor
        steps = tuple(dt for dt in self.time_steps if abs(horizon / dt - round(horizon / dt)) < 1e-6 and dt < horizon)
        return replace(self, horizon=horizon, time_steps=steps or (horizon / 4, horizon / 8))

    def reference(self, progress: Progress | None = None) -> Reference:
        """The solution at the horizon."""
        if self.solution is not None:
            return self.solution(self.horizon)
        return converged(self, self.reference_pace * min(self.time_steps), progress=progress)

    def deviation(self, positions: FloatArray, reference: FloatArray) -> float:
        """Root-mean-square distance of the atoms."""
        apart = positions - finite_array(reference, self.n_atoms, "reference")
        return float(np.sqrt(np.mean(np.sum(apart**2, axis=1))))

    def residuals(self, x: FloatArray, v: FloatArray, time: float = 0.0) -> tuple[float, float]:
        """max |sigma| in natural units, and max |A v - c| / v_rms with rows scaled to unit norm."""
        report = self.motion.report(x, v, time, condition=False)
        speed = float(np.sqrt(np.mean(v**2)))
        return report.residual, report.velocity_residual / speed if speed > 0 else report.velocity_residual


#: Force evaluations of a converged reference, as a multiple of those of RATTLE at the finest step compared.
REFERENCE_WORK = 8
#: The step of the second run that tells the error of the first, as a multiple of its step.
REFERENCE_CHECK = 1.5


def converged(test_system: TestSystem, dt: float, *, progress: Progress | None = None) -> Reference:
    """Order 6 at `REFERENCE_WORK` times the force evaluations of RATTLE at `dt`.

    The error estimate is the difference from a second run with longer steps. The error of the first is
    smaller by a factor of ten where it is that of the scheme; where forces are noisy, as in single precision or
    with a self-consistent field, both runs are equally far off.
    """
    stepper = BlanesMoan6()
    fine = max(3, round(REFERENCE_WORK * test_system.horizon / dt / stepper.force_evaluations))
    coarse = max(2, round(fine / REFERENCE_CHECK))
    system = System(test_system.motion, test_system.potential.forces)
    done = 0
    ends: list[FloatArray] = []
    for count in (coarse, fine):
        state = State(test_system.positions, test_system.velocities)
        for _ in range(count):
            state = stepper.step(system, state, test_system.horizon / count)
            done += 1
            if progress is not None:
                progress(done, coarse + fine)
        ends.append(state.positions)
    shown = test_system.horizon / fine / test_system.units.time_unit
    how = f"{type(stepper).__name__} at {shown:.3g} {test_system.units.time}"
    return Reference(ends[1], test_system.deviation(*ends), how)


def thermal_velocities(
    motion: Motion,
    positions: FloatArray,
    temperature: float,
    rng: Rng,
    *,
    at_rest: bool = True,
) -> FloatArray:
    """Maxwellian velocities at `temperature` (kelvin), tangent to the constraints, total momentum removed.

    Scaled so that the kinetic energy is exactly g k_B T/2.
    """
    generator = generator_of(rng)
    masses = motion.masses[:, None]
    v = generator.standard_normal(positions.shape) * np.sqrt(units.kB * temperature / masses)
    if at_rest:
        v -= np.sum(masses * v, axis=0) / masses.sum()
    v = motion.project_velocities(positions, v)
    freedom = motion.degrees_of_freedom - (3 if at_rest else 0)
    kinetic = 0.5 * float(np.sum(masses * v**2))
    if freedom > 0 and kinetic > 0:
        v *= np.sqrt(0.5 * freedom * units.kB * temperature / kinetic)
    return v
