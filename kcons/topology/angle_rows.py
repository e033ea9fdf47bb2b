"""Rows that hold all angles between bonds: as many as are independent, and none that is nearly dependent.

An atom with n neighbors has n (n - 1)/2 angles, of which 2n - 3 are independent. Where three neighbors lie in one
plane with it, their angles add up to 360 degrees to first order, and do not feel the atom leave the plane. So two
neighbors are the base of an atom. Their angle is held, and each other neighbor is held by its angles with both of
them or, where it lies in their plane, by one angle and an improper dihedral. The angles between two others stay what
they are, since the geometry does.

The angles of a small ring depend on each other, too. In a flat ring they do not feel to first order that it puckers;
only their sum, which is at its largest, keeps it flat. So n - 3 angles and n - 3 dihedrals hold a flat ring of n atoms
whose bonds are held.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kcons.constraints import Angle, Dihedral, Distance
from kcons.constraints.constraint import Constraint, IntArray
from kcons.constraints.periodic.one_piece import connected, lined_up, minimum_image, neighbor_lists
from kcons.constraints.target import FloatArray
from kcons.constraints.vectors import cross, dot, norm
from kcons.topology.rigid_groups import body_numbers, inside_bodies
from kcons.topology.topology import BoolArray, Snapshot, bond_angles

#: Beyond this an angle is held by a linear row, in degrees.
STRAIGHT = 179.0
#: A neighbor lies in the plane of the base if its improper dihedral is that close to 0 or 180 degrees; at an atom with
#: three equal angles that is a sum of more than 353 degrees.
FLAT_CENTER = 30.0
#: Sine of an angle that spans no plane.
_NARROW = 0.1
#: Part of the largest sine that is as good for the angle of the base.
_WIDE = 0.7
#: Rings of more atoms are chains that happen to close.
LARGEST = 8
#: Ring systems of more atoms (graphene, zeolites) keep all of their rows, dependent ones too.
LARGE_SYSTEM = 60
#: A ring is flat if no dihedral in it is larger, in degrees.
FLAT_RING = 20.0
#: What is left of a row of length 1 beside the rows before it, if it depends on them.
_DEPENDENT = 1e-6
#: The first row that is this close to the best, so that rounding does not choose.
_AS_GOOD = 1 - 1e-6


def angle_rows(snapshot: Snapshot, bonds: IntArray, rigid: Sequence[IntArray]) -> tuple[IntArray, IntArray]:
    """Angles, shape (n, 3), and dihedrals, shape (m, 4), that hold all angles between bonds that are held.

    `bonds` are sorted, each once, those within rigid groups too. Rows within one of the groups `rigid`, arrays of shape
    (n_bodies, n_atoms), are not needed, and may be among those returned. Angles have the vertex in the middle and are
    sorted by vertex and ends; one beyond `STRAIGHT` is the only row of an end. Dihedrals are impropers a-j-b-c of an
    atom j with its neighbors, and those of flat rings.
    """
    n = snapshot.topology.n_atoms
    of_bond, systems = ring_systems(bonds, n)
    # The same number for bonds of one ring system or rigid group; -1 for all others.
    label, first = of_bond.copy(), len(systems)
    for body in body_numbers(n, rigid):
        both = body[bonds]
        together = (label < 0) & (both[:, 0] >= 0) & (both[:, 0] == both[:, 1])
        label[together] = first + both[together, 0]
    triples, quads = ([rows] for rows in _centers(snapshot, bonds, label))
    for k, rings in enumerate(systems):
        inside = bonds[of_bond == k]
        every = bond_angles(inside, n)
        angle = Angle(every).measure(lined_up(snapshot.positions[every], snapshot.lattice), 0.0)
        straight = angle > np.radians(STRAIGHT)
        impropers = _centers(snapshot, inside, np.full(len(inside), -1))[1]
        angles, dihedrals = ring_rows(snapshot, inside, every[~straight], impropers, rings, rigid)
        triples += [every[straight], angles]
        quads.append(dihedrals)
    found = np.concatenate(triples)
    found[:, [0, 2]] = np.sort(found[:, [0, 2]], axis=1)
    turned = np.concatenate(quads)
    return found[np.lexsort((found[:, 2], found[:, 0], found[:, 1]))], turned[np.lexsort(turned.T[[3, 2, 0, 1]])]


def _centers(snapshot: Snapshot, bonds: IntArray, label: IntArray) -> tuple[IntArray, IntArray]:
    """Rows at each atom, but for those between bonds with the same label."""
    n = snapshot.topology.n_atoms
    starts, ends = neighbor_lists(bonds, n)
    code = bonds[:, 0] * n + bonds[:, 1]
    triples: list[IntArray] = [np.zeros((0, 3), np.int64)]
    quads: list[IntArray] = [np.zeros((0, 4), np.int64)]
    degree = np.diff(starts)
    for d in np.unique(degree[degree > 1]).tolist():
        vertex = np.flatnonzero(degree == d)
        others = ends[starts[vertex][:, None] + np.arange(d)]
        low, high = np.minimum(others, vertex[:, None]), np.maximum(others, vertex[:, None])
        group = label[np.searchsorted(code, low * n + high)]
        many = (group[:, :, None] == group[:, None]).sum(axis=2) > 1
        group = np.where(many & (group >= 0), group, -1)
        # The base is of one group, if there is one, and of heavy atoms: rows between light ones hold them less well.
        rank = np.where(group >= 0, group, len(bonds) + n)
        order = np.lexsort((others, -snapshot.topology.masses[others], rank))
        others, group = (np.take_along_axis(a, order, axis=1) for a in (others, group))
        e = minimum_image(snapshot.positions[others] - snapshot.positions[vertex[:, None]], snapshot.lattice)
        e = e / norm(e)[..., None]
        swap = _second(e, group)
        others, group = (np.take_along_axis(a, swap, axis=1) for a in (others, group))
        e = np.take_along_axis(e, swap[..., None], axis=1)
        apart = (group[:, 0] < 0) | (group[:, 0] != group[:, 1])
        triples.append(np.stack([others[:, 0], vertex, others[:, 1]], axis=1)[apart])
        row, plane = np.arange(len(vertex)), cross(e[:, 0], e[:, 1])
        for k in range(2, d):
            earlier = (group[:, :k] == group[:, k, None]) & (group[:, k, None] >= 0)
            wanted = ~earlier.any(axis=1)
            opposite = np.stack([dot(e[:, b], e[:, k]) for b in (0, 1)], axis=1) < np.cos(np.radians(STRAIGHT))
            sine = np.stack([norm(cross(e[:, b], e[:, k])) for b in (0, 1)], axis=1)
            # The base atom that is nearer to 90 degrees is the axis.
            axis = (sine[:, 1] * _WIDE > sine[:, 0]).astype(int)
            volume = np.abs(dot(plane, e[:, k]))
            flat = volume < np.sin(np.radians(FLAT_CENTER)) * sine[row, axis] * norm(plane)
            flat &= (norm(plane) > _NARROW) & (sine[row, axis] > _NARROW)
            alone = opposite.any(axis=1)
            for b in (0, 1):
                own = wanted & np.where(alone, np.argmax(opposite, axis=1) == b, ~flat | (axis == b))
                triples.append(np.stack([others[:, b], vertex, others[:, k]], axis=1)[own])
            improper = np.stack([others[row, 1 - axis], vertex, others[row, axis], others[:, k]], axis=1)
            quads.append(improper[wanted & flat & ~alone])
            # The second of another group: what is left is to turn about the first of it.
            turning = (earlier.sum(axis=1) == 1) & ~earlier[:, 0]
            first = others[row, np.argmax(earlier, axis=1)]
            quads.append(np.stack([others[:, 0], vertex, first, others[:, k]], axis=1)[turning])
    return np.concatenate(triples), np.concatenate(quads)


def _second(e: FloatArray, group: IntArray) -> IntArray:
    """Order in which the second neighbor spans a plane with the first, shape (n_vertices, n_neighbors)."""
    many, d = group.shape
    sine = norm(cross(e[:, :1], e[:, 1:]))
    second = 1 + np.argmax(sine >= _WIDE * sine.max(axis=1, keepdims=True), axis=1)
    second[(group[:, 0] >= 0) & (group[:, 0] == group[:, 1])] = 1
    order = np.tile(np.arange(d), (many, 1))
    order[np.arange(many), second] = 1
    order[:, 1] = second
    return order


# -- rings ---------------------------------------------------------------------------------------


def ring_systems(bonds: IntArray, n_atoms: int) -> tuple[IntArray, list[list[IntArray]]]:
    """The system of rings of each bond, -1 for none, shape (n_bonds,), and the rings of each system.

    Rings that share bonds are one system. There is the shortest ring through each bond, up to `LARGEST` atoms, given by
    its atoms, one after the other; `bonds` are sorted, each once.
    """
    keep = _without_ends(bonds, n_atoms)
    starts, ends = neighbor_lists(bonds[keep], n_atoms)
    found: dict[tuple[int, ...], IntArray] = {}
    for i, j in bonds[keep].tolist():
        ring = _shortest_ring(i, j, starts, ends)
        if ring:
            found.setdefault(tuple(sorted(ring)), np.array(ring))
    cycles, code, links = list(found.values()), bonds @ [n_atoms, 1], [np.zeros((0, 2), np.int64)]
    for k, cycle in enumerate(cycles):
        sides = np.sort(np.stack([cycle, np.roll(cycle, -1)], axis=1), axis=1)
        own = np.searchsorted(code, sides @ [n_atoms, 1])
        links.append(np.stack([np.full(len(cycle), len(bonds) + k), own], axis=1))
    label, count = connected(np.concatenate(links), len(bonds) + len(cycles))
    kinds, which = np.unique(label[len(bonds) :], return_inverse=True)
    systems: list[list[IntArray]] = [[] for _ in kinds]
    for cycle, system in zip(cycles, which.tolist(), strict=True):
        systems[system].append(cycle)
    number = np.full(count, -1)
    number[kinds] = np.arange(len(kinds))
    return number[label[: len(bonds)]], systems


def ring_rows(
    snapshot: Snapshot,
    bonds: IntArray,
    triples: IntArray,
    impropers: IntArray,
    rings: Sequence[IntArray],
    rigid: Sequence[IntArray],
) -> tuple[IntArray, IntArray]:
    """Which angles, shape (n, 3), and dihedrals, shape (m, 4), hold one ring system whose bonds are held.

    Bonds, angles and impropers at flat centers are those within the system; dihedrals of flat rings are candidates,
    too. Rows within one of the groups `rigid` are left out.
    """
    if len(np.unique(bonds)) > LARGE_SYSTEM:
        return triples, impropers
    candidates = [impropers]
    for ring in (ring for ring in rings if len(ring) > 3):
        turns = np.stack([np.roll(ring, -k) for k in range(4)], axis=1)
        r = lined_up(snapshot.positions[turns], snapshot.lattice)
        if np.abs(Dihedral(turns).measure(r, 0.0)).max() < np.radians(FLAT_RING):
            candidates.append(turns)
    quads = np.concatenate(candidates)
    items: list[Constraint] = [Distance(bonds), Angle(triples), Dihedral(quads)]
    rows = _gradients(snapshot, items)
    n = snapshot.topology.n_atoms
    held = np.concatenate(
        [np.ones(len(bonds), dtype=bool), inside_bodies(n, triples, rigid), inside_bodies(n, quads, rigid)]
    )
    chosen = np.zeros(len(rows), dtype=bool)
    chosen[np.flatnonzero(~held)[_independent(rows[held], rows[~held])]] = True
    angles, dihedrals = np.split(chosen[len(bonds) :], [len(triples)])
    return triples[angles], quads[dihedrals]


def _without_ends(bonds: IntArray, n_atoms: int) -> BoolArray:
    """Bonds left when atoms with one bond are taken away, again and again."""
    keep = np.ones(len(bonds), dtype=bool)
    while True:
        degree = np.bincount(bonds[keep].ravel(), minlength=n_atoms)
        ends: BoolArray = keep & (degree[bonds] == 1).any(axis=1)
        if not ends.any():
            return keep
        keep &= ~ends


def _shortest_ring(i: int, j: int, starts: IntArray, ends: IntArray) -> list[int]:
    """Atoms of the shortest ring through the bond i-j, none if it has more than `LARGEST`."""
    before = {i: i}
    shell = [i]
    for _ in range(LARGEST - 1):
        reached = []
        for a in shell:
            for b in ends[starts[a] : starts[a + 1]].tolist():
                if b in before or (a, b) == (i, j):
                    continue
                before[b] = a
                reached.append(b)
        if j in before:
            ring = [j]
            while ring[-1] != i:
                ring.append(before[ring[-1]])
            return ring
        shell = reached
    return []


def _gradients(snapshot: Snapshot, items: Sequence[Constraint]) -> FloatArray:
    """Rows by atoms, weighted with the masses and of length 1, shape (n_rows, 3 n_atoms of the rows)."""
    atoms = np.unique(np.concatenate([item.atoms.ravel() for item in items]))
    masses = snapshot.topology.masses[atoms]
    weight = 1 / np.sqrt(masses) if (masses > 0).all() else np.ones(len(atoms))
    parts = []
    for item in items:
        r = lined_up(snapshot.positions[item.atoms], snapshot.lattice)
        rows = np.zeros((item.n_rows, len(atoms), 3))
        place = np.searchsorted(atoms, item.atoms)
        np.add.at(rows, (np.arange(item.n_rows)[:, None], place), item.gradient(r, 0.0) * weight[place][..., None])
        parts.append(rows.reshape(item.n_rows, 3 * len(atoms)))
    both = np.concatenate(parts)
    return np.asarray(both / np.linalg.norm(both, axis=1, keepdims=True))


def _independent(given: FloatArray, rows: FloatArray) -> IntArray:
    """As many of `rows` as are independent of each other and of `given`, those farthest from the others first."""
    chosen = []
    _, s, basis = np.linalg.svd(given, full_matrices=False)
    basis = basis[s > _DEPENDENT * s[:1].max(initial=0.0)]
    left = rows - (rows @ basis.T) @ basis
    length = np.linalg.norm(left, axis=1)
    while length.max(initial=0.0) > _DEPENDENT:
        best = int(np.argmax(length >= _AS_GOOD * length.max()))
        chosen.append(best)
        direction = left[best] / length[best]
        left = left - np.outer(left @ direction, direction)
        length = np.linalg.norm(left, axis=1)
    return np.sort(np.array(chosen, dtype=np.int64))
