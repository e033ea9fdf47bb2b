"""Detection of what does not respect the constraints of its atoms: dynamics classes, finite differences."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from weakref import WeakSet

import numpy as np
from ase import Atoms

from kcons.constraints.arguments import finite_array
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError

#: How far positions may be off a row (relative to its scale) where ASE moves them or sets momenta.
START_TOLERANCE = 1e-6
#: Residual of asked positions, relative to the scale of the row, that no usable time step produces ...
ABSURD = 0.3
#: ... and how many steps in a row it takes to say so.
ABSURD_STEPS = 3
#: A correction (in Angstrom) below which the residual is not even looked at.
_SMALL = 0.1

#: Modules of ASE that displace atoms one by one and never ask constraints.
DISPLACING = ("ase.vibrations.vibrations", "ase.phonons")
_warned: WeakSet[object] = WeakSet()

ADVICE = (
    "use kcons.ase.ConstrainedDynamics for constant energy, and ase.md.langevin.Langevin(fixcm=False) or "
    "ase.md.bussi.Bussi for constant temperature; if the atoms were edited without constraints, call "
    "Constraints.restore(atoms)"
)


class Watch:
    """The positions that an MD engine last asked for and got, which show whether it respects the constraints.

    Only dynamics set momenta. Positions must be on the constraints then; if they are not, the MD engine has
    continued from its own copy of the positions instead of the corrected ones.
    """

    def __init__(self) -> None:
        self._accepted: FloatArray | None = None
        self._before: FloatArray | None = None  # what was accepted before these positions were asked for first
        self._cell = b""
        self._asked: FloatArray | None = None
        self._momenta_since = False
        self._counted = False
        self._repeats = 0
        self._absurd = 0
        self._looked = True

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

    def accept(self, asked: FloatArray, new: FloatArray, cell: bytes, atoms: Atoms) -> None:
        """Remember the corrected positions."""
        if not self._counted:
            self._before = self._accepted
        own = new.base is None and new is not atoms.arrays["positions"] and new.dtype == np.float64
        self._accepted = new if own else np.array(new, dtype=np.float64)
        self._cell = cell
        self._asked = asked
        if self._counted and (_near(asked, new) or _near(self._before, new)):
            # Positions that need no correction may be set as often as one likes; atoms at rest ask for the same.
            self._repeats = 0

    def check_momenta(self, held: ConstraintSet, cell: bytes, x: FloatArray) -> None:
        """Momenta are about to be set at `x`.

        Raises
        ------
        UnsupportedError
            The positions are off the constraints, or the MD engine keeps asking for its own uncorrected ones.
        """
        self._momenta_since = True
        accepted = self._accepted
        if accepted is None or self._cell != cell or not _same(accepted, x):
            worst = worst_row(held, x)
            if worst is not None and np.isfinite(worst[1]):  # the engine names positions that are not finite
                row, miss = worst
                raise UnsupportedError(
                    f"momenta are set while the atoms are off row {held.row_name(row)} by {miss:.6g}: this dynamics "
                    f"class moves atoms past their constraints (LangevinBAOAB does). Instead, {ADVICE}"
                )
            self._accepted, self._cell = x.copy(), cell
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
        if asked is None or not float(np.abs(asked - x).max(initial=0.0)) > _SMALL:
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


def worst_row(held: ConstraintSet, x: FloatArray, time: float = 0.0) -> tuple[int, float] | None:
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
    worst = worst_row(held, x, time)
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


def _same(a: FloatArray, b: FloatArray) -> bool:
    # Mostly they differ in the first number already.
    return a.shape == b.shape and (not a.size or a[0, 0] == b[0, 0]) and bool((a == b).all())


def _near(a: FloatArray | None, b: FloatArray) -> bool:
    return a is not None and a.shape == b.shape and float(np.abs(a - b).max(initial=0.0)) <= START_TOLERANCE


def warn_of_displacements(held: Callable[[], IntArray]) -> None:
    """Warn, once for each of them, where `Vibrations` or `Phonons` of ASE displaces held atoms.

    These classes ask constraints for nothing but copies, which they or their calculators make: to be called there.
    """
    if not any(name in sys.modules for name in DISPLACING):
        return
    frame, depth = sys._getframe(1), 1
    while frame.f_globals.get("__name__") not in DISPLACING or "self" not in frame.f_locals:
        if frame.f_back is None:
            return
        frame, depth = frame.f_back, depth + 1
    finite = frame.f_locals["self"]
    if finite in _warned or getattr(finite.calc, "respects_constraints", False):
        return
    _warned.add(finite)
    moved = np.intersect1d(finite.indices, held())
    if not len(moved):
        return
    while frame.f_back is not None and str(frame.f_globals.get("__name__")).startswith("ase."):
        frame, depth = frame.f_back, depth + 1
    name = type(finite).__name__
    warnings.warn(
        f"{name} displaces atom {moved[0]} past its constraints, which it does not ask: what it prints belongs to "
        "atoms that are free. Take the constraints off the atoms (atoms.set_constraint()) and give it a "
        f"kcons.ase.ConstrainedCalculator(calculator, constraints), or leave the {len(moved)} held atoms out of its "
        "indices",
        UserWarning,
        stacklevel=depth + 1,
    )
