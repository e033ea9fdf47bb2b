"""The same mechanics in the three hosts: NumPy arrays, ASE atoms, an OpenMM System.

Eight atoms in a trap that is not harmonic, held by any constraints. The units of each host are consistent (nm, ps and
dalton; angstrom, atomic mass unit and ASE's time), so that positions at the same number of steps agree.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import openmm
from ase import Atoms
from ase.calculators.calculator import Calculator
from constraint_cases import CASES, MASSES, N_ATOMS, scattered

from kcons.ase import ConstrainedDynamics
from kcons.comparison import runs
from kcons.constraints import Constraint, projection
from kcons.constraints.constraint_set import ConstraintSet
from kcons.motion import Motion
from kcons.openmm import ProjectedIntegrator, hold
from kcons.steppers import Rattle, State, Stepper, Suzuki4, System

STIFF = np.array([1.0, 1.3, 0.7]) * np.linspace(2.0, 6.0, N_ATOMS)[:, None]
BUMP = 0.4
STEPPERS: dict[str, Stepper] = {"rattle": Rattle(), "suzuki4": Suzuki4()}

Phase = tuple[np.ndarray, np.ndarray]


def force(x: np.ndarray, t: float = 0.0) -> np.ndarray:
    """-grad of sum k x^2/2 + BUMP sin(x + 2 y - z)."""
    bump = BUMP * np.cos(x @ [1.0, 2.0, -1.0])
    return -STIFF * x - bump[:, None] * [1.0, 2.0, -1.0]


class _Trap(Calculator):
    implemented_properties = ("energy", "forces")

    def calculate(self, atoms: Any = None, properties: Any = (), system_changes: Any = ()) -> None:
        super().calculate(atoms, properties, system_changes)
        x = atoms.positions
        energy = 0.5 * (STIFF * x * x).sum() + BUMP * np.sin(x @ [1.0, 2.0, -1.0]).sum()
        self.results = {"energy": float(energy), "forces": force(x)}


class Problem:
    """A case of `CASES` at the time 0, on its constraints."""

    def __init__(self, name: str) -> None:
        x = scattered(11)
        self.rows: list[Constraint] = [CASES[name]()]
        self.held = ConstraintSet(self.rows, x, MASSES)
        self.motion = Motion(self.held, x)
        self.rows = list(self.held.constraints)  # with the targets that were found
        self.x = self.motion.restore_positions(x, time=0.0)
        self.v = self.motion.project_velocities(self.x, 0.5 * np.random.default_rng(2).normal(size=x.shape), time=0.0)

    def dense(self, x: np.ndarray, v: np.ndarray, t: float) -> np.ndarray:
        """The acceleration by generalized inverses of the whole matrix."""
        A = self.held.jacobian(x, t).toarray()
        return projection.acceleration(A, MASSES, force(x), self.held.acceleration_target(x, v, t))


@cache
def problem(name: str) -> Problem:
    return Problem(name)


class OnArrays(runs.OnArrays):
    def __init__(self, p: Problem, dt: float, scheme: str, state: State | None = None) -> None:
        system = System(p.motion, force)
        self.given = p, dt, scheme
        super().__init__(system, system.initial_state(p.x, p.v) if state is None else state, STEPPERS[scheme], dt)

    def back(self, n: int) -> None:
        """Go back n steps."""
        self.dt = -self.dt
        self.advance(n)
        self.dt = -self.dt

    def save(self) -> Callable[[], Run]:
        """What goes on as another run."""
        kept = pickle.dumps(self.state)
        return lambda: OnArrays(*self.given, pickle.loads(kept))


class InAse(runs.InAse):
    def __init__(self, p: Problem, dt: float, scheme: str, state: State | None = None) -> None:
        self.given = p, dt, scheme
        atoms = Atoms(f"H{N_ATOMS}", p.x, masses=MASSES, velocities=p.v, calculator=_Trap())
        more = {} if state is None else {"state": state}
        super().__init__(atoms, ConstrainedDynamics(atoms, dt, STEPPERS[scheme], constraints=p.rows, **more), dt)

    def back(self, n: int) -> None:
        self.dynamics.set_timestep(-self.dt)
        self.advance(n)
        self.dynamics.set_timestep(self.dt)

    def observe(self) -> Phase:
        return self.atoms.get_positions(), self.dynamics.state.velocities  # ASE has no momenta of fixed atoms

    def save(self) -> Callable[[], Run]:
        kept = pickle.dumps(self.dynamics.state)
        return lambda: InAse(*self.given, pickle.loads(kept))


class InOpenMM(runs.InOpenMM):
    def __init__(self, p: Problem, dt: float, scheme: str, checkpoint: bytes | None = None) -> None:
        self.given = p, dt, scheme
        system = openmm.System()
        trap = openmm.CustomExternalForce(f"(kx*x^2+ky*y^2+kz*z^2)/2+{BUMP}*sin(x+2*y-z)")
        for name in ("kx", "ky", "kz"):
            trap.addPerParticleParameter(name)
        for k, mass in enumerate(MASSES):
            system.addParticle(mass)
            trap.addParticle(k, STIFF[k].tolist())
        system.addForce(trap)
        integrator = ProjectedIntegrator(dt, scheme, parts=[hold(system, p.rows, p.x)])
        context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
        context.setPositions(p.x)
        context.setVelocities(p.v)
        if checkpoint is not None:
            integrator.step(0)
            context.loadCheckpoint(checkpoint)
        super().__init__(context, integrator, dt)

    def back(self, n: int) -> None:
        self.context.setVelocities(-self.observe()[1])
        self.advance(n)
        self.context.setVelocities(-self.observe()[1])

    def save(self) -> Callable[[], Run]:
        kept = self.context.createCheckpoint()
        return lambda: InOpenMM(*self.given, kept)


Run = OnArrays | InAse | InOpenMM
HOSTS: dict[str, Callable[[Problem, float, str], Run]] = {"arrays": OnArrays, "ASE": InAse, "OpenMM": InOpenMM}
