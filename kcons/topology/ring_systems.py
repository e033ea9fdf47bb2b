"""Small rings that share bonds, and the rows that hold all of their angles without one too many.

The angles of a ring depend on each other. In a flat ring they do not feel to first order that it puckers; only their
sum, which is at its largest, keeps it flat. So n - 3 angles and n - 3 dihedrals hold a flat ring of n atoms whose bonds
are held.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from kcons.constraints import Angle, Dihedral, Distance
from kcons.constraints.constraint import Constraint, IntArray
from kcons.constraints.periodic.one_piece import connected, lined_up, neighbor_lists
from kcons.constraints.target import FloatArray
from kcons.topology.topology import BoolArray, Snapshot

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


def ring_systems(bonds: IntArray, n_atoms: int) -> tuple[IntArray, list[list[IntArray]]]:
    """Rings that share bonds: the shortest ring through each bond, up to `LARGEST` atoms; `bonds` sorted, each once.

    Returns
    -------
    of_bond : ndarray of int, shape (n_bonds,)
        The system each bond belongs to, -1 for bonds in no small ring.
    rings : list of list of ndarray of int
        The rings of each system: their atoms, one after the other.
    """
    of_bond = np.full(len(bonds), -1)
    keep = _without_ends(bonds, n_atoms)
    starts, ends = neighbor_lists(bonds[keep], n_atoms)
    number = {pair: k for k, pair in enumerate(map(tuple, bonds.tolist()))}
    found: dict[tuple[int, ...], IntArray] = {}
    for i, j in bonds[keep].tolist():
        ring = _shortest_ring(i, j, starts, ends)
        if ring:
            found.setdefault(tuple(sorted(ring)), np.array(ring))
    cycles = list(found.values())
    members = [
        [number[tuple(sorted(p))] for p in zip(c.tolist(), np.roll(c, -1).tolist(), strict=True)] for c in cycles
    ]
    links = [(len(bonds) + k, b) for k, ring in enumerate(members) for b in ring]
    label, _ = connected(np.array(links, dtype=np.int64).reshape(-1, 2), len(bonds) + len(cycles))
    rings: dict[int, list[IntArray]] = {}
    for cycle, ring in zip(cycles, members, strict=True):
        rings.setdefault(int(label[ring[0]]), []).append(cycle)
    for k, system in enumerate(rings):
        of_bond[label[: len(bonds)] == system] = k
    return of_bond, list(rings.values())


def ring_rows(
    snapshot: Snapshot,
    bonds: IntArray,
    triples: IntArray,
    impropers: IntArray,
    rings: Sequence[IntArray],
    within: Callable[[IntArray], BoolArray],
) -> tuple[IntArray, IntArray]:
    """Which angles and dihedrals hold one ring system whose bonds are held.

    Parameters
    ----------
    bonds, triples, impropers : ndarray of int
        Those within the system: its bonds, its angles, impropers at its flat centers.
    rings : sequence of ndarray of int
        Its rings, whose dihedrals are candidates where they are flat.
    within : callable
        Which of several lists of atoms lie within a rigid group: those rows are held already, and are not returned.

    Returns
    -------
    triples, quads : ndarray of int, shapes (n, 3) and (n, 4)
    """
    if len(np.unique(bonds)) > LARGE_SYSTEM:
        return triples, impropers
    turns = [np.stack([np.roll(ring, -k) for k in range(4)], axis=1) for ring in rings if len(ring) > 3]
    flat = [quads for quads in turns if _is_flat(snapshot, quads)]
    quads = np.concatenate([impropers, *flat])
    items: list[Constraint] = [Distance(bonds), Angle(triples), Dihedral(quads)]
    rows = _gradients(snapshot, items)
    held = np.concatenate([np.ones(len(bonds), dtype=bool), within(triples), within(quads)])
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


def _is_flat(snapshot: Snapshot, quads: IntArray) -> bool:
    r = lined_up(snapshot.positions[quads], snapshot.lattice)
    return bool(np.abs(Dihedral(quads).measure(r, 0.0)).max() < np.radians(FLAT_RING))


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
