"""Rows that hold all angles between bonds: as many as are independent, and none that is nearly dependent.

An atom with n neighbors has n (n - 1)/2 angles, of which 2n - 3 are independent. Where three neighbors lie in one
plane with it, their angles add up to 360 degrees to first order, and do not feel the atom leave the plane. So two
neighbors are the base of an atom. Their angle is held, and each other neighbor is held by its angles with both of
them or, where it lies in their plane, by one angle and an improper dihedral. The angles between two others stay what
they are, since the geometry does.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kcons.constraints import Angle
from kcons.constraints.constraint import IntArray
from kcons.constraints.periodic.one_piece import lined_up, minimum_image, neighbor_lists
from kcons.constraints.target import FloatArray
from kcons.constraints.vectors import cross, dot, norm
from kcons.topology.rigid_groups import body_numbers, inside_bodies
from kcons.topology.ring_systems import ring_rows, ring_systems
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


def angle_rows(snapshot: Snapshot, bonds: IntArray, rigid: Sequence[IntArray]) -> tuple[IntArray, IntArray]:
    """Angles and dihedrals that hold all angles between bonds that are held.

    Parameters
    ----------
    snapshot : Snapshot
    bonds : ndarray of int, shape (n_bonds, 2)
        Sorted, each once; those within rigid groups too.
    rigid : sequence of ndarray, shape (n_bodies, n_atoms)
        Groups that are held rigid. Rows within one are not needed, and may be among those returned.

    Returns
    -------
    triples : ndarray of int, shape (n_angles, 3)
        With the vertex in the middle, sorted by vertex and ends. Beyond `STRAIGHT`, it is the only row of an end.
    quads : ndarray of int, shape (n_dihedrals, 4)
        Impropers a-j-b-c of an atom j with its neighbors, and dihedrals of flat rings.
    """
    n = snapshot.topology.n_atoms
    of_bond, systems = ring_systems(bonds, n)
    # The same number for bonds of one ring system or rigid group; -1 for all others.
    label, first = of_bond.copy(), len(systems)
    for body in body_numbers(n, rigid):
        both = body[bonds]
        together = (label < 0) & (both[:, 0] >= 0) & (both[:, 0] == both[:, 1])
        label[together] = first + both[together, 0]
    triples, quads = _centers(snapshot, bonds, label)
    for k, rings in enumerate(systems):
        inside = bonds[of_bond == k]
        every = bond_angles(inside, n)
        straight = Angle(every).measure(lined_up(snapshot.positions[every], snapshot.lattice), 0.0) > np.radians(
            STRAIGHT
        )
        bent, impropers = every[~straight], _impropers(snapshot, inside)
        angles, dihedrals = ring_rows(
            snapshot, inside, bent, impropers, rings, lambda rows: inside_bodies(n, rows, rigid)
        )
        triples += [every[straight], angles]
        quads.append(dihedrals)
    found = np.concatenate([np.zeros((0, 3), np.int64), *triples])
    found[:, [0, 2]] = np.sort(found[:, [0, 2]], axis=1)
    turned = np.concatenate([np.zeros((0, 4), np.int64), *quads])
    return found[np.lexsort((found[:, 2], found[:, 0], found[:, 1]))], turned[np.lexsort(turned.T[[3, 2, 0, 1]])]


def _centers(snapshot: Snapshot, bonds: IntArray, label: IntArray) -> tuple[list[IntArray], list[IntArray]]:
    """Rows at each atom, but for those between bonds with the same label."""
    n = snapshot.topology.n_atoms
    starts, ends = neighbor_lists(bonds, n)
    code = bonds[:, 0] * n + bonds[:, 1]
    triples: list[IntArray] = []
    quads: list[IntArray] = []
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
        e = _directions(snapshot, vertex[:, None], others)
        swap = _second(e, group)
        others, group = (np.take_along_axis(a, swap, axis=1) for a in (others, group))
        e = np.take_along_axis(e, swap[..., None], axis=1)
        apart = (group[:, 0] < 0) | (group[:, 0] != group[:, 1])
        triples.append(np.stack([others[:, 0], vertex, others[:, 1]], axis=1)[apart])
        for k in range(2, d):
            earlier = (group[:, :k] == group[:, k, None]) & (group[:, k, None] >= 0)
            _third(vertex, others, e, k, ~earlier.any(axis=1), triples, quads)
            # The second of another group: what is left is to turn about the first of it.
            turning = (earlier.sum(axis=1) == 1) & ~earlier[:, 0]
            axis = np.argmax(earlier, axis=1)
            row = np.arange(len(vertex))
            quads.append(np.stack([others[:, 0], vertex, others[row, axis], others[:, k]], axis=1)[turning])
    return triples, quads


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


def _third(
    vertex: IntArray,
    others: IntArray,
    e: FloatArray,
    k: int,
    wanted: BoolArray,
    triples: list[IntArray],
    quads: list[IntArray],
) -> None:
    """Rows of neighbor k beside the base, appended to the lists."""
    straight = -np.cos(np.radians(180 - STRAIGHT))
    c = np.stack([dot(e[:, 0], e[:, k]), dot(e[:, 1], e[:, k])], axis=1)
    s = np.stack([norm(cross(e[:, 0], e[:, k])), norm(cross(e[:, 1], e[:, k]))], axis=1)
    opposite = c < straight
    # The base atom that is nearer to 90 degrees is the axis.
    axis = (s[:, 1] * _WIDE > s[:, 0]).astype(int)
    row = np.arange(len(vertex))
    volume = np.abs(dot(cross(e[:, 0], e[:, 1]), e[:, k]))
    plane = norm(cross(e[:, 0], e[:, 1]))
    flat = volume < np.sin(np.radians(FLAT_CENTER)) * s[row, axis] * plane
    flat &= (plane > _NARROW) & (s[row, axis] > _NARROW)
    alone = opposite.any(axis=1)
    for b in (0, 1):
        own = wanted & np.where(alone, np.argmax(opposite, axis=1) == b, ~flat | (axis == b))
        triples.append(np.stack([others[:, b], vertex, others[:, k]], axis=1)[own])
    improper = np.stack([others[row, 1 - axis], vertex, others[row, axis], others[:, k]], axis=1)
    quads.append(improper[wanted & flat & ~alone])


def _impropers(snapshot: Snapshot, bonds: IntArray) -> IntArray:
    """Improper dihedrals where three or more of the bonds meet in one plane."""
    triples: list[IntArray] = []
    quads: list[IntArray] = [np.zeros((0, 4), np.int64)]
    starts, ends = neighbor_lists(bonds, snapshot.topology.n_atoms)
    for vertex in np.flatnonzero(np.diff(starts) > 2)[:, None]:
        others = ends[starts[vertex[0]] : starts[vertex[0] + 1]][None]
        e = _directions(snapshot, vertex[:, None], others)
        for k in range(2, others.shape[1]):
            _third(vertex, others, e, k, np.ones(1, dtype=bool), triples, quads)
    return np.concatenate(quads)


def _directions(snapshot: Snapshot, vertex: IntArray, others: IntArray) -> FloatArray:
    u = minimum_image(snapshot.positions[others] - snapshot.positions[vertex], snapshot.lattice)
    return np.asarray(u / norm(u)[..., None])
