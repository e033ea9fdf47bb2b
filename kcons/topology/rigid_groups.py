"""Rigid groups of atoms as rows: water, residues, bodies; linear and planar ones by linear rows.

A rigid body of n atoms needs 3n - 6 rows. All of its distances would be far more, and where it is linear or planar
they are singular. So a few atoms, the bases, keep their distances: two for atoms on a line, three in a plane, four in
space. On a line and in a plane every other atom is tied to the bases by x_a = sum w_i x_i (`LinearRelation`), in
space by three distances: to those of the bases that it sees under the widest angles, or in a large body to three atoms
nearby, so that no atom takes part in many rows.

Massless sites, such as M of TIP4P and the lone pairs of TIP5P, are placed by three atoms and not held.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike

from kcons.constraints import Constraint, Distance, LinearRelation
from kcons.constraints.arguments import as_float_array
from kcons.constraints.constraint import IntArray
from kcons.constraints.target import FloatArray
from kcons.errors import InputError, SingularGeometryError, did_you_mean
from kcons.topology.topology import BoolArray, Snapshot, listed, selected_numbers, whole_groups

#: Residues that are water, and the molecule when there are no residues.
WATER = frozenset(
    {
        *("HOH", "H2O", "WAT", "SOL", "DOD", "OH2", "HHO", "OHH"),
        *("T3P", "T4P", "T5P", "T3H", "T4E", "TP3", "TP4", "TP5"),
        *("TIP", "TIP2", "TIP3", "TIP3P", "TIP4", "TIP4P", "TIP4E", "TIP5", "TIP5P", "TP3M", "TIPS"),
        *("SPC", "SPCE", "SPC/E", "OPC", "OPC3"),
    }
)
#: O-H length (angstrom), H-O-H angle (degrees), O-M length (angstrom) of named models.
GEOMETRIES: dict[str, tuple[float, float, float]] = {
    "spc": (1.0, np.degrees(np.arccos(-1 / 3)), 0.0),
    "spce": (1.0, np.degrees(np.arccos(-1 / 3)), 0.0),
    "tip3p": (0.9572, 104.52, 0.0),
    "tip4p": (0.9572, 104.52, 0.15),
    "tip4pew": (0.9572, 104.52, 0.125),
    "tip4p2005": (0.9572, 104.52, 0.1546),
    "tip4pice": (0.9572, 104.52, 0.1577),
    "tip5p": (0.9572, 104.52, 0.0),
    "opc": (0.8724, 103.6, 0.1594),
    "opc3": (0.97888, 109.47, 0.0),
}
#: Extent across a line or a plane, relative to the extent along it, that still counts as flat: what three decimals
#: of a file leave of a ring that was planar.
FLAT = 2e-3
#: Bodies in space of more atoms than this are braced by neighbors instead of by four bases.
LARGE = 50
#: Among how many atoms nearby three are looked for, and what volume of three unit vectors is enough.
_NEAR, _ENOUGH = 12, 0.2
_TRIPLES, _OF_FOUR = (np.array(list(combinations(range(n), 3))) for n in (_NEAR + 4, 4))
#: Waters whose plane is told by less than this are none: |u x w| over the square of the longer arm.
_LINE = 1e-3
#: Bases are the first atoms that are this close to the best.
_AS_GOOD = 1 - 1e-6


@dataclass(frozen=True, eq=False)
class VirtualSites:
    """Sites at r_0 + a (r_1 - r_0) + b (r_2 - r_0) + c (r_1 - r_0) x (r_2 - r_0).

    They have no mass and no degrees of freedom, so that nothing holds them: they are placed after every move of their
    parents.

    Attributes
    ----------
    sites : ndarray of int, shape (n,)
    parents : ndarray of int, shape (n, 3)
        Atoms 0, 1, 2; for water the oxygen and the hydrogens.
    coefficients : ndarray, shape (n, 3)
        a, b, and c in 1/length.
    """

    sites: IntArray
    parents: IntArray
    coefficients: FloatArray

    def __len__(self) -> int:
        return len(self.sites)

    def place(self, positions: ArrayLike) -> FloatArray:
        """Positions with the sites where they belong, shape (n_atoms, 3); molecules must be whole."""
        x = np.array(as_float_array(positions, "positions"))
        origin = x[self.parents[:, 0]]
        u, w = (x[self.parents[:, k]] - origin for k in (1, 2))
        a, b, c = self.coefficients.T[:, :, None]
        x[self.sites] = origin + a * u + b * w + c * np.cross(u, w)
        return x

    def in_unit(self, factor: float) -> VirtualSites:
        """The same where lengths are given by numbers larger by `factor`."""
        return VirtualSites(self.sites, self.parents, np.asarray(self.coefficients / np.array([1.0, 1.0, factor])))


@dataclass(frozen=True, eq=False)
class Waters:
    """Rigid waters of a system: oxygen and hydrogens, and massless sites."""

    triples: IntArray  # shape (n, 3)
    sites: VirtualSites

    def among(self, atoms: BoolArray) -> Waters:
        """Those of which all atoms are marked."""
        held, seen = atoms[self.triples].all(axis=1), atoms[self.sites.parents].all(axis=1)
        sites = VirtualSites(self.sites.sites[seen], self.sites.parents[seen], self.sites.coefficients[seen])
        return Waters(self.triples[held], sites)


def water_rows(triples: IntArray, geometry: tuple[float, float] | None, angstrom: float = 1.0) -> Distance:
    """Three distances a molecule: O-H, O-H, H-H; as they are, or of a given O-H length (angstrom) and angle."""
    pairs = triples[:, [[0, 1], [0, 2], [1, 2]]].reshape(-1, 2)
    if geometry is None:
        return Distance(pairs)
    length, angle = geometry
    lengths = np.array([length, length, 2 * length * np.sin(np.radians(angle) / 2)]) * angstrom
    return Distance(pairs, np.tile(lengths, len(triples)))


def find_waters(
    snapshot: Snapshot,
    names: frozenset[str] = WATER,
    model_site: float = 0.0,
    geometry: tuple[float, float] | None = None,
) -> Waters:
    """Waters by residue name (in capitals) and composition: one oxygen, two hydrogens, massless sites.

    Waters of one oxygen alone, as in crystal structures, are left out. `model_site` is the length O-M in angstrom of a
    geometry that was given by name, 0 takes the sites where they are; `geometry` is the O-H length and the H-O-H angle
    in degrees at which the waters are held, None as they are. Refused, with its name, is a residue that is called water
    and is composed otherwise; so are sites that are not at their water, or whose water has no plane.
    """
    topology = snapshot.topology
    kinds, kind = np.unique(topology.residue_names, return_inverse=True)
    called = np.isin(np.char.upper(np.char.strip(kinds)), list(names))[kind]
    atoms = np.flatnonzero(called[topology.residues])
    number, residue = np.unique(topology.residues[atoms], return_inverse=True)
    symbol = topology.elements[atoms]
    # Anything else counts as a site if it has no mass; Drude particles have some, and move by themselves.
    kind = np.select([symbol == "O", symbol == "H", topology.masses[atoms] == 0], [0, 1, 2], 3)
    count = np.zeros((len(number), 4), np.int64)
    np.add.at(count, (residue, kind), 1)
    whole = (count[:, [0, 1, 3]] == [1, 2, 0]).all(axis=1)
    odd = np.flatnonzero(~whole & (count != [1, 0, 0, 0]).any(axis=1))
    if len(odd):
        where = atoms[residue == odd[0]]
        n_oxygen, n_hydrogen, _, others = count[odd[0]].tolist()
        besides = f" and {others} with mass besides" if others else ""
        raise InputError(
            f"residue {topology.residue_name(int(number[odd[0]]))} (atoms {where[0]} to {where[-1]}) is called water "
            f"but has the atoms {listed(topology.names[where])}, with {n_oxygen} oxygens and {n_hydrogen} hydrogens"
            f"{besides}; rename it, mend the file, or pass rigid_water=False",
            item="rigid_water",
            atoms=where.tolist(),
        )
    member = whole[residue]
    held = np.flatnonzero(member & (kind < 2))
    triples = atoms[held[np.lexsort((kind[held], residue[held]))]].reshape(-1, 3)
    sites = member & (kind == 2)
    parents = triples[(np.cumsum(whole) - 1)[residue[sites]]]
    middle = 0.0 if geometry is None else geometry[0] * float(np.cos(np.radians(geometry[1]) / 2))
    return Waters(triples, _water_sites(snapshot, atoms[sites], parents, number[residue[sites]], model_site, middle))


def _water_sites(
    snapshot: Snapshot, sites: IntArray, parents: IntArray, residue: IntArray, model_site: float, middle: float
) -> VirtualSites:
    """The sites with one set of coefficients for each name, the median of all molecules, mirrored where one is.

    `model_site` and `middle` are the lengths from the oxygen to M and to the middle of the hydrogens in the model, in
    angstrom; 0 where there is none.
    """
    if not len(sites):
        return VirtualSites(sites, parents, np.zeros((0, 3)))
    r = whole_groups(snapshot, np.column_stack([parents, sites]))
    u, w, to_site = (r[:, k] - r[:, 0] for k in (1, 2, 3))
    area = np.linalg.norm(np.cross(u, w), axis=1)
    arms = np.maximum(np.linalg.norm(u, axis=1), np.linalg.norm(w, axis=1))
    topology = snapshot.topology
    flat = np.flatnonzero(~(area > _LINE * arms**2))
    if len(flat):
        raise InputError(
            f"{topology.atom_name(int(sites[flat[0]]))} has no place: its water has no plane, with atoms on a line, "
            "at one point or not finite; give positions of a water",
            item="positions",
            atoms=parents[flat[0]].tolist(),
        )
    frame = np.stack([u, w, np.cross(u, w)], axis=-1)
    found = np.asarray(np.linalg.solve(frame, to_site[..., None])[..., 0], dtype=np.float64)
    key = np.char.add(np.char.add(topology.residue_names[residue], "/"), topology.names[sites])
    for name in np.unique(key):
        these = key == name
        away = float(np.median(np.linalg.norm(to_site[these], axis=1)))
        if not away <= float(np.median(arms[these])):
            raise InputError(
                f"{topology.atom_name(int(sites[these][0]))} and sites like it are {away / snapshot.angstrom:.3g} "
                "angstrom from their oxygens: those of water are nearer than the hydrogens; put them where they belong",
                item="positions",
                atoms=sites[these][:1].tolist(),
            )
        a = float(np.median(found[these, :2], axis=0).mean())
        # One lone pair may have the name of the other in some molecules.
        c = float(np.median(np.abs(found[these, 2])))
        in_plane = c * float(np.median(area[these])) < 0.05 * snapshot.angstrom
        if model_site and in_plane:
            measured = float(np.median(np.linalg.norm(0.5 * (u[these] + w[these]), axis=1)))
            a = 0.5 * model_site / (middle or measured / snapshot.angstrom)
        found[these, :2] = a
        found[these, 2] = 0.0 if in_plane else np.copysign(c, found[these, 2])
    return VirtualSites(sites, parents, found)


# -- bodies ---------------------------------------------------------------------------------------


def residue_bodies(snapshot: Snapshot, names: Sequence[str]) -> list[IntArray]:
    """The atoms of the residues with these names, one array of shape (n_residues, n_atoms) for each size."""
    topology = snapshot.topology
    present = np.char.upper(np.char.strip(topology.residue_names))
    chosen = np.zeros(len(present), dtype=bool)
    for name in names:
        same = present == str(name).strip().upper()
        if not same.any():
            there = f"{did_you_mean(str(name), present.tolist())}; there are {listed(topology.residue_names)}"
            raise InputError(f"no residue is called {name}{there}", item="rigid_residues")
        chosen |= same
    # Virtual sites follow the others by themselves.
    real = (topology.masses > 0) | (topology.elements != "")
    atoms = np.flatnonzero(chosen[topology.residues] & real)
    atoms = atoms[np.argsort(topology.residues[atoms], kind="stable")]
    _, size = np.unique(topology.residues[atoms], return_counts=True)
    starts = np.cumsum(size) - size
    return [atoms[starts[size == n][:, None] + np.arange(n)] for n in np.unique(size).tolist() if n > 1]


def listed_bodies(snapshot: Snapshot, bodies: Sequence[Sequence[int] | IntArray]) -> list[IntArray]:
    """Lists of atoms, grouped by their size.

    Refused are atoms that do not exist or come twice, and bodies of one atom.
    """
    by_size: dict[int, list[IntArray]] = {}
    for k, body in enumerate(bodies):
        atoms = np.sort(selected_numbers(body, snapshot.topology.n_atoms, "rigid_bodies", f"rigid body {k}"))
        twice = atoms[1:][np.diff(atoms) == 0].tolist()
        if len(atoms) < 2 or twice:
            what = f"names atom {twice[0]} twice" if twice else "has one atom; give two atoms or more"
            raise InputError(f"rigid body {k} {what}", item="rigid_bodies", atoms=twice[:1])
        by_size.setdefault(len(atoms), []).append(atoms)
    return [np.array(group) for _, group in sorted(by_size.items())]


def body_rows(snapshot: Snapshot, groups: Sequence[IntArray]) -> list[Constraint]:
    """Rows that hold every group rigid: distances between bases, and relations for all other atoms.

    Groups are arrays of shape (n_bodies, n_atoms), bodies of one size each. Those that are linear or planar up to
    `FLAT` are held exactly so; positions may be off by that much. Two atoms of a body at one point are refused.
    """
    pairs: list[IntArray] = []
    lengths: list[FloatArray] = []
    tied: dict[int, list[tuple[IntArray, IntArray, FloatArray]]] = {2: [], 3: []}

    def hold(ends: IntArray, places: FloatArray) -> None:
        pairs.append(ends.reshape(-1, 2))
        lengths.append(np.linalg.norm(places[..., 0, :] - places[..., 1, :], axis=-1).ravel())

    for atoms in groups:
        r, n = whole_groups(snapshot, atoms), atoms.shape[1]
        center = r.mean(axis=1, keepdims=True)
        _, s, axes = np.linalg.svd(r - center, full_matrices=False)
        dimension = 1 + (s[:, 1:3] > FLAT * s[:, :1]).sum(axis=1) if n > 2 else np.ones(len(atoms), np.int64)
        points = np.flatnonzero(s[:, 0] < 1e-6 * snapshot.angstrom)
        if len(points):
            body, name = atoms[points[0]].tolist(), snapshot.topology.atom_name
            raise SingularGeometryError(
                f"the atoms of a rigid body coincide: {name(body[0])} and {name(body[1])}; give positions", atoms=body
            )
        for d in np.unique(dimension).tolist():
            these = np.flatnonzero(dimension == d)
            if d == 3 and n > LARGE:
                for body in these.tolist():
                    ends = _braced(r[body])
                    hold(atoms[body][ends], r[body][ends])
                continue
            y = (r[these] - center[these]) @ np.swapaxes(axes[these, :d], 1, 2)
            bases = _bases(y)
            corners = np.take_along_axis(y, bases[:, :, None], axis=1)
            own = np.take_along_axis(atoms[these], bases, axis=1)
            sides = np.stack(np.triu_indices(d + 1, 1), axis=1)
            hold(own[:, sides], corners[:, sides])
            if n == d + 1:
                continue
            others = np.ones((len(these), n), dtype=bool)
            np.put_along_axis(others, bases, False, axis=1)
            rest, named = y[others].reshape(len(these), n - d - 1, d), atoms[these][others].reshape(len(these), -1)
            if d == 3:
                # For each atom the three bases that are farthest from being seen in one plane.
                sight = corners[:, None] - rest[:, :, None]
                sight = sight / np.linalg.norm(sight, axis=3, keepdims=True)
                seen = _OF_FOUR[_farthest(np.abs(np.linalg.det(sight[:, :, _OF_FOUR])))]
                number = np.arange(len(these))[:, None, None]
                at, places = own[number, seen], corners[number, seen]
                hold(
                    np.stack([at, np.broadcast_to(named[..., None], at.shape)], axis=-1),
                    np.stack([places, np.broadcast_to(rest[:, :, None], places.shape)], axis=-2),
                )
                continue
            # rest - corner_0 = sum_i w_i edge_i
            edges = corners[:, 1:] - corners[:, :1]
            w = np.linalg.solve(np.swapaxes(edges, 1, 2), np.swapaxes(rest - corners[:, :1], 1, 2))
            w = np.concatenate([1 - w.sum(axis=1, keepdims=True), w], axis=1)
            bases_of = np.repeat(own, n - d - 1, axis=0)
            tied[d + 1].append((named.ravel(), bases_of, np.swapaxes(w, 1, 2).reshape(-1, d + 1)))
    rows: list[Constraint] = []
    if pairs:
        joined = np.sort(np.concatenate(pairs), axis=1)
        # Each once, in the order in which they came.
        first = np.sort(np.unique(joined @ [int(joined.max()) + 1, 1], return_index=True)[1])
        rows.append(Distance(joined[first], np.concatenate(lengths)[first]))
    for parts in tied.values():
        if parts:
            rows.append(LinearRelation(*(np.concatenate([part[k] for part in parts]) for k in range(3))))
    return rows


def _bases(y: FloatArray) -> IntArray:
    """d + 1 atoms far apart from each other, one after the other, ascending; y has shape (n_bodies, n_atoms, d)."""
    many, n, d = y.shape
    if n == d + 1:
        return np.tile(np.arange(n), (many, 1))
    row = np.arange(many)
    chosen = [_farthest(np.linalg.norm(y - y.mean(axis=1, keepdims=True), axis=2))]
    away = y - y[row, chosen[0]][:, None]
    for _ in range(d):
        far = _farthest(np.linalg.norm(away, axis=2))
        chosen.append(far)
        direction = away[row, far]
        direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
        # What is left is normal to the bases so far.
        away = away - np.einsum("bnd,bd->bn", away, direction)[:, :, None] * direction[:, None]
    return np.sort(np.stack(chosen, axis=1), axis=1)


def _braced(x: FloatArray) -> IntArray:
    """Pairs of atoms, 3n - 6, that hold a body in space, each atom by three atoms nearby that come before it.

    A body grows from its middle outwards; see Henneberg's construction.
    """
    from scipy.spatial import cKDTree

    n = len(x)
    order = np.argsort(np.linalg.norm(x - x[np.argmin(np.linalg.norm(x - x.mean(axis=0), axis=1))], axis=1))
    first = np.append(order[0], _three(x, order[0], iter((order[1:_NEAR], order[_spread(n)[1:]]))))
    order = np.concatenate([first, order[~np.isin(order, first)]])
    place = np.empty(n, np.int64)
    place[order] = np.arange(n)
    near = cKDTree(x).query(x, 3 * _NEAR)[1]

    def before(k: int) -> Iterator[IntArray]:
        """Atoms nearby, and for a flat or lonely place a few at all distances, and those that span space."""
        yield near[order[k]][place[near[order[k]]] < k][:_NEAR]
        placed = order[:k][np.argsort(np.linalg.norm(x[order[:k]] - x[order[k]], axis=1))]
        yield np.unique(np.concatenate([placed[_spread(k)], first]))

    bases = [(order[k], base) for k in range(4, n) for base in _three(x, order[k], before(k))]
    return np.array([*combinations(first, 2), *bases])


def _spread(n: int) -> IntArray:
    """Numbers below n, dense at 0."""
    return np.unique(np.geomspace(1, n, _NEAR).astype(np.int64)) - 1


def _three(x: FloatArray, atom: int, choices: Iterator[IntArray]) -> IntArray:
    """The three atoms that `atom` sees farthest from a plane, of the first choice where that is far enough."""
    best, largest = np.zeros(0, np.int64), -1.0
    for known in choices:
        sight = x[known] - x[atom]
        triples = _TRIPLES[_TRIPLES[:, 2] < len(known)]
        volume = np.abs(np.linalg.det((sight / np.linalg.norm(sight, axis=1, keepdims=True))[triples]))
        if volume.max(initial=-1.0) > largest:
            largest = volume.max()
            best = known[triples[np.argmax(volume >= _AS_GOOD * largest)]]
        if largest >= _ENOUGH:
            break
    return best


def _farthest(distance: FloatArray) -> IntArray:
    """The first of the last axis as far as the farthest, up to rounding: the same choice whatever the unit."""
    return np.argmax(distance >= _AS_GOOD * distance.max(axis=-1, keepdims=True), axis=-1).astype(np.int64)


def body_numbers(n_atoms: int, groups: Sequence[IntArray]) -> Iterator[IntArray]:
    """The body of each atom, -1 for none, shape (n_atoms,); several where atoms belong to more than one."""
    first = 0
    for atoms in groups:
        apart = len(np.unique(atoms)) == atoms.size
        for some in [atoms] if apart else atoms[:, None]:
            body = np.full(n_atoms, -1, dtype=np.int64)
            body[some.ravel()] = first + np.repeat(np.arange(len(some)), some.shape[1])
            first += len(some)
            yield body


def inside_bodies(n_atoms: int, lists: IntArray, groups: Sequence[IntArray]) -> BoolArray:
    """Which lists of atoms, shape (n, width), lie within one body, a mask of shape (n,)."""
    inside = np.zeros(len(lists), dtype=bool)
    for body in body_numbers(n_atoms, groups):
        inside |= (body[lists[:, 0]] >= 0) & (body[lists] == body[lists[:, :1]]).all(axis=1)
    return inside
