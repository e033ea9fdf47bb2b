"""The constraint object for ASE."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import ase.constraints
import numpy as np
from ase import Atoms
from ase.constraints.constraint import FixConstraint
from numpy.typing import NDArray

import kcons.constraints as families
from kcons.constraint_set import ConstraintSet
from kcons.constraints import Constraint
from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.diagnosis import Report
from kcons.errors import ConvergenceError, InputError, KconsError, UnsupportedError
from kcons.motion import Motion

__all__ = ["Constraints", "constrain"]

#: Name in ASE's registry and in files.
REGISTERED_NAME = "KconsConstraints"

#: How far positions may be off a row (relative to its scale) when ASE first moves them.
START_TOLERANCE = 1e-6

#: Arrays up to this length are compared fastest as bytes.
_SHORT = 4096

#: Families whose target is an absolute position: replicas take theirs from where they are.
_PLACED = ("FixedAtoms", "LinearCombination", "LinearRelation", "CenterOfMass", "Plane", "Line")

#: ASE objects that only add forces, so that they get along with any constraint.
_FORCES_ONLY = (ase.constraints.Hookean, ase.constraints.ExternalForce)


@dataclass
class _Binding:
    """The engine for one set of masses and one cell, and what it takes to see that these changed."""

    motion: Motion
    touched: IntArray
    all_touched: bool
    n_atoms: int
    mass_array: str
    mass_values: NDArray[Any]
    mass_bytes: bytes | None  # the same, for short arrays
    periodic: bool
    pbc: bytes
    cell: bytes
    #: m and 1/m (0 for fixed atoms) for each component, and room for velocities; None if only some atoms are held.
    weights: tuple[FloatArray, FloatArray, FloatArray] | None
    others: tuple[Any, ...] = ()

    def fits(self, atoms: Atoms) -> bool:
        """Whether number of atoms, cell, periodicity and masses are still the same."""
        # Every hook comes through here: compare bytes, which costs a fraction of a microsecond, and build nothing.
        arrays = atoms.arrays
        if len(arrays["positions"]) != self.n_atoms or atoms.pbc.tobytes() != self.pbc:
            return False
        if self.periodic and atoms.cell.array.tobytes() != self.cell:
            return False
        name = "masses" if "masses" in arrays else "numbers"
        if name != self.mass_array:
            return False
        values = arrays[name] if self.all_touched else arrays[name][self.touched]
        if self.mass_bytes is not None:
            return bool(values.tobytes() == self.mass_bytes)
        return bool((values == self.mass_values).all())


class Constraints(FixConstraint):
    """Everything that is held on one `Atoms` object.

    Attach it with ``atoms.set_constraint(Constraints([...]))``, or with `constrain`, which also checks the
    positions at once. Targets that are left open are taken from the positions when the object first
    meets its atoms, and are kept from then on: copies, slices, pickles and files carry them.

    The engine is built at the first use, and again if masses, cell or the number of atoms change.

    Parameters
    ----------
    constraints : sequence of Constraint
        What is held (or the plain data that `todict` writes). Fixed atoms belong here too, as
        `FixedAtoms`.
    degenerate : {'convert', 'raise'}
        What to do about rows that are singular to first order, such as three distances in a collinear
        triatomic: hold the same with linear rows, or refuse.
    repeated : optional
        Set in files that were written between `repeat` and the first use; not for people.

    Raises
    ------
    UnsupportedError
        At the first use: a target that moves with time, or a velocity constraint. ASE tells constraints
        neither the time nor the time step; use `kcons.steppers` for these.

    Notes
    -----
    Under ASE's VelocityVerlet this is RATTLE: positions by the SHAKE condition with the multipliers along
    the gradients of the old positions, momenta by the mass-metric projection. ASE itself forms the
    velocities from the difference of positions, which loses accuracy far from the origin.
    """

    def __init__(
        self,
        constraints: Constraint | Iterable[Constraint | Mapping[str, Any]] = (),
        *,
        degenerate: Literal["convert", "raise"] = "convert",
        repeated: tuple[Sequence[int], int] | None = None,
    ) -> None:
        if isinstance(constraints, Constraint):
            constraints = (constraints,)
        self.constraints: tuple[Constraint, ...] = tuple(
            families.from_dict(item) if isinstance(item, Mapping) else item for item in constraints
        )
        for item in self.constraints:
            if not isinstance(item, Constraint):
                raise InputError(
                    f"{item!r} is no kcons constraint; from_ase_constraints translates those of ASE", item="constraints"
                )
        if degenerate not in ("convert", "raise"):
            raise InputError(f"degenerate must be 'convert' or 'raise', not {degenerate!r}", item="degenerate")
        self.degenerate = degenerate
        self._repeated: tuple[tuple[int, int, int], int] | None = None
        if repeated is not None:
            (a, b, c), n = repeated
            self._repeated = ((a, b, c), n)
        self._binding: _Binding | None = None
        self._on_surface = False

    # -- the engine -----------------------------------------------------------------------------

    def engine(self, atoms: Atoms) -> Motion:
        """The engine for `atoms` as they are now; built if needed.

        Raises
        ------
        InputError, ConstraintError
            If the constraints do not fit these atoms.
        UnsupportedError
            If another ASE constraint acts on the same atoms, or a row needs the time.
        """
        return self._bound(atoms).motion

    def _bound(self, atoms: Atoms) -> _Binding:
        bound = self._binding
        if bound is None or not bound.fits(atoms):
            bound = self._bind(atoms)
        present = atoms.constraints
        if len(present) > 1 and not _same(present, bound.others):
            self._check_others(present, bound)
        return bound

    def _bind(self, atoms: Atoms) -> _Binding:
        given = self._repaired(atoms) if self._repeated is not None else self.constraints
        for item in given:
            if item.moving or not item.holonomic:
                what = "moves with time" if item.holonomic else "constrains velocities"
                raise UnsupportedError(
                    f"{item!r} {what}; ASE's dynamics give constraints neither time nor time step. "
                    "Use kcons.steppers (System, Rattle, run) for it"
                )
        periodic = bool(atoms.pbc.any())
        held = ConstraintSet(
            given,
            atoms.arrays["positions"],
            atoms.get_masses(),
            cell=atoms.cell.array if periodic else None,
            pbc=atoms.pbc,
        )
        motion = Motion(held, atoms.arrays["positions"], degenerate=self.degenerate)
        touched = _touched(held.constraints)
        all_touched = len(touched) == len(atoms)
        name = "masses" if "masses" in atoms.arrays else "numbers"
        values = atoms.arrays[name] if all_touched else atoms.arrays[name][touched]
        bound = _Binding(
            motion=motion,
            touched=touched,
            all_touched=all_touched,
            n_atoms=len(atoms),
            mass_array=name,
            mass_values=values.copy(),
            mass_bytes=values.tobytes() if len(values) <= _SHORT else None,
            periodic=periodic,
            pbc=atoms.pbc.tobytes(),
            cell=atoms.cell.array.tobytes(),
            weights=_weights(motion) if all_touched else None,
        )
        self.constraints = held.constraints
        self._repeated = None
        self._binding = bound
        self._on_surface = False
        return bound

    def _check_others(self, present: Sequence[Any], bound: _Binding) -> None:
        """Refuse company that ASE would apply one after the other with this object."""
        for other in present:
            if other is self or isinstance(other, _FORCES_ONLY):
                continue
            if type(other) is ase.constraints.FixCom and all(c.translation_invariant for c in self.constraints):
                continue  # a common shift of all atoms changes no row
            indices = other.get_indices() if hasattr(other, "get_indices") else np.arange(bound.n_atoms)
            shared = np.intersect1d(np.arange(bound.n_atoms)[indices], bound.touched)
            if len(shared):
                raise UnsupportedError(
                    f"{type(other).__name__} acts on atom {shared[0]}, which kcons holds too; ASE would apply the two "
                    f"one after the other, and neither would hold. Put all of it into one Constraints object"
                    f"{_REPLACEMENTS.get(type(other).__name__, '')}"
                )
        bound.others = tuple(present)

    def _require_on_surface(self, bound: _Binding, x: FloatArray) -> None:
        held = bound.motion.constraint_set
        miss = np.abs(held.value(x))
        allowed = np.maximum(START_TOLERANCE * held.scale, 4 * held.tolerance(x))
        if not np.all(miss <= allowed):
            row = int(np.argmax(miss / allowed))
            raise InputError(
                f"atoms are off row {held.row_name(row)} by {miss[row]:.6g} (held at {held.target()[row]:.6g}); moving "
                "them from there would turn the correction into velocity. Use constrain(..., project=True) or "
                "Constraints.restore(atoms) first",
                item="positions",
                atoms=held.row_atoms(row),
            )
        self._on_surface = True

    # -- ASE's hooks ----------------------------------------------------------------------------

    def adjust_positions(self, atoms: Atoms, new: FloatArray) -> None:
        """Correct `new` in place, along the gradients at ``atoms.positions``; unchanged if that fails."""
        bound = self._bound(atoms)
        old = atoms.arrays["positions"]
        if not self._on_surface:
            self._require_on_surface(bound, old)
        try:
            if new.flags.c_contiguous and new.dtype == np.float64:
                bound.motion.project_positions(new, old, out=new)
            else:
                new[...] = bound.motion.project_positions(new, old)
        except ConvergenceError as error:
            error.add_note(
                "In ASE: a smaller timestep or maxstep; or, if the atoms were placed anew, atoms.positions[:] = ... "
                "followed by Constraints.restore(atoms)"
            )
            raise

    def adjust_momenta(self, atoms: Atoms, momenta: FloatArray) -> None:
        """Remove in place the part of the momenta that leaves the constraints: A M^-1 p = 0."""
        bound = self._bound(atoms)
        if bound.weights is None or momenta.shape != bound.weights[0].shape:
            # The same for momenta and forces: p - A^T (A M^-1 A^T)^-1 A M^-1 p.
            self._project_covector(atoms, momenta)
            return
        masses, inverse_masses, velocities = bound.weights
        np.multiply(momenta, inverse_masses, velocities)
        bound.motion.project_velocities(atoms.arrays["positions"], velocities, out=velocities)
        np.multiply(velocities, masses, momenta)

    def adjust_forces(self, atoms: Atoms, forces: FloatArray) -> None:
        """Add the constraint force for b = 0 in place; any float dtype, positions may be off the surface."""
        self._project_covector(atoms, forces)

    def _project_covector(self, atoms: Atoms, values: FloatArray) -> None:
        motion = self._bound(atoms).motion
        x = atoms.arrays["positions"]
        if values.flags.c_contiguous and values.dtype == np.float64:
            motion.project_forces(x, values, out=values)
        else:
            values[...] = motion.project_forces(x, values)

    def get_removed_dof(self, atoms: Atoms) -> int:
        """The rank of the rows, which may be less than their number."""
        return self._bound(atoms).motion.rank

    def get_indices(self) -> IntArray:
        """All atoms that some row touches."""
        return _touched(self.constraints)

    def index_shuffle(self, atoms: Atoms, ind: Any) -> None:
        """Keep the rows whose atoms are all in the slice `ind`, renumbered.

        Raises
        ------
        IndexError
            If no row is left; ASE then drops the object.
        """
        if self._repeated is not None:
            self._bind(atoms)
        n = len(atoms)
        old = np.arange(n)[ind]
        new_index = np.full(n, -1, dtype=np.int64)
        new_index[old] = np.arange(len(old))
        kept = []
        for item in self.constraints:
            inside = np.flatnonzero((new_index[item.atoms] >= 0).all(axis=1))
            if len(inside):
                kept.append((item if len(inside) == item.n_rows else item.select(inside)).renumbered(new_index))
        if not kept:
            raise IndexError("no constraint lies within the slice")
        self.constraints = tuple(kept)
        self._binding = None

    def repeat(self, m: int | Sequence[int], n: int) -> Constraints:
        """Hold all replicas of a cell of `n` atoms repeated `m` times; changes and returns this object.

        Rows across a periodic boundary are paired with the right replica at the next use.

        Raises
        ------
        UnsupportedError
            For surfaces and other rows with a place in space, of which ASE does not say where the
            replicas lie.
        """
        times = (m, m, m) if isinstance(m, int | np.integer) else (int(m[0]), int(m[1]), int(m[2]))
        if self._repeated is not None:
            raise UnsupportedError("repeated twice before the first use; repeat once, by the product of the numbers")
        copies = times[0] * times[1] * times[2]
        result = []
        for item in self.constraints:
            if not item.translation_invariant and item.family not in _PLACED:
                raise UnsupportedError(
                    f"{item!r} has a place in space and cannot be repeated; remove it with atoms.set_constraint() "
                    "and add one for each replica afterwards"
                )
            tiled = item.select(np.tile(np.arange(item.n_rows), copies))
            tiled.atoms = tiled.atoms + n * np.repeat(np.arange(copies), item.n_rows)[:, None]
            result.append(tiled if item.translation_invariant else tiled.with_target(None))
        self.constraints = tuple(result)
        self._repeated = (times, int(n))
        self._binding = None
        return self

    def _repaired(self, atoms: Atoms) -> tuple[Constraint, ...]:
        """Rows of a repeated cell, those across its old boundary led to the neighbouring replica."""
        assert self._repeated is not None
        times, n = self._repeated
        if not atoms.pbc.any() or len(atoms) < n * times[0] * times[1] * times[2]:
            return self.constraints
        x = atoms.arrays["positions"]
        cell = atoms.cell.array / np.array(times)[:, None]
        lattice = ConstraintSet((), np.zeros((0, 3)), np.zeros(0), cell=cell, pbc=atoms.pbc).lattice
        assert lattice is not None
        result = []
        for item in self.constraints:
            if item.translation_invariant and item.width > 1:
                replica, base = np.divmod(item.atoms, n)
                place = np.stack(np.unravel_index(replica, times), axis=-1)
                steps = -np.round(np.diff(x[item.atoms], axis=1) @ lattice[1]).astype(np.int64)
                place[:, 1:] = (place[:, 1:] + np.cumsum(steps, axis=1)) % np.array(times)
                item = item.with_target(item.target)
                item.atoms = np.ravel_multi_index(tuple(np.moveaxis(place, -1, 0)), times) * n + base
            result.append(item)
        return tuple(result)

    # -- copies and files -----------------------------------------------------------------------

    def copy(self) -> Constraints:
        """Independent copy with the same targets."""
        # Calculators copy the atoms at every step, so this is quick. Neither the rows nor an engine ever change;
        # each object takes a new engine where it needs one.
        twin = object.__new__(Constraints)
        twin.__dict__.update(self.__dict__)
        twin._on_surface = False
        return twin

    def __deepcopy__(self, memo: dict[int, Any]) -> Constraints:
        return self.copy()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_binding": None, "_on_surface": False}

    @property
    def todict(self) -> Callable[[], dict[str, Any]]:  # type: ignore[override]
        """``todict()`` gives {'name', 'kwargs'} for `ase.constraints.dict2constraint`, targets included.

        Missing (with a warning) if a row holds a Python function: ASE then writes its files without this
        object instead of failing.
        """
        try:
            rows = [item.todict() for item in self.constraints]
        except InputError as error:
            warnings.warn(f"constraints are left out of the file: {error}", stacklevel=3)
            raise AttributeError(f"todict: {error}") from None
        kwargs: dict[str, Any] = {"constraints": rows, "degenerate": self.degenerate}
        if self._repeated is not None:
            kwargs["repeated"] = [list(self._repeated[0]), self._repeated[1]]
        return lambda: {"name": REGISTERED_NAME, "kwargs": kwargs}

    def __repr__(self) -> str:
        return f"Constraints({sum(c.n_rows for c in self.constraints)} rows on {len(self.get_indices())} atoms)"

    # -- for people -----------------------------------------------------------------------------

    def restore(self, atoms: Atoms) -> None:
        """Move atoms that are off the constraints onto them, and project their momenta if they have any.

        The nearest point in the mass metric; for starts and edited structures, not for time steps.

        Raises
        ------
        InfeasibleError
            If there is no way to fulfil the constraints from here; nothing is changed.
        """
        bound = self._bound(atoms)
        x = bound.motion.restore_positions(atoms.arrays["positions"])
        momenta = None
        if "momenta" in atoms.arrays:
            momenta = bound.motion.project_forces(x, atoms.arrays["momenta"])
        atoms.set_positions(x, apply_constraint=False)
        if momenta is not None:
            atoms.set_momenta(momenta, apply_constraint=False)

    def report(self, atoms: Atoms) -> Report:
        """Rows, rank, degrees of freedom, residuals and solvers at the present positions and velocities."""
        velocities = atoms.get_velocities() if "momenta" in atoms.arrays else None
        return self.engine(atoms).report(atoms.arrays["positions"], velocities)


def constrain(
    atoms: Atoms,
    constraints: Constraint | Iterable[Constraint],
    *,
    project: bool = False,
    degenerate: Literal["convert", "raise"] = "convert",
) -> Constraints:
    """Hold `constraints` on `atoms` from now on, checked at once.

    ASE constraints that are on the atoms already stay if they act on other atoms. Momenta, if there are
    any, are projected onto the constraints.

    Parameters
    ----------
    atoms : ase.Atoms
    constraints : sequence of Constraint
        Targets left open are taken from the positions.
    project : bool
        Whether to move atoms that are off their explicit targets onto them (the nearest point in the mass
        metric) instead of raising.
    degenerate : {'convert', 'raise'}
        See `Constraints`.

    Returns
    -------
    Constraints
        The object that is now in ``atoms.constraints``.

    Raises
    ------
    InputError
        Positions off an explicit target while `project` is False; unknown atoms, bad masses, ...
    UnsupportedError
        Another ASE constraint acts on the same atoms.
    """
    held = Constraints(constraints, degenerate=degenerate)
    before = list(atoms.constraints)
    atoms.set_constraint([*before, held])
    try:
        if project:
            held.restore(atoms)
        bound = held._bound(atoms)
        held._require_on_surface(bound, atoms.arrays["positions"])
        if "momenta" in atoms.arrays:
            atoms.set_momenta(atoms.arrays["momenta"])
    except KconsError:
        atoms.set_constraint(before)
        raise
    return held


_REPLACEMENTS = {
    "FixAtoms": ", with FixedAtoms for what FixAtoms held",
    "FixBondLengths": ", with Distance for what FixBondLengths held",
    "FixInternals": ", with Distance, Angle and Dihedral for what FixInternals held",
    "FixLinearTriatomic": ", with Distance and LinearRelation for what FixLinearTriatomic held",
    "FixCom": ", with CenterOfMass for what FixCom held",
    "FixSubsetCom": ", with CenterOfMass for what FixSubsetCom held",
    "FixedPlane": ", with Plane for what FixedPlane held",
    "FixedLine": ", with Line for what FixedLine held",
    "FixCartesian": ", with LinearCombination for what FixCartesian held",
}


def _touched(constraints: Sequence[Constraint]) -> IntArray:
    atoms = [c.atoms.ravel() for c in constraints]
    return np.unique(np.concatenate(atoms)) if atoms else np.zeros(0, dtype=np.int64)


def _weights(motion: Motion) -> tuple[FloatArray, FloatArray, FloatArray]:
    masses = np.repeat(motion.masses, 3).reshape(-1, 3)
    for item in motion.constraint_set.constraints:
        if item.family == "FixedAtoms":
            masses[item.atoms.ravel()] = np.inf
    inverse_masses = 1.0 / masses
    masses[np.isinf(masses)] = 0.0
    return masses, inverse_masses, np.empty_like(masses)


def _same(present: Sequence[Any], known: Sequence[Any]) -> bool:
    return len(present) == len(known) and all(a is b for a, b in zip(present, known, strict=True))


def _register() -> None:
    if REGISTERED_NAME not in ase.constraints.__all__:
        ase.constraints.__all__.append(REGISTERED_NAME)
    setattr(ase.constraints, REGISTERED_NAME, Constraints)


_register()
