"""Constraint solvers without an integrator around them: kcons' engine, and those of others, on one task each.

P brings the positions after a step of free flight back onto the constraints; V takes out of thermal velocities what
leaves them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

import numpy as np
from ase import Atoms
from ase.constraints import FixBondLengths
from bare_systems import STEP, BareSystem
from peers import lammps_shake
from peers.gauss_seidel import GaussSeidel

from kcons.comparison.runs import seen
from kcons.comparison.test_systems.openmm_engine import system_of
from kcons.constraints.target import FloatArray
from kcons.errors import UnsupportedError

STAGES = ("P", "V")
#: Samples take about so long altogether, in seconds, and there are at most so many.
SAMPLING, MOST = 0.3, 60
#: Seconds after which a solve is not repeated.
LONG = 10.0
#: Steps of LAMMPS between two looks at the clock.
LAMMPS_STEPS = 20


@dataclass(frozen=True)
class Timing:
    """Median seconds of one solve, and what it left: |r/d - 1| for P, |A v|/v_rms for V."""

    seconds: float
    residual: float


class BareSolver(ABC):
    """A solver set up for one system.

    Parameters
    ----------
    system : BareSystem
    tolerance : float
        Without meaning for solvers that have none.
    """

    def __init__(self, system: BareSystem, tolerance: float) -> None:
        self.system = system

    @abstractmethod
    def timing(self, stage: str) -> Timing:
        """Do the task, again and again."""


class _OnArrays(BareSolver):
    """Solvers that change arrays in place."""

    def timing(self, stage: str) -> Timing:
        system = self.system
        start = system.moved if stage == "P" else system.thermal
        work = start.copy()
        if stage == "P":
            seconds = sampled(lambda: self.positions(work), lambda: np.copyto(work, start))
            return Timing(seconds, system.stretch(work))
        seconds = sampled(lambda: self.velocities(work), lambda: np.copyto(work, start))
        return Timing(seconds, system.departure(system.positions, work))

    @abstractmethod
    def positions(self, x: FloatArray) -> None: ...

    @abstractmethod
    def velocities(self, v: FloatArray) -> None: ...


class Engine(_OnArrays):
    """`Motion`; it has no tolerance but rounding."""

    def __init__(self, system: BareSystem, tolerance: float) -> None:
        super().__init__(system, tolerance)
        from kcons.motion.motion import Motion

        self.motion = Motion(system.constraint_set(), system.positions)

    def positions(self, x: FloatArray) -> None:
        self.motion.project_positions(x, self.system.positions, out=x)

    def velocities(self, v: FloatArray) -> None:
        self.motion.project_velocities(self.system.positions, v, out=v)


class Sweeps(_OnArrays):
    """SHAKE and RATTLE by Gauss-Seidel sweeps."""

    def __init__(self, system: BareSystem, tolerance: float) -> None:
        super().__init__(system, tolerance)
        self.held = GaussSeidel(system.pairs, system.masses, system.positions, tolerance, system.lengths)
        self.spare = np.zeros_like(system.positions)

    def positions(self, x: FloatArray) -> None:
        self.held.positions(x, self.system.positions, self.spare, STEP)

    def velocities(self, v: FloatArray) -> None:
        self.held.velocities(self.system.positions, v, STEP)


class AseBonds(_OnArrays):
    """ASE's FixBondLengths."""

    def __init__(self, system: BareSystem, tolerance: float) -> None:
        super().__init__(system, tolerance)
        self.atoms = Atoms(["X"] * len(system.positions), positions=system.positions, masses=system.masses)
        self.held = FixBondLengths(system.pairs, tolerance=tolerance, bondlengths=system.lengths)
        self.masses = system.masses[:, None]

    def positions(self, x: FloatArray) -> None:
        self.held.adjust_positions(self.atoms, x)

    def velocities(self, v: FloatArray) -> None:
        # It takes momenta.
        v *= self.masses
        self.held.adjust_momenta(self.atoms, v)
        v /= self.masses


class OpenMMSolver(BareSolver):
    """applyConstraints and applyVelocityConstraints on the CPU platform: SETTLE for rigid water, CCMA for all else.

    applyConstraints takes its directions from the positions that it corrects.
    """

    def __init__(self, system: BareSystem, tolerance: float) -> None:
        super().__init__(system, tolerance)
        if find_spec("openmm") is None:
            raise UnsupportedError("OpenMM is not installed; python -m pip install openmm")
        self.tolerance = tolerance
        self.context = _context(system)

    def timing(self, stage: str) -> Timing:
        system, context = self.system, self.context
        if stage == "P":
            start = 0.1 * system.moved
            seconds = sampled(lambda: context.applyConstraints(self.tolerance), lambda: context.setPositions(start))
            return Timing(seconds, system.stretch(10.0 * seen(context)[0]))
        context.setPositions(0.1 * system.positions)
        start = 100.0 * system.thermal
        seconds = sampled(
            lambda: context.applyVelocityConstraints(self.tolerance), lambda: context.setVelocities(start)
        )
        return Timing(seconds, system.departure(system.positions, 0.01 * seen(context)[1]))


@lru_cache(maxsize=1)
def _context(system: BareSystem) -> Any:
    """The tolerance is an argument of each solve; CCMA may take most of a minute to set up."""
    import openmm

    platform = openmm.Platform.getPlatformByName("CPU")
    return openmm.Context(openmm_system(system), openmm.VerletIntegrator(0.001), platform, {"Threads": "1"})


def openmm_system(system: BareSystem) -> Any:
    """OpenMM's System of the same masses and distances; without forces but for angles that CCMA looks at."""
    import openmm

    bends = openmm.HarmonicAngleForce()
    if system.system is not None:
        for force in system.system().getForces():
            if isinstance(force, openmm.HarmonicAngleForce):
                for k in range(force.getNumAngles()):
                    bends.addAngle(*force.getAngleParameters(k))
    else:
        x = system.positions
        for i, vertex, j in system.angles.tolist():
            a, b = x[i] - x[vertex], x[j] - x[vertex]
            cosine = a @ b / np.sqrt((a @ a) * (b @ b))
            bends.addAngle(i, vertex, j, float(np.arccos(np.clip(cosine, -1.0, 1.0))), 1.0)
    return system_of(system.masses, bends, pairs=system.pairs, lengths=0.1 * system.lengths)


class LammpsSolver(BareSolver):
    """fix shake and fix rattle: what they add to a step of free flight; V is what the second adds to the first."""

    def __init__(self, system: BareSystem, tolerance: float) -> None:
        super().__init__(system, tolerance)
        if find_spec("lammps") is None:
            raise UnsupportedError("LAMMPS is not installed; python -m pip install lammps mpich")
        held = lammps_shake.clusters(system.pairs, system.positions, len(system.positions))
        if held is None:
            raise UnsupportedError(lammps_shake.NO_CLUSTER)
        self.runs = {fix: _Flight(system, held, fix, tolerance) for fix in ("", "shake", "rattle")}

    def timing(self, stage: str) -> Timing:
        fix, before = ("shake", "") if stage == "P" else ("rattle", "shake")
        samples: dict[str, list[float]] = {fix: [], before: []}
        begun = perf_counter()
        while len(samples[fix]) < 3 or (perf_counter() - begun < SAMPLING and len(samples[fix]) < MOST):
            for name in samples:
                samples[name].append(self.runs[name].seconds())
        seconds = float(np.median(np.array(samples[fix]) - samples[before]))
        x, v = self.runs[fix].state()
        residual = self.system.stretch(x) if stage == "P" else self.system.departure(x, v)
        return Timing(max(seconds, 0.0), residual)


class _Flight:
    """LAMMPS without forces, with one of the two fixes or none, always from the same start."""

    def __init__(self, system: BareSystem, held: lammps_shake.Clusters, fix: str, tolerance: float) -> None:
        self.count = len(system.positions)
        self.lammps = lammps_shake.instance()
        with TemporaryDirectory() as folder:
            data = Path(folder) / "bare.data"
            reach = 1e4 * STEP * float(np.abs(system.tangent).max())
            lines = lammps_shake.data_file(system.masses, system.positions, system.tangent, held, reach)
            data.write_text("\n".join(lines))
            for line in lammps_shake.preamble(str(data), held, STEP):
                self.lammps.command(line)
        if fix:
            self.lammps.command(lammps_shake.fix_command(held, fix, tolerance))
        else:
            # The springs of the bonds are switched off by the fixes.
            self.lammps.command("bond_style none")
            if len(held.angles):
                self.lammps.command("angle_style none")
        self.lammps.command("run 1 post no")

    def seconds(self) -> float:
        begun = perf_counter()
        self.lammps.command(f"run {LAMMPS_STEPS} pre no post no")
        return (perf_counter() - begun) / LAMMPS_STEPS

    def state(self) -> tuple[FloatArray, FloatArray]:
        return tuple(lammps_shake.by_tag(self.lammps, what, self.count) for what in "xv")  # type: ignore[return-value]


def sampled(solve: Callable[[], Any], reset: Callable[[], Any]) -> float:
    """Median seconds of `solve`, warm; what takes very long is done once."""
    reset()
    begun = perf_counter()
    solve()
    first = perf_counter() - begun
    if first > LONG:
        return first
    found: list[float] = []
    while not found or (sum(found) < SAMPLING and len(found) < MOST):
        reset()
        begun = perf_counter()
        solve()
        found.append(perf_counter() - begun)
    return float(np.median(found))


@dataclass(frozen=True)
class Candidate:
    """A solver by name, with the tolerances to try from the loosest on; one that has none is asked once."""

    name: str
    title: str
    make: Callable[[BareSystem, float], BareSolver]
    tolerances: Sequence[float]


CANDIDATES = (
    Candidate("kcons", "kcons", Engine, (0.0,)),
    Candidate("sweeps", "SHAKE/RATTLE sweeps", Sweeps, (1e-3, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12)),
    Candidate("ase", "ASE FixBondLengths", AseBonds, (1e-3, 1e-6, 1e-10, 1e-13)),
    Candidate("openmm", "OpenMM SETTLE, CCMA", OpenMMSolver, (1e-3, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12)),
    Candidate("lammps", "LAMMPS fix shake, rattle", LammpsSolver, (1e-3, 1e-4, 1e-6, 1e-8, 1e-10)),
)
