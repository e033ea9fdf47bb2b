"""The constraint object for ASE, and a calculator that gives the forces that are left on the constraints."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping
from operator import is_
from typing import Any
from weakref import ref

import ase.constraints
import numpy as np
from ase import Atoms
from ase.calculators.calculator import Calculator, PropertyNotImplementedError, all_changes
from ase.constraints import FixAtoms, FixConstraint
from numpy.typing import ArrayLike, NDArray

import kcons.constraints as families
from kcons.ase.binding import (
    ELSEWHERE,
    FAR,
    FORCES_ONLY,
    IN_TURN,
    START_TOLERANCE,
    UNKNOWN,
    VOIGT,
    AcceptedPositions,
    Binding,
    bind,
    check_company,
    fulfilled,
    read_by_engine,
    refuse_not_finite,
    refuse_taken_along,
    stress_of_rows,
    touched_atoms,
    unchanged_on_failure,
    with_added,
)
from kcons.ase.topology import REMEDY, bonds_of, require_atoms, snapshot_of, velocities_of
from kcons.ase.translation import ase_forms, translated
from kcons.constraints import Constraint
from kcons.constraints.arguments import as_float_array
from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.errors import CertificateError, ConvergenceError, InputError, UnsupportedError
from kcons.motion.certificate import CHECK_EVERY
from kcons.motion.motion import Motion
from kcons.motion.report import Report
from kcons.thermostats.cells import constraint_virial
from kcons.topology.rows_by_name import Holding, rows_of

#: Name in ASE's registry and in files.
REGISTERED_NAME = "KconsConstraints"
#: Residual, in units of what double precision can reach, up to which positions are taken as they are.
_ON_SURFACE = 4.0


class Constraints(FixConstraint):
    """Everything that is held on one `Atoms` object.

    Attach it with ``atoms.set_constraint(Constraints([...]))``, or with `constrain`, which also checks the
    positions at once. Targets that are left open are taken from the positions when the object first
    meets its atoms, and are kept from then on: copies, slices, pickles and files carry them.

    The engine is built at the first use, and again if masses, cell or the number of atoms change. Under ASE's
    VelocityVerlet this is RATTLE; velocities from differences of positions lose accuracy far from the origin.

    Parameters
    ----------
    constraints : sequence of Constraint
        What is held (or the plain data that `todict` writes). Fixed atoms belong here too, as
        `FixedAtoms`.

    Raises
    ------
    UnsupportedError
        At the first use: a target that moves with time, or a velocity constraint; `ConstrainedDynamics` takes these.
    """

    def __init__(self, constraints: Constraint | Iterable[Constraint | Mapping[str, Any]] = ()) -> None:
        self._binding: Binding | None = None
        self.constraints = listed(constraints)
        #: Whether the engine is this object's; copies share one while all are in its cell.
        self._own = False
        #: The atoms that the positions known of belong to; one object may be on several.
        self._last: ref[Atoms] | None = None
        self._accepted = UNKNOWN

    @property
    def constraints(self) -> tuple[Constraint, ...]:
        """What is held."""
        return self.__dict__["constraints"]  # type: ignore[no-any-return]

    @constraints.setter
    def constraints(self, rows: tuple[Constraint, ...]) -> None:
        self.__dict__["constraints"], self._binding = rows, None
        fixed = any(item.fixes_atoms and item.n_rows for item in rows)
        self.__class__ = ConstraintsWithFixedAtoms if fixed else Constraints  # type: ignore[assignment]

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

    def _bound(self, atoms: Atoms) -> Binding:
        if self._last is None or self._last() is not atoms:
            self._last = ref(atoms)
            self._accepted = AcceptedPositions(len(atoms))
        bound, cell = self._binding, atoms.cell.array
        if bound is None or bound.made_for != read_by_engine(atoms):
            _refuse_moving(self.constraints)
            bound = bind(self.constraints, atoms)
            self._accepted = AcceptedPositions(len(atoms))
            self.constraints, self._binding, self._own = bound.given, bound, True
        elif bound.cell != cell.tobytes():
            bound = self._in_cell(atoms, cell, bound)
        if len(atoms.constraints) > 1:
            check_company(self._present(atoms), self, bound)
        return bound

    def _present(self, atoms: Atoms) -> list[Any]:
        """Constraints on the atoms, this object in the place of its copy: rows of a database ask one for the other."""
        present: list[Any] = atoms.constraints
        alike = (isinstance(item, Constraints) and np.array_equal(item.touched, self.touched) for item in present)
        return present if self in present else [self if own else item for own, item in zip(alike, present, strict=True)]

    def _in_cell(self, atoms: Atoms, cell: FloatArray, bound: Binding) -> Binding:
        """The engine, which knows the cell; an `InputError` leaves it as it was."""
        if not self._own and cell.tobytes() != bound.cell and bound.periodic:
            bound = self._binding = bind(self.constraints, atoms)
            self._own = True
        bound.follow_cell(atoms, cell)
        return bound

    # -- ASE's hooks ----------------------------------------------------------------------------

    def adjust_positions(self, atoms: Atoms, new: FloatArray) -> None:
        """Correct `new` in place, along the gradients at ``atoms.positions``; unchanged if that fails.

        A frame that fulfills the constraints already, and to which these gradients need not lead, is taken as it is.

        Raises
        ------
        InputError
            The atoms were moved past the constraints before; see `restore`.
        UnsupportedError
            They were moved along with the cell, where a row holds them in space.
        """
        with IN_TURN:
            bound, accepted = self._bound(atoms), self._accepted
            x = bound.kernel_array(new, "position")
            motion, old, cell = bound.motion, atoms.arrays["positions"], bound.cell
            found = accepted.ask(motion.constraint_set, old, x)
            if found & FAR and np.isfinite(x).all() and fulfilled(motion.constraint_set, x):
                motion.project_positions(x, accepted.asked, out=x)
            else:
                try:
                    if found & ELSEWHERE or accepted.in_another(cell):
                        accepted.look(motion, old, cell, elsewhere=True)
                    accepted.between_steps = False
                    motion.project_positions(x, old, out=x)
                except (ConvergenceError, InputError, UnsupportedError) as error:
                    refuse_not_finite(x, "position")
                    if isinstance(error, ConvergenceError):
                        error.add_note("In ASE: a smaller timestep, maxstep, or dr of BasinHopping")
                    raise
            if accepted.positions_due <= 0:
                try:
                    motion.certify(x)
                except CertificateError:
                    x[...] = accepted.asked
                    raise
                accepted.positions_due = CHECK_EVERY
            accepted.positions_due -= 1
            accepted.accept(x, cell)
            if x is not new:
                new[...] = x

    def redistribute_forces_md(self, atoms: Atoms, forces: FloatArray, rand: bool = False) -> None:
        """Leave forces of dynamics, and noise, as they are; put atoms right that were scaled together with the cell.

        ASE asks for these forces before it makes a step from the positions: later on, velocities would be made of what
        is put right.

        Raises
        ------
        InputError
            The atoms were moved past the constraints in another way; see `restore`.
        """
        if rand or not self._accepted.in_another(atoms.cell.array.tobytes()):
            return  # other edits are seen where positions are set
        with IN_TURN:
            bound, accepted = self._bound(atoms), self._accepted
            x = atoms.arrays["positions"]
            if not accepted.look(bound.motion, x, bound.cell):
                try:
                    self._move(atoms, bound, bound.motion.project_positions(x, x))
                except ConvergenceError as error:
                    error.add_note("The atoms were scaled together with the cell: call Constraints.restore(atoms)")
                    raise

    def adjust_momenta(self, atoms: Atoms, momenta: FloatArray) -> None:
        """Remove in place the part of the momenta that leaves the constraints: A M^-1 p = 0.

        Raises
        ------
        InputError
            The atoms are off the constraints, or were moved past them since the last step; see `restore`.
        UnsupportedError
            They were moved within a step, or as if nothing was held; or an ExternalForce would add to momenta, too.
        """
        with IN_TURN:
            bound, accepted = self._bound(atoms), self._accepted
            p, due = bound.kernel_array(momenta, "momentum"), accepted.momenta_due <= 0
            for item in atoms.constraints:
                if isinstance(item, FORCES_ONLY) and type(item).adjust_momenta is FixConstraint.adjust_momenta:
                    raise UnsupportedError(
                        f"ASE adds the force of {type(item).__name__} to all momenta that are set, in its own dynamics "
                        "at each step; take draw_velocities and a dynamics class of kcons.ase, which do not"
                    )
            accepted.look(bound.motion, atoms.arrays["positions"], bound.cell)
            accepted.note_momenta()
            left = bound.momenta_on_surface(atoms, p, certified=due)
            accepted.momenta_due = CHECK_EVERY - 1 if due else accepted.momenta_due - 1
            if left is not momenta:
                np.copyto(momenta, left, casting="unsafe")  # integers are all 0

    def adjust_stress(self, atoms: Atoms, stress: FloatArray) -> None:
        """Add the constraints' part in place, Voigt order: -(1/V) sum of r (x) z over the rows.

        z is the instantaneous constraint force at the present positions, momenta and forces, so that
        ``get_stress(include_ideal_gas=True)`` is the full pressure (an ideal gas of rigid molecules gives N k T / V).
        Without momenta, or where they are zero, it is the static part, which makes the stress the derivative of the
        energy under a strain after which the constraints are restored. Rows with a place in space count as external
        forces and have no part. Refused where atoms or momenta leave the constraints, or objects of ASE add forces.
        """
        with IN_TURN:
            bound, x, v = self._bound(atoms), atoms.arrays["positions"], velocities_of(atoms)
            added = stress_of_rows(bound.motion, atoms, v)
            if np.abs(bound.motion.project_velocities(x, v) - v).max(initial=0.0) > START_TOLERANCE:
                raise UnsupportedError(
                    "momenta leave the constraints, as where cell filters move atoms that have those of a run, whose "
                    "constraint forces are in the stress; to relax atoms: atoms.set_momenta(np.zeros((len(atoms), 3)))"
                )
            stress += added
            self._accepted.know(x, bound.cell)  # cell filters scale them next

    def adjust_cell(self, atoms: Atoms, cell: Any) -> None:
        """Refuse a cell in which a row would be longer than half the box, before ASE takes it; changes nothing."""
        with IN_TURN:
            if self._binding is not None and self._binding.made_for == read_by_engine(atoms):
                self._in_cell(atoms, as_float_array(cell, "cell"), self._binding)

    def adjust_forces(self, atoms: Atoms, forces: FloatArray) -> None:
        """Add the constraint force for b = 0 in place, also for forces that later objects add; any float dtype."""
        with IN_TURN:
            bound = self._bound(atoms)
            f, added = bound.kernel_array(forces, "force"), None
            if len(atoms.constraints) > 1:
                present = self._present(atoms)
                later = present[present.index(self) + 1 :] if self in present else ()
                added = with_added(atoms, np.zeros_like(f), later) if later else None
            f = f if added is None else f + added
            bound.projected(atoms.arrays["positions"], f, "force", f)
            f = f if added is None else f - added
            if f is not forces:
                np.copyto(forces, f, casting="unsafe")
            self._accepted.between_steps = True

    def get_removed_dof(self, atoms: Atoms) -> int:
        """The rank of the rows, which may be less than their number."""
        with IN_TURN:
            return self._bound(atoms).motion.rank

    @property
    def touched(self) -> IntArray:
        """All atoms that some row touches."""
        return touched_atoms(self.constraints)

    def get_indices(self) -> IntArray:
        """All atoms that some row touches; of `ConstraintsWithFixedAtoms` the fixed ones."""
        return self.touched

    def index_shuffle(self, atoms: Atoms, ind: Any) -> None:
        """Keep the rows whose atoms are all in the slice `ind`, renumbered.

        Raises
        ------
        IndexError
            If no row is left; ASE then drops the object.
        InputError
            An atom is taken twice.
        """
        taken = np.arange(len(atoms))[ind]
        kept = self._within(taken, len(atoms))
        if not kept:
            raise IndexError("no constraint lies within the slice")
        if len(np.unique(taken)) < len(taken):
            raise InputError("atoms are taken twice; take constraints off first: atoms.set_constraint()", item="index")
        self.constraints = kept

    def _within(self, atoms: IntArray, n_atoms: int) -> tuple[Constraint, ...]:
        """The rows all of whose atoms are among `atoms`, of n_atoms, renumbered in their order."""
        new_index = np.full(n_atoms, -1, dtype=np.int64)
        new_index[atoms] = np.arange(len(atoms))
        kept = []
        for item in self.constraints:
            inside = np.flatnonzero((new_index[item.atoms] >= 0).all(axis=1))
            if len(inside):
                kept.append((item if len(inside) == item.n_rows else item.select(inside)).renumbered(new_index))
        return tuple(kept)

    def repeat(self, m: Any, n: int) -> Constraints:
        """Refuse replicas of a cell: atoms of a row may be in different ones."""
        raise UnsupportedError(
            f"{self!r} cannot be repeated; take the constraints off with atoms.set_constraint() (after *=, which has "
            "copied atoms by now, of atoms made anew), and hold the rows of all replicas afterwards"
        )

    # -- copies and files -----------------------------------------------------------------------

    def copy(self) -> Constraints:
        """Independent copy with the same targets."""
        # Calculators copy the atoms at every step, so this is quick. Rows never change, and of an engine only the cell;
        # each object takes a new engine where it needs one.
        twin = object.__new__(type(self))
        twin.__dict__ = {**self.__dict__, "_own": False, "_last": None, "_accepted": UNKNOWN}
        return twin

    def __deepcopy__(self, memo: dict[int, Any]) -> Constraints:
        return self.copy()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_binding": None, "_last": None, "_accepted": UNKNOWN}

    @property
    def todict(self) -> Callable[[], dict[str, Any]]:  # type: ignore[override]
        """``todict()`` gives {'name', 'kwargs'} for `ase.constraints.dict2constraint`, targets included.

        Where one object of ASE holds the same, these name that object, so that files open without kcons; see `attach`.

        Missing (with a warning) if a row holds a Python function: ASE then writes its files without this
        object instead of failing.
        """
        try:
            rows = [item.todict() for item in self.constraints if item.n_rows]
        except InputError as error:
            warnings.warn(f"constraints are left out of the file: {error}", stacklevel=3)
            raise AttributeError(f"todict: {error}") from None
        forms, left = ase_forms(self.constraints)
        # ASE counts rows as they are given, also those that depend on others.
        bound, given = self._binding, sum(item.n_rows for item in self.constraints)
        if len(forms) == 1 and not left and (bound is None or bound.motion.rank == given):
            return lambda: forms[0]
        return lambda: {"name": REGISTERED_NAME, "kwargs": {"constraints": rows}}

    def __repr__(self) -> str:
        converted = self._binding.motion.conversions if self._binding is not None else ()
        what = f"; {len(converted)} groups converted to linear rows, the first: {converted[0]}" if converted else ""
        return f"Constraints({sum(c.n_rows for c in self.constraints)} rows on {len(self.touched)} atoms{what})"

    # -- for people -----------------------------------------------------------------------------

    def restore(self, atoms: Atoms, bonds: ArrayLike | None = None) -> None:
        """Move atoms that are off the constraints onto them, and project their momenta if they have any.

        Near starts go to the nearest point in the mass metric. Where that would change other bonds or angles, and for
        far targets, groups move as rigid pieces: see `Motion.restore_positions`. For starts and edited structures, not
        for time steps.

        Parameters
        ----------
        atoms : ase.Atoms
        bonds : array_like of int, shape (n, 2), optional
            Those that stay as they are; by default ``atoms.info['bonds']``, otherwise they are guessed from covalent
            radii. Empty: the nearest point, whatever becomes of what no row holds.

        Raises
        ------
        InfeasibleError
            If there is no way to fulfil the constraints from here with other bonds and angles as they are; nothing is
            changed.
        """
        with IN_TURN:
            bound = self._bound(atoms)
            kept = (lambda: bonds_of(atoms)) if bonds is None else bonds
            self._move(atoms, bound, bound.motion.restore_positions(atoms.arrays["positions"], bonds=kept))
            self._binding = None  # which rows are independent is seen there anew

    def _move(self, atoms: Atoms, bound: Binding, x: FloatArray) -> None:
        """Put atoms where they are on the constraints, and project momenta that they have."""
        momenta = bound.motion.project_forces(x, atoms.arrays["momenta"]) if "momenta" in atoms.arrays else None
        atoms.set_positions(x, apply_constraint=False)
        if momenta is not None:
            atoms.set_momenta(momenta, apply_constraint=False)
        self._accepted.know(x, bound.cell)
        self._accepted.between_steps = True

    def report(self, atoms: Atoms) -> Report:
        """Rows, rank, degrees of freedom, residuals and solvers at the present positions and velocities."""
        velocities = velocities_of(atoms) if "momenta" in atoms.arrays else None
        return self.engine(atoms).report(atoms.arrays["positions"], velocities)


class ConstraintsWithFixedAtoms(Constraints, FixAtoms):
    """`Constraints` that hold fixed atoms: to ASE and others a `FixAtoms` of these, too.

    So files that know fixed atoms have them (POSCAR, FHI-aims, Turbomole, extxyz, ...), and programs that ask for
    `FixAtoms` and its `index`. `Constraints` become this, and cease to be, by what they hold. ``del atoms[i]`` keeps
    the rows whose atoms all stay, as slices do.
    """

    @property
    def index(self) -> IntArray:  # type: ignore[override]
        """The fixed atoms, in ascending order; with a warning where other rows are held, of which they tell nothing."""
        others = sum(item.n_rows for item in self.constraints if not item.fixes_atoms)
        if others:
            warnings.warn(
                f"only the fixed atoms are passed on: a file of this format does not have the other {others} rows, and "
                "a program that asks (Sella) does not hold them; give it kcons.ase.to_ase_constraints(atoms)",
                stacklevel=2,
            )
        return self.get_indices()

    def get_indices(self) -> IntArray:
        """The fixed atoms, in ascending order."""
        return touched_atoms([item for item in self.constraints if item.fixes_atoms])

    def delete_atoms(self, indices: Any, natoms: int) -> Constraints | None:
        """Keep the rows whose atoms all stay, renumbered; None if there are none."""
        self.constraints = self._within(np.delete(np.arange(natoms), indices), natoms)
        return self if self.constraints else None


def listed(constraints: Constraint | Iterable[Constraint | Mapping[str, Any]]) -> tuple[Constraint, ...]:
    """Constraints, those that are given as plain data made anew."""
    several = isinstance(constraints, Iterable) and not isinstance(constraints, str)
    given: Any = constraints if several else (constraints,)
    result = tuple(families.from_dict(item) if isinstance(item, Mapping) else item for item in given)
    for item in result:
        if not isinstance(item, Constraint):
            raise InputError(
                f"{item!r} is no kcons constraint; from_ase_constraints(atoms) gives those of ASE as a list, "
                "constraints_of(atoms, name) those of a name, and the attribute constraints those of a Constraints "
                "object. Put a list into a list by *: [*rows, FixedAtoms([0])]",
                item="constraints",
            )
    return result


def _refuse_moving(given: Iterable[Constraint]) -> None:
    """Raise `UnsupportedError` for what needs the time, or the time step."""
    for item in given:
        if item.moving or not item.holonomic:
            what = "moves with time" if item.holonomic else "constrains velocities"
            raise UnsupportedError(
                f"{item!r} {what}; ASE's own dynamics give constraints neither time nor time step. Give it to "
                "kcons.ase.ConstrainedDynamics(atoms, timestep, constraints=[...]), or use kcons.steppers"
            )


def constrain(
    atoms: Atoms,
    constraints: str | Constraint | Iterable[Constraint],
    *,
    project: bool = False,
) -> Constraints:
    """Hold `constraints` on `atoms` from now on, checked at once.

    ASE constraints that are on the atoms already stay if they act on other atoms. Momenta, if there are
    any, are projected onto the constraints.

    Parameters
    ----------
    atoms : ase.Atoms
    constraints : sequence of Constraint, or 'hbonds', 'allbonds', 'hangles', 'allangles'
        Targets left open are taken from the positions. A name stands for ``constraints_of(atoms, name)``, which has
        options.
    project : bool
        Whether to move atoms that are off their explicit targets onto them instead of raising; see
        `Constraints.restore`.

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
    require_atoms(atoms)
    if isinstance(constraints, str):  # not by `constraints_of`, since its caller is where warnings point
        constraints = rows_of(snapshot_of(atoms), Holding(constraints), np.array, REMEDY)
    held = Constraints(constraints)
    with unchanged_on_failure(atoms):
        atoms.set_constraint([*atoms.constraints, held])
        if project:
            held.restore(atoms)
        bound, accepted = held._bound(atoms), held._accepted
        accepted.look(bound.motion, atoms.arrays["positions"], bound.cell)
        accepted.between_steps = True
        if "momenta" in atoms.arrays:
            momenta = bound.kernel_array(atoms.get_momenta(), "momentum")
            atoms.set_momenta(bound.momenta_on_surface(atoms, momenta, certified=True), apply_constraint=False)
    return held


def to_ase_constraints(atoms: Atoms) -> list[FixConstraint]:
    """Objects of ASE that hold what the constraints of kcons on `atoms` hold, for programs that know ASE's alone.

    Fixed atoms become FixAtoms; distances FixBondLengths, or with their differences, angles and dihedrals FixInternals;
    planes and lines FixedPlane and FixedLine; single components FixCartesian; centers of mass FixSubsetCom. Other
    objects on the atoms are taken as they are. The atoms are not changed::

        plain = atoms.copy()
        plain.set_constraint(to_ase_constraints(atoms))

    ASE applies objects one after another: where they share atoms, its own dynamics and optimizers keep neither.

    Parameters
    ----------
    atoms : ase.Atoms

    Raises
    ------
    UnsupportedError
        Rows that no object of ASE holds, named.
    """
    require_atoms(atoms)
    result: list[FixConstraint] = []
    for item in atoms.constraints:
        if not isinstance(item, Constraints):
            result.append(item.copy())
            continue
        item.engine(atoms)  # settles targets that are open
        forms, left = ase_forms(item.constraints)
        if left:
            raise UnsupportedError(f"no object of ASE holds {left[0]!r}; keep the constraints of kcons")
        result += [ase.constraints.dict2constraint(form) for form in forms]
    return result


def attach(atoms: Atoms) -> Constraints:
    """Put one object of kcons in the place of all constraint objects on `atoms`, which holds what they hold.

    For atoms that were read from a file, which has an object of ASE where one holds the same.

    Parameters
    ----------
    atoms : ase.Atoms
        Positions and momenta stay as they are. Objects that only add forces (Hookean, ExternalForce) stay, too.

    Returns
    -------
    Constraints
        The object that is now in ``atoms.constraints``. Targets that a file did not tell are taken from the positions
        at its first use.

    Raises
    ------
    UnsupportedError
        An object that has no counterpart in kcons, named; nothing is changed.
    """
    require_atoms(atoms)
    others = [item for item in atoms.constraints if isinstance(item, FORCES_ONLY)]
    held = Constraints(translated(atoms, [item for item in atoms.constraints if not isinstance(item, FORCES_ONLY)]))
    atoms.set_constraint([held, *others])
    return held


class ConstrainedCalculator(Calculator):
    """Energies and forces of another calculator on the constraints.

    On the constraints, forces are f + z with b = 0 (no momenta enter: ASE caches by positions) and everything else
    is the inner calculator's. Positions off the constraints are first brought onto them along the rows' gradients
    there, in the mass metric. So the energy is a function of the constrained motions alone, and finite differences of
    forces (`Vibrations`, `Phonons`) give its Hessian *on* the constraints, with zeros along held directions.

    Stress is as of `Constraints.adjust_stress`, and per-atom properties are passed on.

    For optimizers, saddle searches and phonons; for dynamics take `constrain` or `ConstrainedDynamics`.

    Parameters
    ----------
    inner : ase calculator
    constraints : Constraints or sequence of Constraint
        Targets that are open are taken from the positions at the first calculation. Rows must not depend on
        time or velocities.

    Raises
    ------
    UnsupportedError
        At the first use: rows that need time or velocities.
    ConvergenceError
        Positions from which the constraints cannot be reached.
    """

    def __init__(self, inner: Any, constraints: Constraints | Constraint | Iterable[Constraint]) -> None:
        super().__init__()
        if not hasattr(inner, "get_property"):
            raise InputError(f"inner is {inner!r:.80}; give a calculator of ASE, such as atoms.calc", item="inner")
        self.inner = inner
        self.constraints = (constraints if isinstance(constraints, Constraints) else Constraints(constraints)).copy()
        #: What the results belong to, beside the atoms.
        self._known = self._asked()
        #: Positions and cell at which stress was asked for last.
        self._stressed: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None

    def _asked(self) -> tuple[Any, ...]:
        """What gives the results, and where the inner calculator keeps what it found: another object after a reset."""
        return self.inner, self.constraints, getattr(self.inner, "results", None)

    @property
    def implemented_properties(self) -> list[str]:  # type: ignore[override]
        """Those of the inner calculator."""
        return list(self.inner.implemented_properties)

    def check_state(self, atoms: Atoms, tol: float = 1e-15) -> list[str]:
        """What has changed since the last calculation: also masses, which share out forces, and settings."""
        changes = list(super().check_state(atoms, tol))
        if self.atoms is not None and not np.array_equal(self.atoms.get_masses(), atoms.get_masses()):
            changes.append("masses")
        if not all(map(is_, self._asked(), self._known)):
            changes.append("inner")
        return changes

    def calculate(
        self,
        atoms: Atoms | None = None,
        properties: Iterable[str] = ("energy", "forces"),
        system_changes: Iterable[str] = all_changes,
    ) -> None:
        """Fill `results`; called by ASE where its cache does not hold the properties."""
        super().calculate(atoms, list(properties), list(system_changes))
        assert self.atoms is not None
        work = self.atoms.copy()
        work.set_constraint()  # the inner calculator need not know of them: others write them into their input
        motion, x = self.constraints.engine(work), work.arrays["positions"]
        held = motion.constraint_set
        if "stress" in properties:
            before, self._stressed = self._stressed, (x.copy(), work.cell.array.copy())
            if before is not None:
                refuse_taken_along(motion, *before, *self._stressed)
        with IN_TURN:
            if held.n_rows and not np.all(np.abs(held.value(x)) <= _ON_SURFACE * held.tolerance(x)):
                motion.project_positions(x, x.copy(), out=x)
        wanted = {*properties, "forces"} if "stress" in properties else {*properties}
        found = {name: self.inner.get_property(name, work) for name in sorted(wanted)}
        known = getattr(self.inner, "results", {})  # of the same place, as what was asked for
        found = {name: known[name] for name in ("energy", "free_energy", "forces") if name in known} | found
        missing = [name for name, value in found.items() if value is None]
        if missing:
            raise PropertyNotImplementedError(f"{type(self.inner).__name__} has no {', '.join(missing)}")
        if "forces" in found:
            forces = as_float_array(found["forces"], "forces of the calculator")
            if "stress" in found:
                stress = as_float_array(found["stress"], "stress of the calculator")
                with IN_TURN:
                    virial = constraint_virial(motion, x, np.zeros_like(x), forces)
                stress = stress[VOIGT] if stress.shape == (3, 3) else stress
                found["stress"] = stress - virial[VOIGT] / work.get_volume()
            found["forces"] = forces.copy()
            self.constraints.adjust_forces(work, found["forces"])
        self.results |= found
        self._known = self._asked()

    def restore(self, atoms: Atoms) -> None:
        """Move `atoms` to the point on the constraints that energy and forces belong to."""
        x = atoms.get_positions()
        atoms.set_positions(self.constraints.engine(atoms).project_positions(x, x), apply_constraint=False)


# So that ASE's readers make this object again.
if REGISTERED_NAME not in ase.constraints.__all__:
    ase.constraints.__all__.append(REGISTERED_NAME)
setattr(ase.constraints, REGISTERED_NAME, Constraints)
