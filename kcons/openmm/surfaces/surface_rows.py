"""What all surface parts of an integrator share: rows of one atom each, their parameters, checks and errors."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

import numpy as np
import openmm
from numpy.typing import ArrayLike
from openmm import unit

from kcons.constraints.constraint import Constraint, IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import ConvergenceError, InputError, KconsError, NonFiniteError, UnsupportedError
from kcons.motion.motion import Motion
from kcons.openmm.integrator.part import BOND, NEAR, Part, Solver, Violation
from kcons.openmm.integrator.program import Program
from kcons.openmm.integrator.system_checks import refuse_agents, require_context
from kcons.openmm.quantities import masses_of
from kcons.openmm.states import motion_of, positions_of

#: A start that is farther from its surface (nm), or has a larger share of its velocity across it, is refused.
START_TOLERANCE = 1e-6
CARRIER = "hold them with kcons' constraint objects instead, by the carrier (kcons.openmm.hold)"


class SurfaceRows(Part):
    """Atoms that are each on one surface, as a `Part` of an integrator.

    Parameters
    ----------
    rows : sequence of Constraint
        kcons objects over one atom a row, lengths in nm, with explicit targets that rest.
    n_particles : int
        Particles of the System.

    Attributes
    ----------
    bonded : bool
        Whether the System may have constraints of its own, on other particles.
    """

    bonded = True
    #: Whether `fly_alone` moves x before it needs the velocity of the drift for the last time.
    moves = False

    def __init__(self, rows: Sequence[Constraint], n_particles: int) -> None:
        self.rows = tuple(rows)
        self.atoms: IntArray = np.concatenate([item.atoms[:, 0] for item in self.rows])
        self.n_particles = n_particles

    # -- parameters -----------------------------------------------------------------------------

    def _gather(self, *values: ArrayLike) -> FloatArray:
        """One array over all rows from one array for each object."""
        return np.concatenate([np.asarray(value, dtype=np.float64) for value in values])

    def _parameter(self, p: Program, name: str, words: str, values: FloatArray, elsewhere: float = 0.0) -> str:
        """Declare a variable that holds a number or vector of each row, and `elsewhere` for other particles."""
        table = np.full((self.n_particles, 3), elsewhere)
        table[self.atoms] = values if values.ndim == 2 else values[:, None]
        return p.vector_setting(name, words, table)

    def _fail(self, p: Program, solved: str, words: str) -> None:
        """Set `failed` unless the expression `solved` is 1 for each degree of freedom (NaN counts as 0)."""
        p.number("unsolved", "how many degrees of freedom found no solution")
        p.sum("unsolved", f"1-{solved}", words)
        p.let("failed", f"select(unsolved, {self.code}, failed)", "which part has no solution")

    # -- the program ----------------------------------------------------------------------------

    @abstractmethod
    def fly(self, p: Program, u: str, h: str) -> None:
        """Find the landing of a drift of length `h` with velocity `u` from x, on the surface; x and v stay."""

    @abstractmethod
    def impulse(self, h: str) -> str:
        """After `fly`: the expression that, added to u, makes x + h u land; 0 for other particles."""

    def fly_alone(self, p: Program, u: str, h: str) -> None:
        """The whole drift, where no other part has rows; without a landing x and v stay."""
        self.fly(p, u, h)
        p.each("v", f"select(failed, v, {u}+{self.impulse(h)})", "impulse of the surface")
        p.each("x", f"select(failed, x, x+{h}*v)", "fly onto the surface")

    # -- running --------------------------------------------------------------------------------

    def row_name(self, k: int) -> str:
        """For example 'Sphere(4)'."""
        for item in self.rows:
            if k < item.n_rows:
                return item.row_name(k)
            k -= item.n_rows
        raise IndexError(k)

    def distances(self, x: FloatArray) -> FloatArray:
        """How far each atom is from its surface in nm (to first order), from positions of all particles."""
        found = []
        for item in self.rows:
            r = x[item.atoms]
            slope = item.gradient(r, 0.0)[:, 0]
            found.append((item.measure(r, 0.0) - item.target_at(0.0)) / np.sqrt(np.einsum("ij,ij->i", slope, slope)))
        return np.concatenate(found)

    def normals(self, x: FloatArray) -> FloatArray:
        """Unit normals, shape (n_rows, 3)."""
        slopes = np.concatenate([item.gradient(x[item.atoms], 0.0)[:, 0] for item in self.rows])
        return np.asarray(slopes / np.sqrt(np.einsum("ij,ij->i", slopes, slopes))[:, None])

    def attach(self, program: Program, context: openmm.Context) -> None:
        """Refuse another number of particles than the variables of the program have."""
        found = context.getSystem().getNumParticles()
        if found != self.n_particles:
            raise InputError(
                f"surfaces were made for {self.n_particles} particles, and the System has {found}; make them again "
                "with system= or the right n_particles=",
                item="n_particles",
            )

    def check(self, context: openmm.Context, velocities: bool = True) -> None:
        """Raise `InputError` unless all atoms are on their surfaces with velocities along them.

        And `UnsupportedError` for a System that surfaces do not go with.
        """
        refuse_system(context.getSystem(), self.atoms)
        require_context(context)
        x, v = motion_of(context)
        first = 0
        for item in self.rows:
            item.check(x[item.atoms], 0.0, first)
            first += item.n_rows
        miss = self._worst(x, v if velocities else None)
        if miss is None:
            return
        off = (
            f"is {abs(miss.off):.3g} nm from its surface, {miss.name}; move it there with integrator.applyConstraints("
        )
        off += "context). (Surfaces are not repeated in periodic boxes: positions must not be wrapped)"
        if miss.what == "velocities":
            off = f"has the velocity {abs(miss.off):.3g} nm/ps across its surface, {miss.name}; call "
            off += "integrator.applyVelocityConstraints(context) after velocities are set"
        raise InputError(f"particle {miss.atoms[0]} {off}", item=miss.what, atoms=miss.atoms)

    def worst_violation(self, context: openmm.Context, velocities: bool = True) -> Violation | None:
        """Distances from the surfaces and velocities across them, by the objects that were given."""
        require_context(context)
        x, v = motion_of(context)
        return self._worst(x, v if velocities else None)

    def _worst(self, x: FloatArray, v: FloatArray | None) -> Violation | None:
        allowed = START_TOLERANCE * np.maximum(1.0, np.abs(x[self.atoms]).max(axis=1))
        near = NEAR * np.concatenate([_length(item) for item in self.rows])
        miss = Violation.worst("positions", self.distances(x), allowed, self.row_name, self._atoms_of, near)
        if miss is not None or v is None:
            return miss
        held = v[self.atoms]
        across = np.einsum("ij,ij->i", self.normals(x), held)
        speed = np.sqrt(np.einsum("ij,ij->i", held, held))
        allowed = START_TOLERANCE * np.maximum(speed, np.abs(v).max())
        return Violation.worst("velocities", across, allowed, self.row_name, self._atoms_of)

    def _atoms_of(self, row: int) -> list[int]:
        return [int(self.atoms[row])]

    def solver_at(self, context: openmm.Context) -> Solver:
        """The engine for these atoms."""
        require_context(context)
        return Solver(engine(context, [self], positions_of(context)), self.atoms)

    def rank(self, context: openmm.Context) -> int:
        """One for each atom: rows on different atoms are independent."""
        return len(self.atoms)

    def _error(self, solved: FloatArray, step: int, residuals: FloatArray) -> KconsError:
        """The error for a step, from what `_fail` saw at each row (NaN where something was not finite)."""
        unknown = np.flatnonzero(~np.isfinite(solved))
        if len(unknown):
            atom = int(self.atoms[unknown[0]])
            return NonFiniteError(
                f"step {step}: the force on particle {atom} or its velocity is no finite number; positions and "
                "velocities are those of the last state that was finite",
                item="force",
                atom=atom,
                step=step,
            )
        k = int(np.argmin(solved))
        atom = int(self.atoms[k])
        return ConvergenceError(
            f"step {step}: particle {atom} finds no position on its surface, {self.row_name(k)}: time step too "
            "large; positions and velocities are those before the step",
            residual=float(residuals[k]),
            row=k,
            atoms=[atom],
            step=step,
        )

    def _values(self, integrator: openmm.CustomIntegrator, name: str) -> FloatArray:
        """A number of each row, from a variable of the program."""
        table = np.array([[v[0], v[1], v[2]] for v in integrator.getPerDofVariableByName(name)])
        return np.asarray(table[self.atoms, 0])


def _length(item: Constraint) -> FloatArray:
    """Of each row, the radius of its surface; that of a bond for planes and formulas, which have none."""
    radius = np.zeros(item.n_rows) if item.family == "Plane" else item.scale(0.0)
    return np.where(radius > 0, radius, BOND)


def engine(context: openmm.Context, parts: Sequence[SurfaceRows], x: FloatArray) -> Motion:
    """The solver of kcons for the atoms of these parts alone, in their order, at positions x of all particles."""
    system, atoms = context.getSystem(), np.concatenate([part.atoms for part in parts])
    new_index = np.zeros(system.getNumParticles(), dtype=np.int64)
    new_index[atoms] = np.arange(len(atoms))
    rows = [item.renumbered(new_index) for part in parts for item in part.rows]
    return Motion(ConstraintSet(rows, x[atoms], masses_of(system)[atoms]), x[atoms])


def refuse_system(system: openmm.System, atoms: IntArray) -> None:
    """Raise `UnsupportedError` where the System has something that surfaces do not go with."""
    held = set(atoms.tolist())
    for k in range(system.getNumConstraints()):
        i, j, _ = system.getConstraintParameters(k)
        for atom in held & {i, j}:
            raise UnsupportedError(
                f"particle {atom} is on a surface and in the System's constraint ({i}, {j}): each would undo the "
                f"other; take that constraint out of the System and {CARRIER}"
            )
    for atom in sorted(held):
        if system.getParticleMass(atom).value_in_unit(unit.dalton) == 0:
            raise UnsupportedError(
                f"particle {atom} has no mass and is not moved by integrators: it cannot be held on a surface"
            )
    refuse_agents(system, "a surface")
