"""What an integrator may hold besides the constraints of its System, and how precisely a platform can hold it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import openmm
from numpy.typing import ArrayLike

from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.errors import InfeasibleError, KconsError
from kcons.motion.motion import Motion
from kcons.openmm.integrator.program import Program
from kcons.openmm.quantities import motion_of, positions_of
from kcons.steppers.state import START_TOLERANCE

#: Starts that are off by less (relative) are put right, as integrators of OpenMM do in their first step.
NEAR = 0.1
#: What a row without a length of its own is off by is compared with this one (nm), a short bond.
BOND = 0.1
#: The tolerance of the System's constraints unless another is asked for, by precision. In single precision velocities
#: cannot be brought closer than to some 1e-6: OpenMM's solver would go on to its last iteration.
TOLERANCES = {"double": 1e-10, "mixed": 1e-8, "single": 1e-5}
#: Unit roundoff of single numbers.
SINGLE = 2.0**-24


@dataclass(frozen=True)
class Precision:
    """The precision in which the platform of a Context computes.

    Attributes
    ----------
    platform : str
    name : {'double', 'mixed', 'single'}
        Reference and CPU integrate in double. CUDA, HIP and OpenCL have a property for it: 'mixed' computes forces in
        single and integrates in double; positions are pairs of single numbers.
    """

    platform: str
    name: str

    @classmethod
    def of(cls, context: openmm.Context) -> Precision:
        """That of a Context."""
        platform = context.getPlatform()
        given = "Precision" in platform.getPropertyNames()
        return cls(platform.getName(), platform.getPropertyValue(context, "Precision") if given else "double")

    def __str__(self) -> str:
        return f"{self.platform}, {self.name} precision"

    @property
    def rounds_lengths(self) -> bool:
        """Whether the solvers of the platform keep lengths, or their squares, as single numbers."""
        return self.platform not in ("Reference", "CPU")

    @property
    def tolerance(self) -> float:
        """The tolerance of the System's constraints unless another is asked for."""
        return TOLERANCES[self.name]

    @property
    def place(self) -> float:
        """Unit roundoff of a coordinate: in mixed precision positions are pairs of single numbers."""
        return {"double": 2.0**-53, "mixed": 2.0**-48, "single": SINGLE}[self.name]

    def grain(self, reach: float) -> float:
        """Spacing of coordinates at a distance from the origin."""
        return float(np.spacing(reach)) if self.name == "double" else 2 * self.place * reach

    @property
    def limits(self) -> tuple[float, float]:
        """What positions, of the scale of a row, and velocities, of their size, may be off."""
        return (START_TOLERANCE, START_TOLERANCE) if self.name == "double" else (self.tolerance, self.speeds)

    @property
    def solvers(self) -> float:
        """What the arithmetic of OpenMM's solvers adds to a relative distance."""
        return 5e-7 if self.name == "single" else 1e-12

    @property
    def speeds(self) -> float:
        """What is left of velocities along constraints, of their size: SHAKE on GPUs makes 15 iterations at most."""
        return 1e-6 if self.rounds_lengths else 0.0

    @property
    def forces(self) -> float:
        """Relative error of forces and of the values of Forces that are rows, after some hundred operations."""
        return 1e-13 if self.name == "double" else 5e-7

    @property
    def seen(self) -> float:
        """Unit roundoff of a coordinate as Forces see it."""
        return 2.0**-53 if self.name == "double" else SINGLE


@dataclass(frozen=True)
class Violation:
    """A row whose 'positions' or 'velocities' are off by more than they may be."""

    what: str
    row: int
    name: str
    #: sigma in the unit of the row, or A v less its target, per ps.
    off: float
    allowed: float
    atoms: Sequence[int] = ()
    #: Whether positions are off by less than a tenth of the length that is held: they are put right in a first step.
    near: bool = False

    @classmethod
    def worst(
        cls,
        what: str,
        off: FloatArray,
        allowed: ArrayLike,
        name: Callable[[int], str],
        atoms: Callable[[int], Iterable[int]],
        near: ArrayLike = 0.0,
    ) -> Violation | None:
        """The worst of some rows, or None if each is off by no more than allowed; NaN is the worst."""
        size = np.abs(off)
        limit = np.broadcast_to(np.asarray(allowed, dtype=float), size.shape)
        wrong = ~(size <= limit)
        if not wrong.any():
            return None
        with np.errstate(all="ignore"):
            row = int(np.argmax(np.where(np.isfinite(size), np.where(wrong, size / limit, 0.0), np.inf)))
        close = bool(np.all(size[wrong] <= np.broadcast_to(near, size.shape)[wrong]))
        return cls(what, row, name(row), float(off[row]), float(limit[row]), [int(a) for a in atoms(row)], close)

    def __str__(self) -> str:
        rate = "" if self.what == "positions" else " per ps"
        return f"{self.what} are off row {self.name} by {abs(self.off):.3g}{rate}"


class Solver(NamedTuple):
    """The engine of kcons for the rows of a part, the particles that it knows, and the time of targets now, ps."""

    motion: Motion
    atoms: IntArray | slice = slice(None)
    time: float = 0.0


class Part(ABC):
    """Rows of one kind, and the computations that keep them.

    A program is written once and calls each method where its computations belong. The variables at hand are x, v,
    m, dt; `xu`, positions as they were before anything brought them onto constraints; and `failed`, which a part
    sets to its own `code` when a solve does not converge. The integrator then computes nothing more in this step,
    puts positions and velocities back to what they were before it and asks the part that has this code for the
    error to raise.

    Steps after which the state is not read may end without `project` (see `kcons.openmm.integrator.program`): the next
    drift absorbs what v has across the rows. A program with such steps is `lean`.

    Copies and pickles of an integrator copy its parts. `check` is the place to refuse what breaks the rows, see
    `kcons.openmm.integrator.guard.refuse_agents`.
    """

    #: Number of the part in its integrator, from 1; set by the integrator before `declare`.
    code: int = 0
    #: Whether the rows may touch atoms that the System constrains. Such a part calls `program.hold_positions` within
    #: its own `land`; at most one part of an integrator may.
    meets_system: bool = False
    #: Whether it adds to x of its own particles only, so that it comes after the constraints of the System.
    lands_last: bool = False
    #: Force groups that carry rows, not forces.
    groups: frozenset[int] = frozenset()
    #: Whether `land_alone` can fly exactly, as it does where the program is `exact`.
    flies_exactly: bool = False
    #: Whether it is known that the System has no constraints: without other parts, `land_alone` is the whole drift.
    alone: bool = False
    #: Whether x is still a place where forces can be computed after a failure; set-up is faster then.
    stays_finite: bool = False
    #: Whether the System is known to have virtual sites: they are placed before the applied forces are computed.
    sited: bool = False
    #: The program that the part serves: that of the integrator which made steps last.
    program: Program | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "program"}

    def code_in(self, integrator: object) -> int:
        """Its number in an integrator, which need not be the one that it serves now."""
        return next((k for k, part in enumerate(getattr(integrator, "parts", ()), 1) if part is self), self.code)

    @property
    def driven(self) -> bool:
        """Whether rows demand velocities that are not 0."""
        return False

    # -- the program ----------------------------------------------------------------------------

    @abstractmethod
    def declare(self, program: Program) -> None:
        """Variables and tables."""

    @abstractmethod
    def remember(self, program: Program) -> None:
        """Before each drift, x on the constraints: keep the gradients at x."""

    @abstractmethod
    def land(self, program: Program, h: str) -> None:
        """After x = xu: bring x onto the rows along the gradients that were kept. `h` is the length of the drift."""

    @abstractmethod
    def project(self, program: Program) -> None:
        """Make v tangent to the rows at x."""

    def land_alone(self, program: Program, u: str, h: str) -> None:
        """For parts that may be `alone`: the whole drift with velocity u, `remember` included; v gets its impulse."""
        raise NotImplementedError

    def take_precision(self, program: Program, precision: Precision) -> None:
        """The Context is known, and with it what can be held."""

    def attach(self, program: Program, context: openmm.Context) -> None:
        """Positions are known, where others may have set them: before a step, and before anything is checked."""

    def begin_run(self) -> None:
        """Called before steps are made."""

    def end_run(self) -> None:
        """Called after them, also where they failed."""

    def begin(self, program: Program) -> None:
        """What to compute where x is not where the last step ended, for parts that keep something between steps.

        Written where the applied forces are computed anew.
        """

    def renew(self, program: Program) -> None:
        """Before a drift that follows a step without `project`, where v is free to be used."""

    def passed(self, program: Program) -> None:
        """At the end of a step without `project`."""

    # -- in a Context ---------------------------------------------------------------------------

    def check_masses(self, system: openmm.System) -> None:
        """Raise where masses are not those that the rows were built for; most take them from OpenMM."""

    @abstractmethod
    def check(self, context: openmm.Context) -> None:
        """Raise unless the state of the context is on the rows; also whatever is wrong with the set-up."""

    @abstractmethod
    def worst_violation(self, context: openmm.Context, velocities: bool = True) -> Violation | None:
        """What the rows themselves say of the state of the context, whatever solvers believe; None if all hold."""

    def solver_at(self, context: openmm.Context) -> Solver | None:
        """The engine for the rows, where there is one."""
        return None

    def apply_positions(self, context: openmm.Context) -> None:
        """Bring the positions of the context onto the rows, or raise; velocities stay as they are."""
        self.restore_by(self.solver_at(context), context)

    def restore_by(self, solver: Solver | None, context: openmm.Context, bonds: ArrayLike | None = None) -> None:
        """The same by `Motion.restore_positions` with these bonds; the rows themselves say whether they are reached."""
        assert solver is not None
        motion, atoms, time = solver
        start = positions_of(context)
        x = start.copy()
        x[atoms] = motion.restore_positions(start[atoms], time=time, bonds=bonds)
        context.setPositions(x)
        miss = self.worst_violation(context, velocities=False)
        if miss is not None:
            context.setPositions(start)
            raise InfeasibleError(
                f"the rows cannot be reached from here: {miss}; nothing was changed. Start nearer to the targets",
                residual=abs(miss.off),
                row=miss.row,
                atoms=miss.atoms,
            )
        context.computeVirtualSites()

    def apply_velocities(self, context: openmm.Context) -> None:
        """Make the velocities of the context tangent to the rows, the nearest ones in the mass metric, or raise."""
        solver = self.solver_at(context)
        assert solver is not None
        motion, atoms, time = solver
        x, v = motion_of(context)
        v[atoms] = motion.project_velocities(x[atoms], v[atoms], time=time)
        context.setVelocities(v)

    @abstractmethod
    def failure(self, integrator: openmm.CustomIntegrator, step: int) -> KconsError:
        """The error for a step in which the part set `failed`."""

    @abstractmethod
    def rank(self, context: openmm.Context) -> int:
        """How many degrees of freedom the rows take, beyond the constraints of the System."""
