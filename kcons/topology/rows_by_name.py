"""Rows by name from any topology: bonds with hydrogens, all bonds, angles, rigid water, rigid groups.

One function for all MD engines, so that MDAnalysis, ASE and OpenMM give the same rows, in the same order, for the same
system: bonds sorted by their atoms, angles by vertex and ends, water by residue, then rigid groups, then rows of one's
own. What is held is said by the same options in each of them, which are documented once.
"""

from __future__ import annotations

import inspect
import math
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, TypedDict, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints import Angle, Constraint, Dihedral, Distance, LinearRelation
from kcons.constraints.arguments import checked
from kcons.constraints.constraint import IntArray, constraints_in
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.periodic.one_piece import connected, lined_up
from kcons.errors import InputError, unknown
from kcons.topology.angle_rows import STRAIGHT, angle_rows
from kcons.topology.rigid_groups import (
    GEOMETRIES,
    WATER,
    VirtualSites,
    Waters,
    body_rows,
    find_waters,
    inside_bodies,
    listed_bodies,
    residue_bodies,
    water_rows,
)
from kcons.topology.topology import FAR, BoolArray, Snapshot, Topology, bond_angles, guess_bonds, reaches, sorted_pairs

#: No bond is that long, in angstrom, whatever its atoms.
TORN = 10.0
#: What can be held by name, and what that means.
CONSTRAIN: dict[str, str] = {
    "none": "no bonds",
    "hbonds": "bonds with a hydrogen",
    "allbonds": "all bonds",
    "hangles": "all bonds, and the angles H-X-H and H-O-X",
    "allangles": "all bonds and all angles",
}

#: Rows on a selection: gets the atoms, gives constraints.
RowMaker = Callable[[IntArray], Constraint]

F = TypeVar("F", bound=Callable[..., Any])


class Options(TypedDict, total=False):
    """Options of `Holding` beside `constrain`."""

    rigid_water: bool
    water_names: Iterable[str]
    water_geometry: str | tuple[float, float] | None
    rigid_residues: Iterable[str]
    rigid_bodies: Iterable[str | Sequence[int] | IntArray]
    angles: Literal["angles", "distances"]
    on: Mapping[Any, RowMaker] | Sequence[tuple[Any, RowMaker]] | None
    select: ArrayLike | str
    guess_bonds: bool | Literal["missing"]


@dataclass(frozen=True)
class Holding:
    """What is held of a system.

    Parameters
    ----------
    constrain : {'hbonds', 'allbonds', 'hangles', 'allangles', 'none'} or None
        Bonds with hydrogens; all bonds; these and the angles H-X-H and H-O-X; all bonds and angles. The first three
        are what they are in OpenMM. The rows of the last are independent: not every angle is one, and flat centers and
        rings have dihedrals, see `kcons.topology.angle_rows`.
    rigid_water : bool
        Hold water by three distances; found by residue name and composition. Sites without mass (TIP4P) are placed,
        not held: ``.virtual_sites``.
    water_names : iterable of str
        Residue names that are water besides the usual ones.
    water_geometry : str, (float, float) or None
        'tip3p', 'spc', ..., or O-H length in angstrom and H-O-H angle in degrees; None holds each molecule as it is.
    rigid_residues : iterable of str
        Names of residues held rigid, each by itself.
    rigid_bodies : iterable
        Lists of atoms (or selections in words for MDAnalysis), each held rigid as a whole.
    on : mapping or sequence of pairs, optional
        Rows on selections: selection -> callable that gets its atoms and gives a constraint, for example
        ``{"protein": CenterOfMass}`` for MDAnalysis, ``{(0, 1, 2): CenterOfMass}`` for the others.
    select : 'all', mask, atoms or str
        Rows are kept if all of their atoms are among these; `rigid_bodies` and `on` are not restricted. For MDAnalysis
        words or an AtomGroup, for the others masks and numbers of atoms.
    angles : {'angles', 'distances'}
        Angles as rows in radian, or as distances of their ends as in OpenMM.
    guess_bonds : bool or 'missing'
        'missing' guesses bonds of atoms without any, with a warning; False never; True all of them anew.
    """

    constrain: str | None = "hbonds"
    rigid_water: bool = True
    water_names: Iterable[str] = ()
    water_geometry: str | tuple[float, float] | None = None
    rigid_residues: Iterable[str] = ()
    rigid_bodies: Iterable[str | Sequence[int] | IntArray] = ()
    on: Mapping[Any, RowMaker] | Sequence[tuple[Any, RowMaker]] | None = None
    select: ArrayLike | str = "all"
    angles: Literal["angles", "distances"] = "angles"
    guess_bonds: bool | Literal["missing"] = "missing"

    def __post_init__(self) -> None:
        if self.kind not in CONSTRAIN:
            raise InputError(f"cannot constrain {unknown(str(self.constrain), CONSTRAIN)}", item="constrain")
        if not (self.kind != "none" or self.rigid_water or self.residues or self.bodies or self.on):
            raise InputError("nothing is to be held; name bonds, water, residues, bodies or rows", item="constrain")
        for entry in self.own_rows:
            if not (isinstance(entry, tuple | list) and len(entry) == 2 and callable(entry[1])):
                raise InputError(
                    f"on has {entry!r:.100}; give pairs of a selection and what gets its atoms and makes a constraint, "
                    "such as the class kcons.constraints.CenterOfMass itself",
                    item="on",
                )

    @property
    def kind(self) -> str:
        """What is held of bonds and angles, a key of `CONSTRAIN`."""
        return "none" if self.constrain is None else str(self.constrain).lower()

    @cached_property
    def residues(self) -> tuple[str, ...]:
        """Names of the residues that are held rigid."""
        return (self.rigid_residues,) if isinstance(self.rigid_residues, str) else tuple(self.rigid_residues)

    @cached_property
    def bodies(self) -> tuple[str | Sequence[int] | IntArray, ...]:
        """What is held rigid, as it was given."""
        one = isinstance(self.rigid_bodies, str) or hasattr(self.rigid_bodies, "atoms")  # words, or an AtomGroup
        return (self.rigid_bodies,) if one else tuple(self.rigid_bodies)  # type: ignore[return-value]

    @cached_property
    def own_rows(self) -> tuple[tuple[Any, RowMaker], ...]:
        """Selections and what makes rows of them."""
        return tuple(self.on.items() if isinstance(self.on, Mapping) else self.on or ())

    @property
    def waters(self) -> frozenset[str]:
        """Residue names that are rigid water, in capitals."""
        return WATER | {str(n).strip().upper() for n in self.water_names} if self.rigid_water else frozenset()

    def geometry(self) -> tuple[tuple[float, float] | None, float]:
        """O-H length (angstrom) and H-O-H angle (degrees) of water, None as found; O-M length of a named model."""
        given = self.water_geometry
        if given is None:
            return None, 0.0
        if isinstance(given, str):
            name = given.lower().replace("-", "").replace("/", "").replace("_", "")
            if name not in GEOMETRIES:
                remedy = "or give (O-H in angstrom, H-O-H in degrees)"
                raise InputError(f"no water model {unknown(given, GEOMETRIES)}; {remedy}", item="water_geometry")
            length, angle, site = GEOMETRIES[name]
            return (length, angle), site
        return water_geometry(given, "water_geometry"), 0.0


Holding.__init__ = checked(Holding.__init__)  # type: ignore[method-assign]


def water_geometry(given: Any, item: str) -> tuple[float, float]:
    """O-H length (angstrom) and H-O-H angle (degrees) that somebody gave."""
    try:
        length, angle = (float(v) for v in given)
    except (TypeError, ValueError):
        raise InputError(f"{item} is {given!r:.80}; give (O-H in angstrom, H-O-H in degrees)", item=item) from None
    if not (0 < length < math.inf and 60 < angle < 180):
        raise InputError(
            f"water of O-H {length:g} angstrom and H-O-H {angle:g} degrees: give a positive length, and an angle "
            "between 60 and 180 in degrees",
            item=item,
        )
    return length, angle


#: What functions with these options give and refuse.
_RETURNS = """

Returns
-------
HeldRows
    A list of constraints; ``.constraint_set`` has them as a set.

Raises
------
InputError
    Selections that match nothing, unknown names, no coordinates, masses, elements or bonds.

Warns
-----
UserWarning
    If bonds were guessed without being asked for, or not for all hydrogens."""


def with_options(function: F) -> F:
    """Write the options of `Holding`, and what comes back, into documentation and signature of a function.

    They take the place of ``**options``, which ends the docstring of the function.
    """
    signature = inspect.signature(function)
    own = [p for p in signature.parameters.values() if p.kind is not p.VAR_KEYWORD]
    options = inspect.signature(Holding).parameters.values()
    more = [p.replace(kind=p.KEYWORD_ONLY) for p in options if p.name not in signature.parameters]
    function.__signature__ = signature.replace(parameters=[*own, *more])  # type: ignore[attr-defined]
    if function.__doc__ and Holding.__doc__:  # python -OO has none
        described = inspect.cleandoc(Holding.__doc__).partition("----------\n")[2] + _RETURNS
        function.__doc__ = inspect.cleandoc(function.__doc__).replace("**options", described, 1)
    return function


class HeldRows(list[Constraint]):
    """A list of constraints that knows the system they were made for.

    Attributes
    ----------
    snapshot : Snapshot
        Topology, positions, cell.
    constraint_set : ConstraintSet
        The same rows as a set, targets bound.
    virtual_sites : VirtualSites
        Massless sites of rigid water; they are placed, not held.
    bonds_guessed : int
        How many bonds did not come with the topology.
    loose_hydrogens : ndarray of int
        Hydrogens for which no bond was found where bonds were guessed; nothing holds them.
    """

    def __init__(
        self,
        constraint_set: ConstraintSet,
        snapshot: Snapshot,
        virtual_sites: VirtualSites,
        bonds_guessed: int = 0,
        loose_hydrogens: ArrayLike = (),
    ) -> None:
        super().__init__(constraint_set.constraints)
        self.constraint_set = constraint_set
        self.snapshot = snapshot
        self.virtual_sites = virtual_sites
        self.bonds_guessed = bonds_guessed
        self.loose_hydrogens: IntArray = np.array(loose_hydrogens, dtype=np.int64)

    @property
    def topology(self) -> Topology:
        return self.snapshot.topology

    def require_atoms(self, n: int, indices: IntArray | None, host: str) -> None:
        """Refuse these rows for another system or part of it; `indices`, `host` as of a `Snapshot`."""
        mine = self.snapshot
        remedy = "make them for the same atoms: constraints_of(group), with the group that is given here"
        if mine.topology.n_atoms != n:
            raise InputError(
                f"the rows were made for {mine.topology.n_atoms} atoms, and there are {n} here; {remedy}",
                item="constraints",
            )
        # Numbers in different files say nothing about each other.
        if mine.indices is None or indices is None or mine.host != host:
            return
        differ = np.flatnonzero(mine.indices != indices)
        if len(differ):
            k = int(differ[0])
            raise InputError(
                f"the rows were made for other atoms: their atom {k} is atom {mine.indices[k]} of the Universe, and "
                f"here it is atom {indices[k]}; {remedy}",
                item="constraints",
                atoms=[k],
            )

    def row_name(self, row: int) -> str:
        """For example '#7 Distance: OW of SOL 12 (atom 33), HW1 of SOL 12 (atom 34)'."""
        item, _ = self.constraint_set.locate(row)
        atoms = ", ".join(self.topology.atom_name(int(a)) for a in self.constraint_set.row_atoms(row)[:4])
        return f"#{row} {item.family}: {atoms}"

    def summary(self) -> str:
        """For example '2,798 Distance, 12 LinearRelation; 2,810 rows on 3,000 atoms'."""
        counts: dict[str, int] = {}
        for item in self:
            counts[item.family] = counts.get(item.family, 0) + item.n_rows
        kinds = ", ".join(f"{n:,} {family}" for family, n in counts.items())
        return f"{kinds}; {self.constraint_set.n_rows:,} rows on {len(self.constraint_set.touched):,} atoms"

    def __repr__(self) -> str:
        return f"<HeldRows: {self.summary()}>"


def rows_of(snapshot: Snapshot, holding: Holding, numbers: Callable[[Any], IntArray], remedy: str) -> HeldRows:
    """Rows that hold what is named; to be called where users call.

    Parameters
    ----------
    snapshot : Snapshot
    holding : Holding
        What is held.
    numbers : callable
        Gets what stands in `holding` as a selection, gives atoms as numbers or as a mask.
    remedy : str
        What the error about missing bonds recommends.

    Returns
    -------
    HeldRows
        Targets are those of the positions, where none are given. Errors and warnings are those of `with_options`.
    """
    kind, topology = holding.kind, snapshot.topology
    geometry, _ = holding.geometry()
    selected = np.full(topology.n_atoms, isinstance(holding.select, str) and holding.select == "all")
    if not selected.all():
        selected[numbers(holding.select)] = True
    # Words, and AtomGroups.
    bodies = [numbers(b) if isinstance(b, str) or hasattr(b, "atoms") else b for b in holding.bodies]
    snapshot, waters, guessed = _with_waters(snapshot, holding, remedy)
    waters = waters.among(selected)
    groups = [g[selected[g].all(axis=1)] for g in residue_bodies(snapshot, holding.residues)]
    # Rigid residues that are rigid water are held as water.
    groups = [g[~np.isin(g, waters.triples[:, 0]).any(axis=1)] for g in groups]
    groups = [g for g in groups if len(g)] + listed_bodies(snapshot, bodies)
    _refuse_torn(snapshot, waters.triples[:, [[0, 1], [0, 2]]].reshape(-1, 2))
    # Some force fields list the H-H of water as a bond; it is not one.
    bonds = snapshot.topology.bonds
    bonds = bonds[~_closing(bonds, topology.hydrogen)]
    _refuse_torn(snapshot, bonds[inside_bodies(snapshot.topology.n_atoms, bonds, groups)])
    rigid = [waters.triples, *groups]
    rows = [] if kind == "none" else _internal(snapshot, kind, bonds, rigid, selected, holding.angles)
    if len(waters.triples):
        rows.append(water_rows(waters.triples, geometry, snapshot.angstrom))
    rows += body_rows(snapshot, groups)
    own = [row for key, make in holding.own_rows for row in constraints_in(make(numbers(key)), "on")]
    rows = [item for item in (*rows, *own) if item.n_rows]
    if not rows:
        raise InputError(_nothing(snapshot.topology, kind, selected), item="constrain")
    _check_masses(snapshot.topology, rows)
    held = ConstraintSet(
        rows, snapshot.positions, snapshot.topology.masses, cell=snapshot.cell, pbc=snapshot.pbc.tolist()
    )
    if guessed and holding.guess_bonds == "missing":
        warnings.warn(
            f"{guessed} bonds were guessed from distances and covalent radii, since the {snapshot.host or 'topology'} "
            f"does not have them; {remedy}, or pass guess_bonds=True to accept them, guess_bonds=False to refuse",
            stacklevel=3,
        )
    loose = _loose_hydrogens(snapshot.topology, holding, selected)
    if len(loose):
        cell = "" if snapshot.lattice is not None else "give the cell, at whose faces molecules may be cut, or "
        warnings.warn(
            f"no bond was guessed for {len(loose)} hydrogens, the first of which is "
            f"{snapshot.topology.atom_name(int(loose[0]))}: nothing holds them; {cell}{remedy}",
            stacklevel=3,
        )
    return HeldRows(held, snapshot, waters.sites, guessed, loose)


# -- bonds ----------------------------------------------------------------------------------------


def _with_waters(snapshot: Snapshot, holding: Holding, remedy: str) -> tuple[Snapshot, Waters, int]:
    """The snapshot with the bonds that are needed, its rigid water, and how many bonds are guessed."""
    nowhere = np.zeros(snapshot.topology.n_atoms, dtype=bool)
    guess, named = holding.guess_bonds, holding.kind != "none"
    geometry, model_site = holding.geometry()
    if not snapshot.topology.residues_known:
        # Molecules take the place of residues, and bonds make molecules.
        guessed = 0
        if named or holding.rigid_water or holding.residues:
            snapshot, guessed = _with_bonds(snapshot, guess, remedy, nowhere)
        snapshot = replace(snapshot, topology=snapshot.topology.with_molecules())
        return snapshot, find_waters(snapshot, holding.waters, model_site, geometry), guessed
    waters = find_waters(snapshot, holding.waters, model_site, geometry)
    if not named:
        return snapshot, waters, 0
    # The bonds of rigid water are known; guessing them would take most of the time.
    if len(waters.triples):
        both = np.concatenate([snapshot.topology.bonds, waters.triples[:, [[0, 1], [0, 2]]].reshape(-1, 2)])
        snapshot = replace(snapshot, topology=snapshot.topology.with_bonds(both))
    nowhere[waters.triples] = nowhere[waters.sites.sites] = True
    snapshot, guessed = _with_bonds(snapshot, guess, remedy, nowhere)
    return snapshot, waters, guessed


def _with_bonds(snapshot: Snapshot, guess: bool | str, remedy: str, settled: BoolArray) -> tuple[Snapshot, int]:
    """The snapshot with bonds, and how many of them are guessed; `settled` atoms have theirs."""
    topology = snapshot.topology
    bonded = settled.copy()
    bonded[topology.bonds] = True
    size = np.bincount(topology.residues, minlength=topology.n_residues)[topology.residues]
    # Ions and united atoms have no bonds, hydrogens always have.
    lacking = ~bonded & (topology.elements != "")
    if topology.residues_known:
        lacking &= size > 1
    if guess is not True and not lacking.any():
        return snapshot, 0
    if guess is False:
        atom = int(np.argmax(lacking))
        others = f", nor have {int(lacking.sum()) - 1} others" if lacking.sum() > 1 else ""
        where = f"the {snapshot.host}" if snapshot.host else "the topology"
        raise InputError(
            f"{where} has no bonds of {topology.atom_name(atom)}{others}; {remedy}, or let them be guessed "
            "(guess_bonds='missing')",
            item="bonds",
            atoms=[atom],
        )
    known = topology.bonds[settled[topology.bonds].any(axis=1)] if guess is True else topology.bonds
    found = guess_bonds(snapshot, ~settled if guess is True else lacking, ~settled)
    both = sorted_pairs(np.concatenate([known, found]))
    return replace(snapshot, topology=replace(topology, bonds=both)), len(both) - len(known)


def _loose_hydrogens(topology: Topology, holding: Holding, selected: BoolArray) -> IntArray:
    """Hydrogens that were looked for bonds, and have none; ions of their own residue are not."""
    if holding.kind == "none" and (topology.residues_known or not holding.rigid_water):
        return np.zeros(0, np.int64)
    loose = topology.hydrogen & selected
    loose[topology.bonds] = False
    if topology.residues_known:
        loose &= np.bincount(topology.residues, minlength=topology.n_residues)[topology.residues] > 1
    return np.flatnonzero(loose)


# -- bonds and angles as rows -----------------------------------------------------------------------


def _internal(
    snapshot: Snapshot, kind: str, bonds: IntArray, rigid: Sequence[IntArray], selected: BoolArray, angles: str
) -> list[Constraint]:
    """Bonds, angles, and linear rows for straight angles, outside of rigid groups."""
    topology, hydrogen = snapshot.topology, snapshot.topology.hydrogen
    massless = (topology.masses == 0) & (topology.elements == "")
    bonds = bonds[~massless[bonds].any(axis=1)]
    held = bonds[hydrogen[bonds].any(axis=1)] if kind == "hbonds" else bonds
    held = held[selected[held].all(axis=1)]
    held = held[~inside_bodies(topology.n_atoms, held, rigid)]
    _refuse_torn(snapshot, held)
    rows: list[Constraint] = [Distance(held)]
    if kind in ("hbonds", "allbonds"):
        return rows
    quads = np.zeros((0, 4), np.int64)
    if kind == "hangles":
        triples = bond_angles(bonds, topology.n_atoms)
        ends = hydrogen[triples[:, 0]].astype(int) + hydrogen[triples[:, 2]]
        triples = triples[(ends == 2) | ((ends == 1) & (topology.elements[triples[:, 1]] == "O"))]
        triples = triples[selected[triples].all(axis=1)]
    else:
        triples, quads = angle_rows(snapshot, bonds[selected[bonds].all(axis=1)], rigid)
        quads = quads[~inside_bodies(topology.n_atoms, quads, rigid)]
    triples = triples[~inside_bodies(topology.n_atoms, triples, rigid)]
    if angles == "distances":
        return [*rows, Distance(np.sort(triples[:, [0, 2]], axis=1)), Dihedral(quads)]
    r = lined_up(snapshot.positions[triples], snapshot.lattice)
    value = Angle(triples).measure(r, 0.0)
    straight = value > np.radians(STRAIGHT)
    rows.append(Angle(triples[~straight]))
    if straight.any():
        # At 180 degrees an angle is singular: the vertex divides the line between its neighbors.
        arms = np.linalg.norm(np.diff(r[straight], axis=1), axis=2)
        weights = arms[:, ::-1] / arms.sum(axis=1, keepdims=True)
        i, j, k = triples[straight].T
        rows.append(LinearRelation(j, np.stack([i, k], axis=1), weights))
        # One length of a line gives all others: that of an arm in a rigid group, or of the first arm.
        code = [topology.n_atoms, 1]
        arms, number = np.unique(np.sort(triples[straight][:, [[0, 1], [1, 2]]], axis=2) @ code, return_inverse=True)
        line, order = connected(number.reshape(-1, 2), len(arms))[0], np.argsort(np.isin(arms, held @ code))
        one = order[np.unique(line[order], return_index=True)[1]]
        rows[0] = Distance(held[~np.isin(held @ code, np.delete(arms, one))])
    return [*rows, Dihedral(quads)]


def _closing(bonds: IntArray, hydrogen: BoolArray) -> BoolArray:
    """Bonds between two hydrogens that have other bonds."""
    degree = np.bincount(bonds.ravel(), minlength=len(hydrogen))
    return np.asarray(np.all(hydrogen[bonds] & (degree[bonds] > 1), axis=1))


# -- checks ---------------------------------------------------------------------------------------


def _refuse_torn(snapshot: Snapshot, bonds: IntArray) -> None:
    """Raise `InputError` for bonds that are too long for their atoms, or longer than any bond."""
    long, radii = reaches(snapshot, bonds)
    torn = long > np.minimum(TORN, FAR * radii)
    if torn.any():
        k = int(np.argmax(np.where(torn, long, 0.0)))
        i, j = bonds[k].tolist()
        name = snapshot.topology.atom_name
        raise InputError(
            f"{name(i)} and {name(j)} are bonded and {long[k]:.3g} angstrom apart; give the periodic cell, or make "
            "molecules whole that are cut at its edge; or bonds and coordinates are of different systems, or of "
            "another order of atoms",
            item="positions",
            atoms=[i, j],
        )


def _check_masses(topology: Topology, rows: Sequence[Constraint]) -> None:
    used = np.concatenate([item.atoms.ravel() for item in rows if not item.fixes_atoms] or [np.zeros(0, int)])
    used = used[used < topology.n_atoms]
    bad = used[~(topology.masses[used] > 0)]
    if len(bad):
        atom = int(bad.min())
        count = len(np.unique(bad))
        raise InputError(
            f"{topology.atom_name(atom)} has no mass"
            + (f", as {count - 1} other atoms" if count > 1 else "")
            + "; held atoms need masses: give a topology with masses or elements, or set them",
            item="masses",
            atoms=[atom],
        )


def _nothing(topology: Topology, kind: str, selected: BoolArray) -> str:
    if not selected.all():
        return f"nothing to hold within the selection of {int(selected.sum())} atoms ({CONSTRAIN[kind]}); widen it"
    if kind == "hbonds" and not topology.hydrogen.any():
        return "nothing to hold: there are no hydrogens; add them to the file, or hold all bonds (allbonds)"
    if kind == "none":
        return "nothing to hold: there is no water that would be rigid; name bonds, such as hbonds"
    return f"nothing to hold: found no water, and {CONSTRAIN[kind]} are none; give a file that has them (PDB: CONECT)"
