"""The engine for one `Atoms`, and the tests whether it, and forces that are known, still fit."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from copy import deepcopy
from dataclasses import dataclass
from math import isfinite
from operator import is_
from threading import local
from typing import Any, Literal, TypeAlias
from weakref import ref

import ase.constraints
import numpy as np
from ase import Atoms
from numpy.typing import ArrayLike, NDArray

from kcons.constraints import Constraint
from kcons.constraints.arguments import numbers
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError
from kcons.motion.motion import Motion
from kcons.steppers import State

#: Arrays up to this length are compared fastest as bytes.
_SHORT = 4096

#: Arrays of atoms that calculators read.
_READ = ("numbers", "initial_charges", "initial_magmoms")

#: Engines of the last objects that are kept for other objects with the same rows, as frames of a file have.
RECENT = 2

#: What objects of ASE hold, by the names of their attributes.
_HELD = "index", "mask", "dir", "pairs", "bondlengths", "triples", "bonds", "angles", "dihedrals", "bondcombos"

#: ASE objects that only add forces, so that they get along with any constraint.
FORCES_ONLY = (ase.constraints.Hookean, ase.constraints.ExternalForce)


#: Constraints on atoms, each with what it holds.
Company: TypeAlias = tuple[tuple[Any, Any], ...]


@dataclass
class Binding:
    """The engine for one set of masses and one cell, with copies that show when these have changed."""

    motion: Motion
    given: tuple[Constraint, ...]
    touched: IntArray
    all_touched: bool
    #: The atoms whose masses matter.
    weighed: IntArray | slice
    n_atoms: int
    mass_array: str
    mass_values: NDArray[Any]
    mass_bytes: bytes | None  # the same, for short arrays
    periodic: bool
    pbc: bytes
    cell: bytes
    #: m and 1/m (0 for fixed atoms) for each component, and room for velocities; None if only some atoms are held.
    weights: tuple[FloatArray, FloatArray, FloatArray] | None
    #: Other constraints on the atoms, and what these held when they were looked at.
    others: Company = ()
    #: The object whose cells the engine follows, if it is still there.
    owner: Callable[[], object] = lambda: None

    def serves(self, holder: object, cell: FloatArray, new: FloatArray | None = None) -> bool:
        """Whether `holder`, whose cell is this, can go on with the engine, also in a new cell.

        Copies of an object share an engine as long as all are in one cell; then only its owner goes on with it.
        """
        owner = self.owner()
        if owner is holder or not self.periodic:
            return True
        if cell.tobytes() != self.cell:
            return False
        if owner is None:
            self.owner = ref(holder)
            return True
        return new is None or new.tobytes() == self.cell

    def fits(self, atoms: Atoms) -> bool:
        """Whether number of atoms, periodicity and masses are still the same."""
        # Every hook comes through here: compare bytes, which costs a fraction of a microsecond, and build nothing.
        arrays = atoms.arrays
        if len(arrays["positions"]) != self.n_atoms or atoms.pbc.tobytes() != self.pbc:
            return False
        name = "masses" if "masses" in arrays else "numbers"
        if name != self.mass_array:
            return False
        values = arrays[name][self.weighed]
        if self.mass_bytes is not None:
            return bool(values.tobytes() == self.mass_bytes)
        return bool((values == self.mass_values).all())

    def check(self, values: NDArray[Any], what: str) -> None:
        """Refuse integers, and NaN and infinity also on atoms that no row holds, which the engine does not look at."""
        # The answer is written into the same array, which would cut it; that for momenta and forces of 0 is 0.
        if values.dtype.kind in "biu" and (what == "position" or values.any()):
            plural = "momenta" if what == "momentum" else f"{what}s"
            raise InputError(
                f"{plural} are integers ({values.dtype}), which cannot hold what the constraints leave of them; give "
                "floats, for example array.astype(float)",
                item=what,
            )
        if self.all_touched or isfinite(np.vdot(values, values)):
            return
        bad = np.flatnonzero(~np.isfinite(values.reshape(len(values), -1)).all(axis=1))
        if len(bad):
            raise InputError(
                f"{what} of atom {bad[0]} is not finite: {values[bad[0]]}; look at what the calculator returned",
                item=what,
                atoms=[bad[0]],
            )

    def follow_cell(self, atoms: Atoms, cell: FloatArray) -> None:
        """Let the engine know the cell, if it has changed; an `InputError` leaves it as it was."""
        if self.periodic:
            content = cell.tobytes()
            if content != self.cell:
                self.motion.set_cell(cell, atoms.pbc, atoms.arrays["positions"])
                self.cell = content


def bind(
    given: Sequence[Constraint],
    atoms: Atoms,
    degenerate: Literal["convert", "raise"],
    time: float = 0.0,
    *,
    all_masses: bool = False,
) -> Binding:
    """A new engine for `given` on `atoms`; with `all_masses` it fits as long as masses of free atoms stay, too."""
    periodic = bool(atoms.pbc.any())
    x = atoms.arrays["positions"]
    held = ConstraintSet(
        given, x, atoms.get_masses(), cell=atoms.cell.array if periodic else None, pbc=atoms.pbc, time=time
    )
    motion = Motion(held, x, degenerate=degenerate, time=time)
    touched = touched_atoms(held.constraints)
    all_touched = len(touched) == len(atoms)
    name = "masses" if "masses" in atoms.arrays else "numbers"
    weighed = slice(None) if all_masses or all_touched else touched
    values = atoms.arrays[name][weighed]
    return Binding(
        motion=motion,
        given=held.constraints,
        touched=touched,
        all_touched=all_touched,
        weighed=weighed,
        n_atoms=len(atoms),
        mass_array=name,
        mass_values=values.copy(),
        mass_bytes=values.tobytes() if len(values) <= _SHORT else None,
        periodic=periodic,
        pbc=atoms.pbc.tobytes(),
        cell=atoms.cell.array.tobytes(),
        weights=_weights(motion) if all_touched else None,
    )


class _Recent(local):
    """Engines that were built last in this thread, each with the rows as they were given and what `degenerate` was."""

    def __init__(self) -> None:
        self.known: deque[tuple[tuple[Constraint, ...], str, Binding]] = deque(maxlen=RECENT)


_recent = _Recent()


def shared(given: Sequence[Constraint], atoms: Atoms, degenerate: Literal["convert", "raise"]) -> Binding:
    """An engine as `bind` gives it, or one that was built before for the same rows, masses and cell.

    Frames of a file need one engine together. Only rows whose engine depends on no positions have it in common: targets
    are given, nothing was converted to linear rows, and minimum images say all.
    """
    given = tuple(given)
    for rows, how, bound in _recent.known:
        same_cell = not bound.periodic or atoms.cell.array.tobytes() == bound.cell
        if how == degenerate and same_cell and bound.fits(atoms) and alike(rows, given):
            return bound
    bound = bind(given, atoms, degenerate)
    motion = bound.motion
    plain = motion.constraint_set.images is None and all(item.cell_offsets is None for item in bound.given)
    if plain and not motion.conversions and all(item.target is not None for item in given):
        _recent.known.append((given, degenerate, bound))
    return bound


def alike(one: Any, other: Any) -> bool:
    """Whether two values say the same: the same object, or numbers, words, arrays, rows and collections of such."""
    if one is other:
        return True
    if type(one) is not type(other):
        return False
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and np.array_equal(one, other)
    if isinstance(one, Constraint):
        return alike(vars(one), vars(other))
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(alike(value, other[name]) for name, value in one.items())
    if isinstance(one, list):
        with suppress(ValueError):  # of arrays in it
            return bool(one == other)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(alike, one, other))
    return isinstance(one, int | float | str | np.generic) and bool(one == other)


def holding(item: Any) -> Any:
    """What a constraint of ASE or kcons holds; nothing for those that only add forces."""
    own = item.__dict__
    rows = own.get("constraints")
    if rows is not None:  # of kcons, whose rows are never changed
        return rows
    if isinstance(item, FORCES_ONLY):
        return None
    return [own.get(name) for name in _HELD]


def company(present: Sequence[Any]) -> Company:
    """Constraints, each with what it holds now."""
    return tuple((item, holding(item) if hasattr(item, "engine") else deepcopy(holding(item))) for item in present)


def same_company(present: Sequence[Any], known: Company) -> bool:
    """Whether these are the same constraints, and hold what they held."""
    if len(present) != len(known):
        return False
    for item, (one, held) in zip(present, known, strict=True):
        if item is not one or ((now := holding(item)) is not held and not alike(now, held)):
            return False
    return True


def check_company(present: Sequence[Any], own: Any, bound: Binding) -> None:
    """Refuse ASE constraints that share atoms with `own`: ASE would apply them one after the other."""
    if same_company(present, bound.others):
        return
    for other in present:
        if other is own or isinstance(other, FORCES_ONLY):
            continue
        if type(other) is ase.constraints.FixCom and all(c.translation_invariant for c in bound.given):
            continue  # a common shift of all atoms changes no row
        shared = np.intersect1d(_acted_on(other, bound.n_atoms), bound.touched)
        if len(shared):
            raise UnsupportedError(
                f"{type(other).__name__} acts on atom {shared[0]}, which kcons holds too; ASE would apply the two "
                f"one after the other, and neither would hold. Put all of it into one Constraints object"
                f"{_REPLACEMENTS.get(type(other).__name__, '')}"
            )
    bound.others = company(present)


def _acted_on(other: Any, n_atoms: int) -> IntArray:
    """Atoms that an ASE constraint acts on; all where it does not say."""
    if isinstance(other, ase.constraints.FixedMode):  # its own get_indices names none
        return np.flatnonzero(other.mode.reshape(-1, 3).any(axis=1))
    if hasattr(other, "touched"):  # another object of kcons
        return np.asarray(other.touched)
    indices = other.get_indices() if hasattr(other, "get_indices") else slice(None)
    return np.arange(n_atoms)[indices]


_REPLACEMENTS = {
    **dict.fromkeys(
        ("Constraints", "ConstraintsWithFixedAtoms"),
        ": atoms.set_constraint(), then constrain(atoms, [*old.constraints, *new])",
    ),
    "FixAtoms": ", with FixedAtoms for what FixAtoms held",
    "FixBondLengths": ", with Distance for what FixBondLengths held",
    "FixInternals": ", with Distance, Angle, Dihedral and DistanceDifference for what FixInternals held",
    "FixLinearTriatomic": ", with Distance and LinearRelation for what FixLinearTriatomic held",
    "FixCom": ", with CenterOfMass for what FixCom held",
    "FixSubsetCom": ", with CenterOfMass for what FixSubsetCom held",
    "FixedPlane": ", with Plane for what FixedPlane held",
    "FixedLine": ", with Line for what FixedLine held",
    "FixCartesian": ", with LinearCombination for what FixCartesian held",
}


def touched_atoms(constraints: Sequence[Constraint]) -> IntArray:
    atoms = [c.atoms.ravel() for c in constraints]
    return np.unique(np.concatenate(atoms)) if atoms else np.zeros(0, dtype=np.int64)


def _weights(motion: Motion) -> tuple[FloatArray, FloatArray, FloatArray]:
    masses = np.repeat(motion.masses, 3).reshape(-1, 3)
    for item in motion.constraint_set.constraints:
        if item.fixes_atoms:
            masses[item.atoms.ravel()] = np.inf
    inverse_masses = 1.0 / masses
    masses[np.isinf(masses)] = 0.0
    return masses, inverse_masses, np.empty_like(masses)


def applied_forces(atoms: Atoms) -> FloatArray:
    """Forces of the calculator and of ASE objects that only add forces; a copy."""
    forces = np.array(numbers(atoms.get_forces(apply_constraint=False), "forces of the calculator"))
    if forces.shape == (len(atoms), 3):  # otherwise whoever asked complains
        for item in atoms.constraints:
            if isinstance(item, FORCES_ONLY):
                item.adjust_forces(atoms, forces)
    return forces


def applied_energy(atoms: Atoms, only_forces: bool) -> float:
    """The energy of which forces and stress are derivatives; with that of ASE objects where these add forces."""
    energy = float(atoms.get_potential_energy(apply_constraint=only_forces))
    found = getattr(atoms.calc, "results", {})
    free = found.get("free_energy")
    # Where electrons have a temperature, "energy" is extrapolated to zero; both may be infinite.
    if free is not None and "energy" in found and free != found["energy"]:
        energy += float(free - found["energy"])
    return energy


class Answers:
    """Calculators, their settings, and where each keeps what it found last: another object after other questions.

    A calculator whose settings were changed is reset: some of ASE forget to, and give what they found before.

    Parameters
    ----------
    atoms : ase.Atoms
    others : sequence of ASE calculator
        Besides that of the atoms.
    """

    def __init__(self, atoms: Atoms, others: Sequence[Any] = ()) -> None:
        self._atoms, self._others = atoms, others
        self.note()

    def note(self) -> None:
        """What there is now is known."""
        self._known = self._now()
        self._settings = [settings_of(each) for each in (self._atoms.calc, *self._others)]

    def _now(self) -> tuple[Any, ...]:
        calculators = (self._atoms.calc, *self._others)
        return (*calculators, *(getattr(each, "results", None) for each in calculators))

    def changed(self, last: State, force: Callable[[FloatArray, float], ArrayLike], step: int) -> bool:
        """Whether forces, if atoms are where they were in `last`, are others than these; asked for only in doubt."""
        calculators = (self._atoms.calc, *self._others)
        for each, before, settings in zip(calculators, self._known, self._settings, strict=False):
            if each is before and not same_settings(settings_of(each), settings):
                each.reset()
        now, known = self._now(), self._known
        if all(map(is_, now, known)):
            return False
        there = np.array_equal(self._atoms.arrays["positions"], last.positions)
        same = now[0] is known[0] and there
        with in_step(step):
            found = force(last.positions, last.time) if same else None
        self.note()
        return found is None or last.forces is None or not np.array_equal(np.asarray(found), last.forces)


def settings_of(calculator: Any) -> tuple[Any, ...]:
    """What a calculator can be told, as it is now; nothing where it cannot forget what it found before."""
    found = getattr(calculator, "parameters", None)
    return tuple(found.values()) if isinstance(found, dict) and hasattr(calculator, "reset") else ()


def same_settings(one: tuple[Any, ...], other: tuple[Any, ...]) -> bool:
    """Whether settings are the same objects, or equal ones."""
    return len(one) == len(other) and all(a is b or np.array_equal(a, b) for a, b in zip(one, other, strict=True))


@contextmanager
def in_step(number: int) -> Iterator[None]:
    """Errors are noted to belong to this step."""
    try:
        yield
    except Exception as error:
        name_step(error, number)
        raise


def name_step(error: BaseException, number: int) -> None:
    """Note in an error which step it belongs to."""
    if getattr(error, "step", None) is None:
        with suppress(AttributeError):
            error.step = number  # type: ignore[attr-defined]
        error.add_note(f"in step {number}; the atoms are as they were at the end of the last good step")


def surroundings(atoms: Atoms) -> tuple[bytes, ...]:
    """The cell, first, what calculators read of atoms beside their positions, and what ASE objects add to forces."""
    parts = [atoms.cell.array.tobytes(), atoms.pbc.tobytes()]
    parts += [atoms.arrays[name].tobytes() for name in _READ if name in atoms.arrays]
    parts += [repr(item.todict()).encode() for item in atoms.constraints if isinstance(item, FORCES_ONLY)]
    return tuple(parts)


def refuse_fewer(before: int, now: int, rows: Sequence[Constraint], friction: ArrayLike, stepper: Any) -> int:
    """Refuse fewer atoms than before where something was given by their numbers; returns how many there are now."""
    by_number = rows or np.ndim(friction) or getattr(stepper, "atoms", None) is not None
    if now < before and by_number:
        raise InputError(
            f"{before - now} of {before} atoms were removed, and constraints, friction or indices that the dynamics "
            "was given name atoms by their numbers, which are others now; make a new one",
            item="atoms",
        )
    return now
