"""The engine for one `Atoms`, and the tests whether it still fits."""

from __future__ import annotations

import pickle
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from math import isfinite
from typing import Any

import ase.constraints
import numpy as np
from ase import Atoms
from numpy.typing import NDArray

from kcons.constraints import Constraint
from kcons.constraints.arguments import as_float_array
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, UnsupportedError
from kcons.motion.motion import Motion

#: What objects of ASE hold, by the names of their attributes.
_HELD = "index", "mask", "dir", "pairs", "bondlengths", "triples", "bonds", "angles", "dihedrals", "bondcombos"

#: ASE objects that only add forces, so that they get along with any constraint.
FORCES_ONLY = (ase.constraints.Hookean, ase.constraints.ExternalForce)

_PLURAL = {"position": "positions", "momentum": "momenta", "force": "forces"}
_FLOAT = np.dtype(np.float64)


@dataclass
class Binding:
    """The engine for one set of masses and one cell, with copies that show when these have changed."""

    motion: Motion
    given: tuple[Constraint, ...]
    made_for: tuple[Any, ...]
    periodic: bool
    cell: bytes
    #: m and 1/m (0 for fixed atoms) for each component, and room for velocities; None if only some atoms are held.
    weights: tuple[FloatArray, FloatArray, FloatArray] | None
    #: Other constraints on the atoms, and what these held when they were looked at.
    others: tuple[Any, ...] = ()

    def fits(self, atoms: Atoms) -> bool:
        """Whether number of atoms, periodicity and masses are still the same."""
        return _read_by_engine(atoms) == self.made_for

    def follow_cell(self, atoms: Atoms, cell: FloatArray) -> None:
        """Let the engine know the cell, if it has changed; an `InputError` leaves it as it was."""
        content = cell.tobytes()
        if self.periodic and content != self.cell:
            self.motion.set_cell(cell, atoms.pbc, atoms.arrays["positions"])
            self.cell = content

    def kernel_array(self, values: NDArray[Any], what: str) -> FloatArray:
        """The array itself where kernels can write to it, else a copy; refused where the engine would not see it.

        That are integers, and numbers of atoms that no row holds and that are not finite.
        """
        array = values
        if values.dtype is not _FLOAT or not values.flags.c_contiguous:
            # The answer is written into `values`, which would cut it; that for momenta and forces of 0 is 0.
            if values.dtype.kind in "biu" and (what == "position" or values.any()):
                raise InputError(
                    f"{_PLURAL[what]} are integers ({values.dtype}), which cannot hold what the constraints leave of "
                    "them; give floats, for example array.astype(float)",
                    item=what,
                )
            array = np.array(values, np.float64, order="C")
        wanted = (self.motion.n_atoms, 3)
        if array.shape != wanted:
            raise InputError(f"{_PLURAL[what]} must have shape {wanted}, not {array.shape}", item=what)
        if self.weights is None and not isfinite(np.vdot(array, array)):
            refuse_not_finite(array, what)
        return array


def _read_by_engine(atoms: Atoms) -> tuple[Any, ...]:
    """What an engine is made of besides rows and cell; every hook asks: bytes, compared in part of a microsecond."""
    arrays = atoms.arrays
    name = "masses" if "masses" in arrays else "numbers"
    return len(arrays["positions"]), atoms.pbc.tobytes(), name, arrays[name].tobytes()


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
        made_for=_read_by_engine(atoms),
        periodic=periodic,
        cell=atoms.cell.array.tobytes(),
        weights=_weights(motion) if len(held.touched) == len(atoms) else None,
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
                "one after the other, and neither would hold. Put all of it into one Constraints object: attach(atoms) "
                "does so for what is on the atoms; for new rows, held = from_ase_constraints(atoms), "
                "atoms.set_constraint(), constrain(atoms, [*held, *new])"
            )
    bound.others = now


def _acted_on(other: Any, n_atoms: int) -> IntArray:
    """Atoms that an ASE constraint acts on; all where it does not say."""
    if isinstance(other, ase.constraints.FixedMode):  # its own get_indices names none
        return np.flatnonzero(other.mode.reshape(-1, 3).any(axis=1))
    if hasattr(other, "touched"):  # another object of kcons
        return np.asarray(other.touched)
    indices = other.get_indices() if hasattr(other, "get_indices") else slice(None)
    return np.arange(n_atoms)[indices]


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
    return with_added(atoms, atoms.get_forces(apply_constraint=False))


def with_added(atoms: Atoms, given: Any) -> FloatArray:
    """Forces of a calculator and of ASE objects that only add forces; a copy."""
    forces = np.array(as_float_array(given, "forces of the calculator"))
    if forces.shape == (len(atoms), 3):  # otherwise whoever asked complains
        for item in atoms.constraints:
            if isinstance(item, FORCES_ONLY):
                item.adjust_forces(atoms, forces)
    return forces
