"""The engine for one `Atoms`: whether it still fits, and whether others respect it.

Edits of the atoms and dynamics classes that move them past their constraints are found by the positions that the
constraints accepted last.
"""

from __future__ import annotations

import pickle
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from math import isfinite
from threading import RLock
from typing import Any

import ase.constraints
import numpy as np
from ase import Atoms
from ase.cell import Cell
from numpy.typing import NDArray

from kcons.ase.topology import velocities_of
from kcons.constraints import Constraint
from kcons.constraints.arguments import as_array, as_float_array, finite_array
from kcons.constraints.compilation import njit
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, KconsError, UnsupportedError
from kcons.motion.certificate import off_row
from kcons.motion.motion import Motion
from kcons.steppers.state import KICK_ROUNDING
from kcons.thermostats.cells import constraint_virial, rows_open

#: How far positions may be off a row (relative to its scale) where ASE moves them or sets momenta: what the digits of
#: most files leave. Farther off they are refused.
START_TOLERANCE = 1e-6
#: Residual of asked positions, relative to the scale of the row, that no usable time step produces ...
ABSURD = 0.3
#: ... and how many steps in a row it takes to say so.
ABSURD_STEPS = 3
#: Farther (in Angstrom) time steps move no atom, but frames do.
FRAME = 0.3
#: A correction (in Angstrom) below which the residual is not even looked at.
SMALL = 0.1

#: What `compared` finds: atoms are elsewhere than accepted, other positions are asked for than before, far from the
#: present ones, and the last correction was large.
ELSEWHERE, NEW, FAR, LARGE = 1, 2, 4, 8

ADVICE = (
    "use kcons.ase.ConstrainedDynamics for constant energy, ConstrainedLangevin, ConstrainedNoseHoover or "
    "IsokineticDynamics of kcons.ase for constant temperature, and these with barostat= for constant pressure; of "
    "ASE's own classes VelocityVerlet, Langevin(fixcm=False) and Bussi are right"
)
_OFF_AT_START = (
    "moving them from there would turn the correction into velocity. Use constrain(..., project=True) or "
    "Constraints.restore(atoms) first"
)
_EDITED = (
    "they were moved past the constraints since the last step, as atoms.positions[...] = ..., set_distance, "
    "rotate_dihedral and set_positions(..., apply_constraint=False) do; going on from there would turn the correction "
    "into velocity. Call Constraints.restore(atoms) first, or make new constraints that hold what they are at now"
)
_MOVED_WITHIN_A_STEP = (
    "they were moved past the constraints since momenta were last set. If you moved them, call "
    f"Constraints.restore(atoms). If not, this dynamics class does so (LangevinBAOAB does); instead, {ADVICE}"
)

#: What objects of ASE hold, by the names of their attributes.
_HELD = "index", "mask", "dir", "pairs", "bondlengths", "triples", "bonds", "angles", "dihedrals", "bondcombos"

#: ASE objects that only add forces, so that they get along with any constraint.
FORCES_ONLY = (ase.constraints.Hookean, ase.constraints.ExternalForce)

#: Why there is no stress beside these, and what takes energies alone.
BY_ENERGIES = "use MonteCarloBarostat, or virial='difference' of a PressureReporter, which take energies alone"
STRESSLESS = f"forces that constraints of ASE add have no stress; put them into the calculator, or {BY_ENERGIES}"

_PLURAL = {"position": "positions", "momentum": "momenta", "force": "forces"}
#: Of engines, which copies of atoms share: the images of NEB(parallel=True) ask them in threads.
IN_TURN = RLock()


@dataclass
class Binding:
    """The engine for one set of masses and one cell, with copies that show when these have changed."""

    motion: Motion
    given: tuple[Constraint, ...]
    made_for: tuple[Any, ...]
    periodic: bool
    cell: bytes
    #: Whether rows touch some atoms only, so that solvers do not see the others.
    partial: bool
    #: Other constraints on the atoms, and what these held when they were looked at.
    others: tuple[Any, ...] = ()

    def follow_cell(self, atoms: Atoms, cell: FloatArray) -> None:
        """Let the engine know the cell, if it has changed; an `InputError` leaves it as it was."""
        content = cell.tobytes()
        if content != self.cell:
            if self.periodic:
                self.motion.set_cell(cell, atoms.pbc, atoms.arrays["positions"])
            self.cell = content

    def kernel_array(self, values: NDArray[Any], what: str) -> FloatArray:
        """The array itself where kernels can write to it, else a copy; integers and what is not finite are refused."""
        array = as_array(values, (self.motion.n_atoms, 3), _PLURAL[what])
        # The answer is written into `values`, which would cut it; that for momenta and forces of 0 is 0.
        if array is not values and values.dtype.kind in "biu" and (what == "position" or values.any()):
            raise InputError(
                f"{_PLURAL[what]} are integers ({values.dtype}), which cannot hold what the constraints leave of "
                "them; give floats, for example array.astype(float)",
                item=what,
            )
        if self.partial and not isfinite(np.vdot(array, array)):
            refuse_not_finite(array, what)
        return array

    def projected(self, x: FloatArray, values: FloatArray, what: str, out: FloatArray | None) -> FloatArray:
        """Momenta, or forces, without what leaves the constraints: p - A^T (A M^-1 A^T)^-1 A M^-1 p."""
        try:
            return self.motion.project_forces(x, values, out=out)
        except KconsError:
            refuse_not_finite(values, what)
            raise

    def momenta_on_surface(self, atoms: Atoms, p: FloatArray, *, certified: bool) -> FloatArray:
        """Momenta without what leaves the constraints, in their place unless they are certified."""
        x = atoms.arrays["positions"]
        left = self.projected(x, p, "momentum", None if certified else p)
        if certified:  # positions may be as a file gave them, off by less than START_TOLERANCE
            # Of momenta along the constraints alone, as of molecules at rest, the projection leaves rounding.
            still = KICK_ROUNDING * float(np.abs(velocities_of(atoms, momenta=p)).max(initial=0.0))
            self.motion.certify(x, velocities_of(atoms, momenta=left), still=still, moved=False)
        return left


def read_by_engine(atoms: Atoms) -> tuple[Any, ...]:
    """Periodicity and masses, of which an engine is made besides rows and cell; every hook asks, so bytes."""
    arrays = atoms.arrays
    name = "masses" if "masses" in arrays else "numbers"
    return atoms.pbc.tobytes(), name, arrays[name].tobytes()


def refuse_not_finite(values: FloatArray, what: str) -> None:
    """Refuse NaN and infinity, and name the atom."""
    bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(bad):
        raise InputError(
            f"{what} of atom {bad[0]} is not finite: {values[bad[0]]}; look at what the calculator returned",
            item=what,
            atoms=[bad[0]],
        )


def bind(given: Sequence[Constraint], atoms: Atoms, time: float = 0.0) -> Binding:
    """A new engine for `given` on `atoms`."""
    periodic = bool(atoms.pbc.any())
    x = atoms.arrays["positions"]
    held = ConstraintSet(
        given, x, atoms.get_masses(), cell=atoms.cell.array if periodic else None, pbc=atoms.pbc, time=time
    )
    motion = Motion(held, x, time=time)
    return Binding(
        motion=motion,
        given=held.constraints,
        made_for=read_by_engine(atoms),
        periodic=periodic,
        cell=atoms.cell.array.tobytes(),
        partial=len(held.touched) < len(atoms),
    )


def holding(item: Any) -> Any:
    """What a constraint of ASE or kcons holds, to be compared; nothing for those that only add forces."""
    own = item.__dict__
    rows = own.get("constraints")
    if rows is not None:  # of kcons, whose rows are never changed
        return rows
    return None if isinstance(item, FORCES_ONLY) else pickle.dumps([own.get(name) for name in _HELD])


def company(present: Sequence[Any]) -> tuple[tuple[Any, Any], ...]:
    """Constraints, each with what it holds now; equal as long as they are the same objects and hold the same."""
    return tuple((item, holding(item)) for item in present)


def check_company(present: Sequence[Any], own: Any, bound: Binding) -> None:
    """Refuse ASE constraints that share atoms with `own`: ASE would apply them one after the other."""
    now = company(present)
    if now == bound.others:
        return
    for other in present:
        if other is own or isinstance(other, FORCES_ONLY):
            continue
        if type(other) is ase.constraints.FixCom and all(c.translation_invariant for c in bound.given):
            continue  # a common shift of all atoms changes no row
        both = np.intersect1d(_acted_on(other, bound.motion.n_atoms), bound.motion.constraint_set.touched)
        if len(both):
            raise UnsupportedError(
                f"{type(other).__name__} acts on atom {both[0]}, which kcons holds too; ASE would apply the two "
                "one after the other, and neither would hold. Put all of it into one Constraints object, if kcons has "
                "a counterpart: attach(atoms) does so for what is on the atoms; for new rows, held = "
                "from_ase_constraints(atoms), atoms.set_constraint(), constrain(atoms, [*held, *new])"
            )
    bound.others = now


def _acted_on(other: Any, n_atoms: int) -> IntArray:
    """Atoms that an ASE constraint acts on; all where it does not say."""
    if isinstance(other, ase.constraints.FixedMode):  # its own get_indices names none
        return np.flatnonzero(other.mode.reshape(-1, 3).any(axis=1))
    if hasattr(other, "touched"):  # another object of kcons
        return np.asarray(other.touched)
    return np.arange(n_atoms)[other.get_indices() if hasattr(other, "get_indices") else slice(None)]


@contextmanager
def unchanged_on_failure(atoms: Atoms) -> Iterator[None]:
    """Put positions, momenta, cell and constraints of the atoms back where something is refused."""
    arrays = {name: atoms.arrays[name].copy() for name in ("positions", "momenta") if name in atoms.arrays}
    cell, constraints = atoms.cell.array.copy(), list(atoms.constraints)
    try:
        yield
    except BaseException:
        for name, values in arrays.items():
            atoms.arrays[name][...] = values
        atoms.cell[...] = cell
        atoms.set_constraint(constraints)
        raise


def touched_atoms(constraints: Sequence[Constraint]) -> IntArray:
    atoms = [c.atoms.ravel() for c in constraints]
    return np.unique(np.concatenate(atoms)) if atoms else np.zeros(0, dtype=np.int64)


def applied_forces(atoms: Atoms) -> FloatArray:
    """Forces of the calculator and of ASE objects that only add forces; a copy."""
    return with_added(atoms, atoms.get_forces(apply_constraint=False))


def with_added(atoms: Atoms, given: Any, present: Sequence[Any] | None = None) -> FloatArray:
    """Forces and those that ASE objects add that only add forces, all or those among `present`; a copy."""
    forces = np.array(as_float_array(given, "forces of the calculator"))
    if forces.shape == (len(atoms), 3):  # otherwise whoever asked complains
        for item in atoms.constraints if present is None else present:
            if isinstance(item, FORCES_ONLY):
                item.adjust_forces(atoms, forces)
    return forces


# -- what respects the constraints ------------------------------------------------------------------


class AcceptedPositions:
    """The positions that the constraints last accepted: what differs from them was moved past the constraints.

    Also those that were asked for: an MD engine that goes on from its own copy asks for uncorrected ones again.
    """

    def __init__(self, n_atoms: int) -> None:
        #: Whether forces were asked for last: all dynamics and optimizers of ASE end their steps so. Who moves atoms
        #: then is a person, and otherwise most often the dynamics class.
        self.between_steps = True
        self._cell: bytes | None = None  # of the accepted positions
        #: Positions as they were accepted, as they were accepted before, and as they were asked for.
        self._positions, self._before, self.asked = np.full((3, n_atoms, 3), np.nan)
        self._momenta_since = self._again = False
        self._repeats = self._absurd = 0
        #: Calls of the hooks until what they find is certified.
        self.positions_due = self.momenta_due = 0

    def in_another(self, cell: bytes) -> bool:
        """Whether positions were accepted in another cell than this."""
        return self._cell is not None and cell != self._cell

    def know(self, x: FloatArray, cell: bytes) -> None:
        """Accept positions that are on the constraints."""
        self._positions[...], self._cell = x, cell

    def look(self, motion: Motion, x: FloatArray, cell: bytes, *, elsewhere: bool = False) -> bool:
        """Whether positions before a step, or where momenta are set, may stay: near enough to the constraints.

        What they are off by less than START_TOLERANCE the next step puts right, along the rows, which momenta then
        leave: no atom is faster for it. False where they were scaled together with the cell, as barostats do: they are
        to be put right before the step.

        Raises
        ------
        InputError
            They are off otherwise.
        UnsupportedError
            They are, and were moved within a step; or they were scaled, and a row holds them in space.
        """
        changed = self.in_another(cell)
        good = not (changed or elsewhere or differ(self._positions, x))
        if not good:
            scaled = changed and self._scaled(motion, x, cell)
            good = fulfilled(motion.constraint_set, x)
            if good:
                self.know(x, cell)
            elif not scaled:
                by_class = self._cell is not None and not self.between_steps
                why = _MOVED_WITHIN_A_STEP if by_class else _OFF_AT_START if self._cell is None else _EDITED
                require_on_surface(motion.constraint_set, x, why=why, by_class=by_class)
        self.between_steps = False
        return good

    def _scaled(self, motion: Motion, x: FloatArray, cell: bytes) -> bool:
        """Whether positions are those accepted last but for a change of the cell that took them along."""
        before, after = (np.frombuffer(each or b"").reshape(3, 3) for each in (self._cell, cell))
        refuse_taken_along(motion, self._positions, before, x, after)
        return _near(self._positions @ deformation(before, after), x)

    def ask(self, held: ConstraintSet, old: FloatArray, new: FloatArray) -> int:
        """Remember positions before they are corrected; what `compared` finds of them.

        `UnsupportedError` where the last corrections were larger than any usable time step makes them.
        """
        found: int = compared(old, self._positions, new, self.asked)
        if self._momenta_since:
            if found & LARGE and np.isfinite(self.asked).all():
                self._refuse_absurd(held)
            else:
                self._absurd = 0
        if found & NEW:
            self._repeats, self._again = self._repeats + 1 if self._again else 0, False
            self._before[...], self.asked[...] = self._positions, new
        elif self._momenta_since:
            self._again = True
        self._momenta_since = False
        return found

    def accept(self, new: FloatArray, cell: bytes) -> None:
        """Remember the corrected positions."""
        self.know(new, cell)
        if self._again and (_near(self.asked, new) or _near(self._before, new)):
            # Positions that need no correction may be set as often as one likes; atoms at rest ask for the same.
            self._repeats, self._again = 0, False

    def note_momenta(self) -> None:
        """Momenta are set; `UnsupportedError` where an MD engine keeps asking for its own uncorrected positions."""
        self._momenta_since = True
        if self._again and self._repeats:
            self._repeats, self._again = 0, False
            raise UnsupportedError(
                "this dynamics class asks again for positions that were corrected: it continues from its own copy "
                f"(NoseHooverChainNVT does), so that the constraints have no effect on it. Instead, {ADVICE}"
            )

    def _refuse_absurd(self, held: ConstraintSet) -> None:
        miss = np.abs(held.value(self.asked)) / held.scale
        self._absurd = self._absurd + 1 if miss.max(initial=0.0) > ABSURD else 0
        if self._absurd >= ABSURD_STEPS:
            self._absurd = 0
            row = int(np.argmax(miss))
            raise UnsupportedError(
                f"in {ABSURD_STEPS} steps in a row, this dynamics class moved atoms off row {held.row_name(row)} by "
                f"{miss[row]:.0%}: it goes on from its own copy of the positions (MelchionnaNPT does), or the time "
                f"step is far too large. Instead, {ADVICE}"
            )


#: Of atoms that are not known yet.
UNKNOWN = AcceptedPositions(0)


def _worst_row(held: ConstraintSet, x: FloatArray, time: float = 0.0) -> tuple[int, float]:
    """The row that `x` violates most beyond START_TOLERANCE, -1 if there is none, and by how much."""
    miss = np.abs(held.value(x, time))
    row = off_row(miss, np.maximum(START_TOLERANCE * held.scale, 4 * held.tolerance(x, time)))
    return row, float(miss[row]) if row >= 0 else 0.0


def require_on_surface(
    held: ConstraintSet, x: FloatArray, time: float = 0.0, *, why: str = _OFF_AT_START, by_class: bool = False
) -> None:
    """Refuse positions that are off the constraints, or not finite there, and say `why`.

    With `UnsupportedError` where a dynamics class moved them there.
    """
    row, miss = _worst_row(held, x, time)
    if row >= 0:
        finite_array(x, held.n_atoms, "position")
        said = f"atoms are off row {held.row_name(row)} by {miss:.6g} (held at {held.target(time)[row]:.6g}): {why}"
        raise UnsupportedError(said) if by_class else InputError(said, item="positions", atoms=held.row_atoms(row))


#: Places of the Voigt components xx, yy, zz, yz, xz, xy in a 3 x 3 matrix.
VOIGT = ((0, 1, 2, 1, 0, 0), (0, 1, 2, 2, 2, 1))


def stress_of_rows(motion: Motion, atoms: Atoms, velocities: FloatArray, time: float = 0.0) -> FloatArray:
    """Stress of the rows, Voigt order, at the present positions and these velocities.

    Raises
    ------
    UnsupportedError
        The atoms are off the constraints: what scales atoms with the cell and asks for the stress there, as ASE's
        StrainFilter, does not respect them. Or objects of ASE add forces, which are in no stress.
    """
    x = atoms.arrays["positions"]
    if with_added(atoms, np.zeros_like(x)).any():
        raise UnsupportedError(STRESSLESS)
    why = "the stress is asked for there, as StrainFilter does; take FrechetCellFilter, or call Constraints.restore"
    require_on_surface(motion.constraint_set, x, time, why=why, by_class=True)
    forces = atoms.get_forces(apply_constraint=False)
    return np.asarray(-constraint_virial(motion, x, velocities, forces, time)[VOIGT] / atoms.get_volume())


def deformation(before: FloatArray, after: FloatArray) -> FloatArray:
    """The matrix that takes positions along from one cell to another, as ``atoms.set_cell(..., scale_atoms=True)``."""
    return np.asarray(np.linalg.solve(Cell(before).complete(), Cell(after).complete()))


def refuse_taken_along(
    motion: Motion, before: FloatArray, cell_before: FloatArray, x: FloatArray, cell: FloatArray
) -> None:
    """Refuse atoms that a change of the cell took along an axis along which a row holds them in space.

    So do the cell filters of ASE, while the row puts the atoms back: forces of the filter would not be the derivative
    of its energy.
    """
    held = motion.constraint_set
    if all(item.translation_invariant for item in held.constraints) or before.shape != x.shape:
        return
    strain = deformation(cell_before, cell)
    taken = before @ strain
    changed = np.abs(strain - np.eye(3)) > 1e-12
    shut = ~rows_open(motion, before) & (changed.any(axis=0) | changed.any(axis=1))
    for row, axis in np.argwhere(shut):
        atoms = held.row_atoms(int(row))
        along, stayed = (np.abs(there[atoms, axis] - x[atoms, axis]).max() for there in (taken, before))
        if along < stayed:
            raise UnsupportedError(
                f"row {held.row_name(int(row))} holds atoms in space along {'xyz'[axis]}, and they were moved along "
                "with the cell, as cell filters (FrechetCellFilter) and barostats of ASE do: relax at this cell, leave "
                "the axis out of the mask, or hold these atoms relative to others; after an edit call "
                "Constraints.restore(atoms)"
            )


def fulfilled(held: ConstraintSet, x: FloatArray) -> bool:
    """Whether positions fulfill the rows, up to START_TOLERANCE."""
    return _worst_row(held, x)[0] < 0


def differ(a: FloatArray, b: FloatArray) -> bool:
    """Whether two arrays differ in a bit."""
    return a.tobytes() != b.tobytes()


@njit(cache=True)
def compared(old, accepted, new, asked):  # type: ignore[no-untyped-def]
    """The sum of what is found of ELSEWHERE, NEW, FAR and LARGE."""
    x, known, y, last = old.ravel(), accepted.ravel(), new.ravel(), asked.ravel()
    elsewhere, other, far, large = 0, 0, 0, 0
    for i in range(x.size):
        elsewhere |= x[i] != known[i]
        other |= y[i] != last[i]
        far |= not abs(x[i] - y[i]) <= FRAME
        large |= not abs(known[i] - last[i]) <= SMALL
    return elsewhere * ELSEWHERE + other * NEW + far * FAR + large * LARGE


def _near(a: FloatArray, b: FloatArray) -> bool:
    return float(np.abs(a - b).max(initial=0.0)) <= START_TOLERANCE
