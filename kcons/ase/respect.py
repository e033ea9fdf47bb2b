"""Detection of what does not respect the constraints of its atoms: edits and dynamics classes."""

from __future__ import annotations

import numpy as np
from ase import Atoms
from ase.cell import Cell

from kcons.constraints.arguments import finite_array
from kcons.constraints.compilation import njit
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError

#: How far positions may be off a row (relative to its scale) where ASE moves them or sets momenta: what the digits of
#: most files leave. Farther off they are refused.
START_TOLERANCE = 1e-6
#: Digits after the point that coordinates in Angstrom may have in a file, where they are looked for: GROMACS and PDB
#: files have 2 and 3; what more than 6 leave is within START_TOLERANCE.
DIGITS = (2, 3, 4, 5, 6)
#: Residual of asked positions, relative to the scale of the row, that no usable time step produces ...
ABSURD = 0.3
#: ... and how many steps in a row it takes to say so.
ABSURD_STEPS = 3
#: Farther (in Angstrom) time steps move no atom, but frames do.
FRAME = 0.3
#: A correction (in Angstrom) below which the residual is not even looked at.
_SMALL = 0.1

_FLOAT = np.dtype(np.float64)

ADVICE = (
    "use kcons.ase.ConstrainedDynamics for constant energy, ConstrainedLangevin, ConstrainedNoseHoover or "
    "IsokineticDynamics of kcons.ase for constant temperature, and these with barostat= for constant pressure; of "
    "ASE's own classes VelocityVerlet, Langevin(fixcm=False) and Bussi are right"
)


class Watch:
    """The positions that the constraints last accepted: what differs from them was moved past the constraints.

    Also what an MD engine last asked for, which shows whether it respects the constraints: only dynamics set momenta,
    and an MD engine that goes on from its own copy of the positions asks for uncorrected ones again.

    Attributes
    ----------
    between_steps : bool
        Whether forces were asked for last: all dynamics and optimizers of ASE end their steps so. Who moves atoms then
        is a person, and otherwise most often the dynamics class.
    """

    def __init__(self) -> None:
        self.between_steps = True
        self._accepted: FloatArray | None = None
        self._cell = b""
        self._before: FloatArray | None = None  # what was accepted before these positions were asked for first
        self._asked: FloatArray | None = None
        self._momenta_since = False
        self._counted = False
        self._repeats = 0
        self._absurd = 0
        self._looked = True

    # -- the positions that atoms have ----------------------------------------------------------

    def knows(self, x: FloatArray, cell: FloatArray) -> bool:
        """Whether these are the positions that were accepted last, in the same cell."""
        known = self._accepted
        return known is not None and _same(known, x) and cell.tobytes() == self._cell

    def in_another(self, cell: FloatArray) -> bool:
        """Whether positions were accepted in another cell than this."""
        return self._accepted is not None and cell.tobytes() != self._cell

    def know(self, x: FloatArray, cell: FloatArray) -> None:
        """Accept positions that are on the constraints."""
        self._accepted, self._cell = x.copy(), cell.tobytes()

    def look(self, held: ConstraintSet, x: FloatArray, cell: FloatArray) -> bool:
        """Whether positions before a step, or where momenta are set, may stay: near enough to the constraints.

        What they are off by less than START_TOLERANCE the next step puts right, along the rows, which momenta then
        leave: no atom is faster for it. False where they were scaled together with the cell, as barostats do: they are
        to be put right before the step.

        Raises
        ------
        InputError
            They are off otherwise.
        UnsupportedError
            They are, and were moved within a step.
        """
        good = self.knows(x, cell)
        if not good:
            worst = _worst_row(held, x)
            good = worst is None
            if worst is None:
                self.know(x, cell)
            elif not self._scaled(x, cell):
                self._refuse(held, x, *worst)
        self.between_steps = False
        return good

    def _scaled(self, x: FloatArray, cell: FloatArray) -> bool:
        """Whether positions are those accepted last but for a change of the cell that took them along."""
        known = self._accepted
        if known is None or known.shape != x.shape or not self.in_another(cell):
            return False
        before = Cell(np.frombuffer(self._cell).reshape(3, 3)).complete()
        moved = known @ np.linalg.solve(before, Cell(cell).complete())
        return float(np.abs(moved - x).max(initial=0.0)) <= START_TOLERANCE

    def _refuse(self, held: ConstraintSet, x: FloatArray, row: int, miss: float) -> None:
        if self._accepted is None:
            require_on_surface(held, x)
        finite_array(x, held.n_atoms, "position")
        off = f"atoms are off row {held.row_name(row)} by {miss:.6g} (held at {held.target()[row]:.6g})"
        if self.between_steps:
            raise InputError(
                f"{off}: they were moved past the constraints since the last step, as atoms.positions[...] = ..., "
                "set_distance, rotate_dihedral and set_positions(..., apply_constraint=False) do; going on from there "
                "would turn the correction into velocity. Call Constraints.restore(atoms) first, or make new "
                "constraints that hold what they are at now",
                item="positions",
                atoms=held.row_atoms(row),
            )
        raise UnsupportedError(
            f"{off}: they were moved past the constraints since momenta were last set. If you moved them, call "
            "Constraints.restore(atoms). If not, this dynamics class does so (LangevinBAOAB does); instead, "
            f"{ADVICE}"
        )

    # -- what a dynamics class asks for ---------------------------------------------------------

    def ask(self, new: FloatArray) -> FloatArray:
        """Remember positions before they are corrected."""
        asked = self._asked
        if asked is not None and _same(asked, new):
            if self._momenta_since and not self._counted:
                self._counted = True
                self._repeats += 1
        else:
            if not self._counted:
                self._repeats = 0
            self._counted = False
            asked = new.copy()
            self._looked = False
        self._momenta_since = False
        return asked

    def accept(self, asked: FloatArray, new: FloatArray, cell: FloatArray, atoms: Atoms) -> None:
        """Remember the corrected positions."""
        if not self._counted:
            self._before = self._accepted
        own = new.base is None and new is not atoms.arrays["positions"] and new.dtype == np.float64
        self._accepted = new if own else np.array(new, dtype=np.float64)
        self._cell = cell.tobytes()
        self._asked = asked
        if self._counted and (_near(asked, new) or _near(self._before, new)):
            # Positions that need no correction may be set as often as one likes; atoms at rest ask for the same.
            self._repeats = 0

    def check_momenta(self, held: ConstraintSet, x: FloatArray) -> None:
        """Momenta are about to be set at `x`, which was looked at.

        Raises
        ------
        UnsupportedError
            The MD engine keeps asking for its own uncorrected positions.
        """
        self._momenta_since = True
        if self._repeats >= 2:
            self._repeats = 0
            raise UnsupportedError(
                "this dynamics class asks again for positions that were corrected: it continues from its own copy "
                f"(NoseHooverChainNVT does), so that the constraints have no effect on it. Instead, {ADVICE}"
            )
        if not self._looked:
            self._looked = True
            self._check_correction(held, x)

    def _check_correction(self, held: ConstraintSet, x: FloatArray) -> None:
        asked = self._asked
        if asked is None or not _differ(asked, x, _SMALL):
            self._absurd = 0
            return
        miss = np.abs(held.value(asked)) / held.scale
        self._absurd = self._absurd + 1 if miss.max(initial=0.0) > ABSURD else 0
        if self._absurd >= ABSURD_STEPS:
            self._absurd = 0
            row = int(np.argmax(miss))
            raise UnsupportedError(
                f"in {ABSURD_STEPS} steps in a row, this dynamics class moved atoms off row {held.row_name(row)} by "
                f"{miss[row]:.0%}: it goes on from its own copy of the positions (MelchionnaNPT does), or the time "
                f"step is far too large. Instead, {ADVICE}"
            )


def _worst_row(held: ConstraintSet, x: FloatArray, time: float = 0.0) -> tuple[int, float] | None:
    """The row that `x` violates most beyond START_TOLERANCE, and by how much; None if there is none."""
    miss = np.abs(held.value(x, time))
    allowed = np.maximum(START_TOLERANCE * held.scale, 4 * held.tolerance(x, time))
    if np.all(miss <= allowed):
        return None
    row = int(np.argmax(np.where(np.isnan(miss), np.inf, miss / allowed)))
    return row, float(miss[row])


def require_on_surface(held: ConstraintSet, x: FloatArray, time: float = 0.0) -> None:
    """Refuse positions that are off the constraints, or not finite there.

    Raises
    ------
    InputError
    """
    worst = _worst_row(held, x, time)
    if worst is not None:
        row, miss = worst
        finite_array(x, held.n_atoms, "position")
        target = held.target(time)[row]
        raise InputError(
            f"atoms are off row {held.row_name(row)} by {miss:.6g} (held at {target:.6g}); moving "
            "them from there would turn the correction into velocity. Use constrain(..., project=True) or "
            "Constraints.restore(atoms) first",
            item="positions",
            atoms=held.row_atoms(row),
        )


def moves_far(old: FloatArray, new: FloatArray) -> bool:
    """Whether an atom is asked to go farther than a time step takes it."""
    return old.shape == new.shape and _differ(old, new, FRAME)


def fulfilled(held: ConstraintSet, x: FloatArray, touched: IntArray) -> bool:
    """Whether positions fulfil the rows, those of the atoms `touched`: to rounding, or to the digits they come with."""
    if not np.isfinite(x[touched]).all():
        return False
    if _worst_row(held, x) is None:
        return True
    for digits in DIGITS:
        written = x[touched] * 10.0**digits
        if np.abs(written - np.round(written)).max(initial=0.0) <= 1e-3:  # also those that were float32 in between
            reach = np.asarray(abs(held.jacobian(x)).sum(axis=1)).ravel()
            return bool(np.all(np.abs(held.value(x)) <= 0.5 * 10.0**-digits * reach + START_TOLERANCE * held.scale))
    return False


def _same(a: FloatArray, b: FloatArray) -> bool:
    return a.shape == b.shape and not _differ(a, b, 0.0)


def _differ(a: FloatArray, b: FloatArray, much: float) -> bool:
    """Whether a coordinate differs by more than `much`, or is not finite; of arrays of one shape."""
    if a.dtype is b.dtype is _FLOAT and a.flags.c_contiguous and b.flags.c_contiguous:
        return bool(differ(a, b, much))
    return not bool((np.abs(a - b) <= much).all())


@njit(cache=True, nogil=True)
def differ(a, b, much):  # type: ignore[no-untyped-def]
    """Whether numbers of contiguous arrays differ by more than `much`; NaN does."""
    p, q = a.ravel(), b.ravel()
    other = 0
    for i in range(p.size):
        other |= not abs(p[i] - q[i]) <= much
    return other != 0


def _near(a: FloatArray | None, b: FloatArray) -> bool:
    return a is not None and a.shape == b.shape and float(np.abs(a - b).max(initial=0.0)) <= START_TOLERANCE
