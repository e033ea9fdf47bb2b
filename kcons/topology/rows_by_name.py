"""Rows by name from any topology: bonds with hydrogens, all bonds, angles, rigid water, rigid groups.

One function for all hosts, so that MDAnalysis, ASE and OpenMM give the same rows, in the same order, for the same
system: bonds sorted by their atoms, angles by vertex and ends, water by residue, then rigid groups, then rows of one's
own.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from kcons.constraints import Angle, Constraint, Distance, LinearRelation
from kcons.constraints.constraint import IntArray
from kcons.constraints.constraint_set import ConstraintSet
from kcons.errors import InputError
from kcons.topology.guessed_bonds import guess_bonds
from kcons.topology.rigid_groups import (
    FLAT,
    GEOMETRIES,
    WATER,
    body_rows,
    find_waters,
    inside_bodies,
    listed_bodies,
    residue_bodies,
)
from kcons.topology.topology import BoolArray, Snapshot, Topology, bond_angles, near_misses, sorted_pairs
from kcons.topology.virtual_sites import VirtualSites
from kcons.topology.whole_molecules import minimum_image

#: What can be held by name, and what that means.
CONSTRAIN: dict[str, str] = {
    "none": "no bonds",
    "hbonds": "bonds with a hydrogen",
    "allbonds": "all bonds",
    "hangles": "all bonds, and the angles H-X-H and H-O-X",
    "allangles": "all bonds and all angles",
}
#: Beyond this an angle is held by a linear row, in degrees.
STRAIGHT = 179.0
#: No bond is that long, in angstrom.
TORN = 10.0

#: Rows on a selection: gets the atoms, gives constraints.
RowMaker = Callable[[IntArray], Constraint]


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
    """

    def __init__(
        self, constraint_set: ConstraintSet, snapshot: Snapshot, virtual_sites: VirtualSites, bonds_guessed: int = 0
    ) -> None:
        super().__init__(constraint_set.constraints)
        self.constraint_set = constraint_set
        self.snapshot = snapshot
        self.virtual_sites = virtual_sites
        self.bonds_guessed = bonds_guessed

    @property
    def topology(self) -> Topology:
        return self.snapshot.topology

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


def held_rows(
    snapshot: Snapshot,
    constrain: str | None = "hbonds",
    *,
    rigid_water: bool = True,
    water_names: Iterable[str] = (),
    water_geometry: str | tuple[float, float] | None = None,
    rigid_residues: Iterable[str] = (),
    rigid_bodies: Iterable[Sequence[int] | IntArray] = (),
    on: Sequence[tuple[IntArray, RowMaker]] = (),
    selected: BoolArray | None = None,
    angles: Literal["angles", "distances"] = "angles",
    guess: bool | Literal["missing"] = "missing",
    flat: float = FLAT,
    remedy: str = "give a topology with bonds",
) -> HeldRows:
    """Rows that hold what is named.

    Parameters
    ----------
    snapshot : Snapshot
    constrain : {'hbonds', 'allbonds', 'hangles', 'allangles', 'none'} or None
        See `CONSTRAIN`; the first three are what they are in OpenMM.
    rigid_water : bool
        Hold water by O-H, O-H and H-H; found by residue name and composition.
    water_names : iterable of str
        Residue names that are water besides the usual ones.
    water_geometry : str, (float, float) or None
        A model of `GEOMETRIES`, or O-H length in angstrom and H-O-H angle in degrees; None holds each molecule as it
        is.
    rigid_residues : iterable of str
        Names of residues held rigid, each by itself.
    rigid_bodies : iterable of array_like of int
        Lists of atoms, each held rigid.
    on : sequence of (atoms, callable)
        Rows on selections; the callable gets the atoms and gives a constraint, for example `CenterOfMass`.
    selected : ndarray of bool, shape (n_atoms,), optional
        Rows are kept if all of their atoms are marked; `rigid_bodies` and `on` are not restricted.
    angles : {'angles', 'distances'}
        Whether angles are rows in radian, or distances of their ends, as in OpenMM.
    guess : bool or 'missing'
        Whether bonds are guessed: 'missing' where atoms have none, with a warning; True all of them anew; False
        never.
    flat : float
        See `kcons.topology.rigid_groups.body_rows`.
    remedy : str
        What the error about missing bonds recommends.

    Returns
    -------
    HeldRows
        Targets are those of the positions, where none are given.

    Raises
    ------
    InputError
        Unknown names, nothing to hold, missing bonds, masses or elements, odd waters; each says what to do.

    Warns
    -----
    UserWarning
        If bonds were guessed without being asked for (guess='missing').
    """
    kind = "none" if constrain is None else str(constrain).lower()
    if kind not in CONSTRAIN:
        raise InputError(
            f"cannot constrain {constrain!r}{near_misses(kind, CONSTRAIN)}; there are {', '.join(CONSTRAIN)}",
            item="constrain",
        )
    if angles not in ("angles", "distances"):
        raise InputError(f"angles must be 'angles' or 'distances', not {angles!r}", item="angles")
    if isinstance(rigid_residues, str):
        rigid_residues = (rigid_residues,)
    residues, bodies = tuple(rigid_residues), tuple(rigid_bodies)
    geometry, model_site = _geometry(water_geometry)
    if not (kind != "none" or rigid_water or residues or bodies or on):
        raise InputError("nothing is to be held; name bonds, water, residues, bodies or rows", item="constrain")
    called = WATER | {str(n).strip().upper() for n in water_names} if rigid_water else frozenset()
    nowhere = np.zeros(snapshot.topology.n_atoms, dtype=bool)
    guessed = 0
    if snapshot.topology.residues_known:
        waters = find_waters(snapshot, called, model_site)
        if kind != "none":
            # The bonds of rigid water are known; guessing them would take most of the time.
            snapshot = _with_water_bonds(snapshot, waters.triples)
            nowhere[waters.triples] = nowhere[waters.sites.sites] = True
            snapshot, guessed = _with_bonds(snapshot, guess, remedy, nowhere)
    else:
        # Molecules take the place of residues, and bonds make molecules.
        if kind != "none" or rigid_water or residues:
            snapshot, guessed = _with_bonds(snapshot, guess, remedy, nowhere)
        snapshot = replace(snapshot, topology=snapshot.topology.with_molecules())
        waters = find_waters(snapshot, called, model_site)
    if selected is not None:
        inside = selected[waters.triples].all(axis=1)
        seen = selected[waters.sites.parents].all(axis=1)
        waters = replace(
            waters,
            triples=waters.triples[inside],
            sites=VirtualSites(waters.sites.sites[seen], waters.sites.parents[seen], waters.sites.coefficients[seen]),
        )
    groups = residue_bodies(snapshot, residues)
    if selected is not None:
        groups = [kept for kept in (g[selected[g].all(axis=1)] for g in groups) if len(kept)]
    groups = _without_waters(groups, waters.triples)
    groups += listed_bodies(snapshot, bodies)
    rows = _internal(snapshot, kind, [waters.triples, *groups], selected, angles)
    rows += waters.rows(geometry, snapshot.angstrom)
    rows += body_rows(snapshot, groups, flat)
    for atoms, make in on:
        made = make(atoms)
        if not isinstance(made, Constraint):
            raise InputError(f"{make!r} gave {made!r}, which is no kcons constraint", item="on")
        rows.append(made)
    rows = [item for item in rows if item.n_rows]
    if not rows:
        raise InputError(_nothing(snapshot.topology, kind, selected), item="constrain")
    _check_masses(snapshot.topology, rows)
    held = ConstraintSet(
        rows, snapshot.positions, snapshot.topology.masses, cell=snapshot.cell, pbc=snapshot.pbc.tolist()
    )
    if guessed and guess == "missing":
        warnings.warn(
            f"{guessed} bonds were guessed from distances and covalent radii, since "
            f"the {snapshot.host or 'topology'} does not have them; {remedy}, or pass guess_bonds=False to refuse",
            UserWarning,
            stacklevel=3,
        )
    return HeldRows(held, snapshot, waters.sites, guessed)


def _geometry(given: str | tuple[float, float] | None) -> tuple[tuple[float, float] | None, float]:
    if given is None:
        return None, 0.0
    if isinstance(given, str):
        name = given.lower().replace("-", "").replace("/", "").replace("_", "")
        if name not in GEOMETRIES:
            raise InputError(
                f"no water model {given!r}{near_misses(given, GEOMETRIES)}; there are {', '.join(GEOMETRIES)}; or give "
                "(O-H in angstrom, H-O-H in degrees)",
                item="water_geometry",
            )
        length, angle, site = GEOMETRIES[name]
        return (length, angle), site
    length, angle = (float(v) for v in given)
    if not (length > 0 and 0 < angle < 180):
        raise InputError(
            f"water of O-H {length:g} angstrom and angle {angle:g}: give both positive", item="water_geometry"
        )
    return (length, angle), 0.0


# -- bonds ----------------------------------------------------------------------------------------


def _with_water_bonds(snapshot: Snapshot, triples: IntArray) -> Snapshot:
    if not len(triples):
        return snapshot
    known = snapshot.topology.bonds
    both = np.concatenate([known, triples[:, [[0, 1], [0, 2]]].reshape(-1, 2)])
    return replace(snapshot, topology=snapshot.topology.with_bonds(both))


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
    if guess is True:
        known = topology.bonds[settled[topology.bonds].any(axis=1)]
        found = guess_bonds(snapshot, ~settled, ~settled)
        both = sorted_pairs(np.concatenate([known, found]))
        return replace(snapshot, topology=topology.with_bonds(both)), len(found)
    if not lacking.any():
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
    found = guess_bonds(snapshot, lacking, ~settled)
    both = sorted_pairs(np.concatenate([topology.bonds, found]))
    return replace(snapshot, topology=topology.with_bonds(both)), len(both) - len(topology.bonds)


def _without_waters(groups: list[IntArray], triples: IntArray) -> list[IntArray]:
    """Rigid residues that are rigid water are held as water."""
    if not len(triples):
        return groups
    oxygens = triples[:, 0]
    return [kept for kept in (g[~np.isin(g, oxygens).any(axis=1)] for g in groups) if len(kept)]


# -- bonds and angles as rows -----------------------------------------------------------------------


def _internal(
    snapshot: Snapshot, kind: str, rigid: Sequence[IntArray], selected: BoolArray | None, angles: str
) -> list[Constraint]:
    """Bonds, angles, and linear rows for straight angles, outside of rigid groups."""
    if kind == "none":
        return []
    topology = snapshot.topology
    hydrogen = topology.hydrogen
    bonds = topology.bonds
    massless = (topology.masses == 0) & (topology.elements == "")
    bonds = bonds[~massless[bonds].any(axis=1)]
    # Some force fields list the H-H of water as a bond; it is not one.
    bonds = bonds[~_closing(bonds, hydrogen)]
    held = bonds[hydrogen[bonds].any(axis=1)] if kind == "hbonds" else bonds
    if selected is not None:
        held = held[selected[held].all(axis=1)]
    held = held[~inside_bodies(topology.n_atoms, held, rigid)]
    _refuse_torn(snapshot, held)
    rows: list[Constraint] = [Distance(held)]
    if kind in ("hbonds", "allbonds"):
        return rows
    triples = bond_angles(bonds, topology.n_atoms)
    if kind == "hangles":
        ends = hydrogen[triples[:, 0]].astype(int) + hydrogen[triples[:, 2]]
        triples = triples[(ends == 2) | ((ends == 1) & (topology.elements[triples[:, 1]] == "O"))]
    if selected is not None:
        triples = triples[selected[triples].all(axis=1)]
    triples = triples[~inside_bodies(topology.n_atoms, triples, rigid)]
    if angles == "distances":
        return [*rows, Distance(np.sort(triples[:, [0, 2]], axis=1))]
    u = minimum_image(snapshot, snapshot.positions[triples[:, 0]] - snapshot.positions[triples[:, 1]])
    w = minimum_image(snapshot, snapshot.positions[triples[:, 2]] - snapshot.positions[triples[:, 1]])
    value = np.arctan2(np.linalg.norm(np.cross(u, w), axis=1), np.sum(u * w, axis=1))
    straight = value > np.radians(STRAIGHT)
    rows.append(Angle(triples[~straight]))
    if straight.any():
        # At 180 degrees an angle is singular: the vertex divides the line between its neighbours.
        lu, lw = np.linalg.norm(u[straight], axis=1), np.linalg.norm(w[straight], axis=1)
        weights = np.stack([lw, lu], axis=1) / (lu + lw)[:, None]
        i, j, k = triples[straight].T
        rows.append(LinearRelation(j, np.stack([i, k], axis=1), weights))
    return rows


def _closing(bonds: IntArray, hydrogen: BoolArray) -> BoolArray:
    """Bonds between two hydrogens that have other bonds."""
    both: BoolArray = np.all(hydrogen[bonds], axis=1)
    if not both.any():
        return both
    degree = np.bincount(bonds.ravel(), minlength=len(hydrogen))
    closing: BoolArray = both & np.all(degree[bonds] > 1, axis=1)
    return closing


# -- checks ---------------------------------------------------------------------------------------


def _refuse_torn(snapshot: Snapshot, bonds: IntArray) -> None:
    d = minimum_image(snapshot, snapshot.positions[bonds[:, 0]] - snapshot.positions[bonds[:, 1]])
    long = np.linalg.norm(d, axis=1) / snapshot.angstrom
    if len(long) and long.max() > TORN:
        i, j = (int(a) for a in bonds[int(np.argmax(long))])
        name = snapshot.topology.atom_name
        raise InputError(
            f"{name(i)} and {name(j)} are bonded and {long.max():.3g} angstrom apart; give the periodic cell, or make "
            "molecules whole that are cut at its edge; or topology and coordinates are of different systems",
            item="positions",
            atoms=[i, j],
        )


def _check_masses(topology: Topology, rows: Sequence[Constraint]) -> None:
    used = np.concatenate([item.atoms.ravel() for item in rows if item.family != "FixedAtoms"] or [np.zeros(0, int)])
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


def _nothing(topology: Topology, kind: str, selected: BoolArray | None) -> str:
    if selected is not None:
        return f"nothing to hold within the selection of {int(selected.sum())} atoms ({CONSTRAIN[kind]}); widen it"
    if kind == "hbonds" and not topology.hydrogen.any():
        return "nothing to hold: there are no hydrogens; add them to the file, or hold all bonds (allbonds)"
    return f"nothing to hold: found no water, and {CONSTRAIN[kind]} are none"


def as_makers(
    on: Mapping[Any, RowMaker] | None, atoms_of: Callable[[Any], IntArray]
) -> list[tuple[IntArray, RowMaker]]:
    """Rows on selections with the selections resolved."""
    return [] if on is None else [(atoms_of(key), make) for key, make in on.items()]
