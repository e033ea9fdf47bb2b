"""Random molecules and their rows, in the package's words and in those of the oracle."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from cell_oracle import Array, Row


class Unsuitable(Exception):
    """This draw is singular, or has no cell; draw again."""


@dataclass
class Item:
    """Rows in the package's words, and the same for the oracle.

    Not `held` are those for which it has rows in other words, and no `family` have these.
    """

    family: str
    rows: list[Row]
    #: Atoms of the rows that depend on images.
    listed: list[list[int]] = field(default_factory=list)
    arguments: dict = field(default_factory=dict)
    how: str = "open"  # 'open' | 'given' | 'moving'
    held: bool = True


class Builder:
    """Molecules one after the other."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.x: list[Array] = []
        self.items: list[Item] = []
        self.fixed: list[int] = []
        self.kinds: list[str] = []
        self.placed: set[int] = set()
        self.cell: Array | None = None
        self.impossible = self.drifting = self.flat = False
        self.outward: list[tuple[int, int]] = []

    def atoms(self, x: Array, shift: bool = True) -> list[int]:
        first = len(self.x)
        x = np.asarray(x) + (self.rng.uniform(-6, 6, 3) if shift else 0.0)
        self.x.extend(x)
        return list(range(first, first + len(x)))

    def add(self, family: str, rows: list[Row], listed: list[list[int]], movable: bool = True, **arguments) -> Item:
        chance = self.rng.random()
        how = "moving" if movable and chance < 0.15 else "given" if chance < 0.4 else "open"
        item = Item(family, rows, listed, arguments, how)
        self.items.append(item)
        return item

    def distances(self, pairs: list[tuple[int, int]], movable: bool = True, held: bool = True) -> Item:
        """Distance rows; `held` False if the oracle holds the same in other words."""
        rows = [Row("norm", [{i: 1.0, j: -1.0}], [(0, 0, 0)]) for i, j in pairs]
        item = self.add("Distance", rows, [list(p) for p in pairs], movable, pairs=pairs)
        item.held = held
        return item

    def angles(self, triples: list[list[int]], images: list | None = None) -> None:
        rows = [Row("angle", [{i: 1.0, j: -1.0}, {k: 1.0, j: -1.0}], images or [(0, 0, 0)] * 2) for i, j, k in triples]
        self.add("Angle", rows, triples, triples=triples)

    def dihedrals(self, quads: list[list[int]]) -> None:
        rows = [
            Row("dihedral", [{j: 1.0, i: -1.0}, {k: 1.0, j: -1.0}, {m: 1.0, k: -1.0}], [(0, 0, 0)] * 3)
            for i, j, k, m in quads
        ]
        self.add("Dihedral", rows, quads, quads=quads)

    def relation(self, atom: int, bases: list[int], weights: Array, held: bool = True) -> None:
        rows = [
            Row("linear", coefficients={atom: axis, **{b: -w * axis for b, w in zip(bases, weights, strict=True)}})
            for axis in np.eye(3)
        ]
        if held:
            self.add("LinearRelation", rows, [[atom, *bases]], atoms=[atom], bases=[bases], weights=[list(weights)])
        else:
            self.items.append(Item("", rows))

    def combination(self, atoms: list[int], coefficients: Array, place: bool = False) -> None:
        rows = [Row("linear", coefficients={a: c for a, c in zip(atoms, coefficients, strict=True)})]
        arguments = {"place": True} if place else {}
        self.add("LinearCombination", rows, [atoms], atoms=atoms, coefficients=coefficients, **arguments)


def _unit(rng: np.random.Generator) -> Array:
    d = rng.normal(size=3)
    return d / np.linalg.norm(d)


def zigzag(rng: np.random.Generator, n: int) -> Array:
    """A chain whose angles lie between 75 and 140 degrees, with no torsion near a straight one."""
    x = [np.zeros(3)]
    step = _unit(rng)
    for _ in range(n - 1):
        x.append(x[-1] + step * rng.uniform(0.9, 1.3))
        turn = np.radians(rng.uniform(40, 105))
        side = np.cross(step, _unit(rng))
        side /= np.linalg.norm(side)
        step = np.cos(turn) * step + np.sin(turn) * side
    return np.array(x)


def cloud(rng: np.random.Generator, n: int, dimension: int = 3) -> Array:
    """Points some 1 apart, in space or in a plane."""
    points = [np.zeros(dimension)]
    while len(points) < n:
        direction = rng.normal(size=dimension)
        p = points[rng.integers(len(points))] + direction / np.linalg.norm(direction) * rng.uniform(0.9, 1.3)
        if min(np.linalg.norm(p - q) for q in points) > 0.75:
            points.append(p)
    x = np.array(points)
    return x if dimension == 3 else x @ np.linalg.qr(rng.normal(size=(3, 3)))[0][:dimension]


def _pairs(atoms: list[int]) -> list[tuple[int, int]]:
    return list(itertools.combinations(atoms, 2))


# -- kinds of molecules -----------------------------------------------------------------------------


def chain(b: Builder) -> list[int]:
    rng = b.rng
    a = b.atoms(zigzag(rng, int(rng.integers(2, 7))))
    bonds = list(itertools.pairwise(a))
    if len(a) > 3 and rng.random() < 0.25:
        bonds.append((a[0], a[-1]))
    bonded = b.distances(bonds)
    if len(a) > 2 and rng.random() < 0.5:
        b.angles([a[k : k + 3] for k in range(len(a) - 2) if rng.random() < 0.7] or [a[:3]])
    if len(a) > 3 and rng.random() < 0.5:
        b.dihedrals([a[k : k + 4] for k in range(len(a) - 3) if rng.random() < 0.6] or [a[:4]])
    if len(a) > 3 and rng.random() < 0.2:
        b.dihedrals([[a[k] for k in rng.permutation(len(a))[:4]]])
    if rng.random() < 0.1:
        b.distances([bonds[0][::-1]], movable=False)  # the same once more
        bonded.how = "open"
    return a


def rigid(b: Builder) -> list[int]:
    a = b.atoms(cloud(b.rng, int(b.rng.integers(3, 7))))
    b.distances(_pairs(a), movable=False)
    return a


def planar(b: Builder) -> list[int]:
    rng = b.rng
    x = cloud(rng, int(rng.integers(4, 7)), 2)
    a = b.atoms(x)
    b.distances(_pairs(a), movable=False, held=False)
    area = [np.linalg.norm(np.cross(x[j] - x[i], x[k] - x[i])) for i, j, k in itertools.combinations(range(len(a)), 3)]
    i, j, k = list(itertools.combinations(range(len(a)), 3))[int(np.argmax(area))]
    _between(b, a, x, [i, j, k])
    return a


def linear(b: Builder) -> list[int]:
    rng = b.rng
    along = np.cumsum(rng.uniform(0.9, 1.3, int(rng.integers(3, 7))))
    x = np.outer(rng.permutation(along), _unit(rng))
    a = b.atoms(x)
    b.distances(_pairs(a), movable=False, held=False)
    d = np.linalg.norm(x[:, None] - x[None], axis=2)
    _between(b, a, x, [int(k) for k in np.unravel_index(np.argmax(d), d.shape)])
    return a


def _between(b: Builder, a: list[int], x: Array, bases: list[int]) -> None:
    """Distances of the bases, and the other atoms as combinations of them: what the oracle holds."""
    b.flat = True
    rows = [Row("norm", [{a[i]: 1.0, a[j]: -1.0}], [(0, 0, 0)]) for i, j in itertools.combinations(bases, 2)]
    b.items.append(Item("", rows))
    arms = (x[bases[1:]] - x[bases[0]]).T
    for k in range(len(a)):
        if k not in bases:
            w = np.linalg.lstsq(arms, x[k] - x[bases[0]], rcond=None)[0]
            b.relation(a[k], [a[i] for i in bases], np.array([1 - w.sum(), *w]), held=False)


def site(b: Builder) -> list[int]:
    """Linear relations in the user's words: between free atoms, or on tied ones; light bases with a long lever."""
    rng = b.rng
    n = int(rng.integers(2, 4))
    x = cloud(rng, n)
    w = rng.normal(size=n) * rng.choice([0.3, 1.0])
    if rng.random() < 0.4:
        w[1:] *= 0.05
    w[0] += 1 - w.sum()
    a = b.atoms(np.vstack([x, w @ x + rng.normal(size=3) * 0.3 * (rng.random() < 0.3)]))
    if rng.random() < 0.5:
        b.distances(_pairs(a[:n]))
    b.relation(a[n], a[:n], w)
    return a


def combination(b: Builder) -> list[int]:
    rng = b.rng
    x = cloud(rng, int(rng.integers(2, 6)))
    a = b.atoms(x)
    for _ in range(int(rng.integers(1, 3))):
        width = int(rng.integers(2, min(len(a), 5) + 1))
        c = rng.normal(size=(width, 3))
        if width == 2 or rng.random() < 0.5:
            # The same for all, up to a factor: what people write.
            c = np.outer(rng.normal(size=width), _unit(rng) if rng.random() < 0.5 else np.eye(3)[rng.integers(3)])
        c[-1] -= c.sum(axis=0)
        if np.abs(c).max() < 0.1:
            raise Unsuitable
        b.combination([a[k] for k in rng.permutation(len(a))[:width]], c)
    if rng.random() < 0.4:
        b.distances([(a[0], a[1])])
    b.outward.append((a[0], a[1]))
    return a


def bend(b: Builder) -> list[int]:
    """An angle or a dihedral whose arms are free, or only some of them."""
    rng = b.rng
    n = int(rng.integers(3, 5))
    a = b.atoms(zigzag(rng, n))
    (b.angles if n == 3 else b.dihedrals)([a])
    if rng.random() < 0.4:
        b.distances([p for p in itertools.pairwise(a) if rng.random() < 0.5] or [(a[0], a[1])])
    b.outward.append((a[0], a[1]))
    return a


def centers(b: Builder) -> list[int]:
    rng = b.rng
    sizes = rng.integers(1, 4, 2)
    parts = [cloud(rng, int(s)) for s in sizes]
    parts[1] = parts[1] - parts[1][0] + parts[0][-1] + _unit(rng) * rng.uniform(1.0, 2.5)
    a = b.atoms(np.vstack(parts))
    groups = [a[: sizes[0]], a[sizes[0] :]]
    for group in groups:
        if len(group) > 1 and rng.random() < 0.7:
            b.distances(_pairs(group))
    total = {0: 1.0, 1: 1.0}
    row = Row("norm", [{i: (1.0 if k == 0 else -1.0) * total[k] for k in (0, 1) for i in groups[k]}], [(0, 0, 0)])
    b.add("CenterDistance", [row], [a], group_a=groups[0], group_b=groups[1])
    b.outward.append((a[0], a[-1]))
    return a


def gyration(b: Builder) -> list[int]:
    a = b.atoms(zigzag(b.rng, int(b.rng.integers(3, 6))))
    if b.rng.random() < 0.4:
        b.distances(list(itertools.pairwise(a)))
    weighted = bool(b.rng.random() < 0.5)
    row = Row("gyration", [{i: 1.0 for i in a}])
    b.add("RadiusOfGyration", [row], [a], atoms=a, mass_weighted=weighted)
    return a


def fixed(b: Builder) -> list[int]:
    """A chain with one or two atoms fixed, at rest or moving."""
    rng = b.rng
    a = b.atoms(zigzag(rng, int(rng.integers(2, 6))))
    b.distances(list(itertools.pairwise(a)))
    if len(a) > 2 and rng.random() < 0.3:
        b.angles([a[:3]])
    held = [a[0]] if len(a) < 5 or rng.random() < 0.6 else [a[0], a[-1]]
    b.fixed += held
    b.placed.update(held)
    b.add("FixedAtoms", [], [[i] for i in held], atoms=held)
    return a


def fixed_pair(b: Builder) -> list[int]:
    """A row between two fixed atoms: kept by what is at rest, impossible where it moves by itself."""
    a = b.atoms(zigzag(b.rng, 3))
    item = b.distances([(a[0], a[1])])
    b.distances([(a[1], a[2])])
    item.how = "moving" if b.rng.random() < 0.5 else "open"
    b.impossible = b.impossible or item.how == "moving"
    b.fixed += a[:2]
    b.placed.update(a[:2])
    b.add("FixedAtoms", [], [[i] for i in a[:2]], movable=False, atoms=a[:2])
    return a


def surface(b: Builder) -> list[int]:
    """A chain of which one atom, or the center of mass, keeps to a place."""
    a = b.atoms(zigzag(b.rng, int(b.rng.integers(1, 5))))
    if len(a) > 1:
        b.distances(list(itertools.pairwise(a)))
    _place(b, a)
    return a


def places(b: Builder) -> list[int]:
    """Atoms that each keep to a place of their own, tied together by what depends on their images."""
    rng = b.rng
    n = int(rng.integers(2, 6))
    a = b.atoms(zigzag(rng, n))
    tie = rng.integers(4)
    if tie == 0 and n > 2:
        (b.angles if n == 3 else b.dihedrals)([a[:4]])
    elif tie == 1 and n > 2:
        b.add("RadiusOfGyration", [Row("gyration", [{i: 1.0 for i in a}])], [a], atoms=a, mass_weighted=False)
    elif tie == 2:
        c = np.outer([1.0, -1.0], _unit(rng))
        b.combination([a[0], a[-1]], c)
    else:
        row = Row("norm", [{i: 1.0 if i == a[0] else -1.0 for i in a}], [(0, 0, 0)])
        b.add("CenterDistance", [row], [a], group_a=a[:1], group_b=a[1:])
    if rng.random() < 0.4:
        b.distances([p for p in itertools.pairwise(a) if rng.random() < 0.5] or [(a[0], a[1])])
    order = [a[int(k)] for k in rng.permutation(n)]
    if rng.random() < 0.3:
        b.fixed.append(order[-1])
        b.placed.add(order[-1])
        b.add("FixedAtoms", [], [order[-1:]], atoms=order[-1:])
    for k in range(int(rng.integers(2, n + 1))):
        if order[k] not in b.fixed:
            _place(b, order[k:])
    return a


def _place(b: Builder, a: list[int]) -> None:
    """The first atom on a surface, or the center of all or a combination of them at a place."""
    rng = b.rng
    what = rng.integers(4)
    if what == 0:
        center = b.x[a[0]] + _unit(rng) * rng.uniform(1, 2)
        b.add("Sphere", [Row("norm", [{a[0]: 1.0}], [(0, 0, 0)], place=center)], [a[:1]], atoms=a[:1], center=center)
        b.placed.add(a[0])
    elif what == 1:
        normal = _unit(rng)
        b.add("Plane", [Row("linear", coefficients={a[0]: normal})], [a[:1]], atoms=a[:1], normal=normal)
        b.placed.add(a[0])
    elif what == 2:
        rows = [Row("linear", coefficients={i: axis for i in a}) for axis in np.eye(3)]
        b.add("CenterOfMass", rows, [a], groups=a)
        b.placed.update(a)
    else:
        b.combination(a, rng.normal(size=(len(a), 3)), place=True)
        b.placed.update(a)


def winding(b: Builder) -> list[int]:
    """A chain bonded to its own image: it leads through the boundary and has no whole form."""
    if b.cell is not None:
        raise Unsuitable
    rng = b.rng
    b.cell = random_cell(rng)
    b.cell *= rng.uniform(1.6, 2.2) / half_width(b.cell, np.ones(3, bool))
    axis = int(rng.integers(3))
    n = max(4, int(np.ceil(np.linalg.norm(b.cell[axis]) / rng.uniform(0.7, 1.0))))
    if n > 8:
        raise Unsuitable
    x = np.outer(np.arange(n) / n, b.cell[axis]) + 0.25 * rng.normal(size=(n, 3))
    a = b.atoms(x)
    b.distances(list(itertools.pairwise(a)))
    image = tuple(int(k == axis) * -1 for k in range(3))
    rows = [Row("norm", [{a[-1]: 1.0, a[0]: -1.0}], [image])]
    b.add("Distance", rows, [[a[-1], a[0]]], pairs=[(a[-1], a[0])])
    if rng.random() < 0.4:
        # Around the atom at the seam: from the last atom's image over the first to the second.
        vectors = [{a[-1]: 1.0, a[0]: -1.0}, {a[1]: 1.0, a[0]: -1.0}]
        row = Row("angle", vectors, [image, (0, 0, 0)])
        b.add("Angle", [row], [], triples=[[a[-1], a[0], a[1]]])
    return a


KINDS: dict[str, tuple[float, Callable[[Builder], list[int]]]] = {
    "chain": (3.0, chain),
    "rigid": (2.0, rigid),
    "planar": (2.0, planar),
    "linear": (2.0, linear),
    "site": (2.0, site),
    "combination": (2.0, combination),
    "bend": (1.5, bend),
    "centers": (1.5, centers),
    "gyration": (0.5, gyration),
    "fixed": (1.0, fixed),
    "fixed pair": (0.2, fixed_pair),
    "surface": (1.0, surface),
    "places": (1.0, places),
    "winding": (0.7, winding),
}


def random_cell(rng: np.random.Generator) -> Array:
    """Orthorhombic, triclinic, or so oblique that shorter vectors would span the same lattice; any orientation."""
    skew = rng.choice([0.0, 0.0, 0.45, 0.45, 1.3])
    cell = np.diag(rng.uniform(1.0, 1.8, 3)) + np.tril(rng.uniform(-skew, skew, (3, 3)), -1)
    if skew and rng.random() < 0.5:
        cell = cell @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return cell


def half_width(cell: Array, pbc: Array) -> float:
    """Half the smallest distance between opposite faces, over the periodic directions alone."""
    periodic = cell[pbc]
    widths = []
    for k, a in enumerate(periodic):
        others = np.delete(periodic, k, axis=0).T
        rest = a - others @ np.linalg.lstsq(others, a, rcond=None)[0] if others.size else a
        widths.append(np.linalg.norm(rest))
    return 0.5 * float(min(widths))
