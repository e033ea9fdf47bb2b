"""Random molecules in random cells: whole molecules, which are the truth, and what the engine is given of them.

Each molecule is made whole. The engine gets every atom in an image of its own, wrapped into the cell or anywhere,
and rows in the package's words; the oracle gets the whole molecules and rows of its own (`cell_oracle`). Linear and
planar molecules that are held by all their distances have no regular distance rows: the oracle holds them by
distances of two or three atoms and by where the others lie between these.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from cell_oracle import Array, Dense, Row, wave

from kcons import constraints as families

#: Condition of the row-normalized B up to which cases are made; singular values below DEPENDENT are exact zeros.
WORST_CONDITION = 300.0
DEPENDENT = 1e-10
#: Shares of half the cell above which a refusal is justified: of links that may grow, and of those that cannot.
NEAR_FREE, NEAR_TIED = 0.75, 0.95
STEPPERS = (
    *("Rattle",) * 8,
    *("Geodesic2", "Geodesic3", "Suzuki4", "Yoshida4", "KahanLi6", "BlanesMoan4", "ProjectedVerlet", "ProjectedVerlet"),
)


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


# -- worlds -----------------------------------------------------------------------------------------


@dataclass
class World:
    """One random system: whole molecules on their rows, with tangent velocities.

    `images` says in which image the engine gets each atom; those that are `placed` are held at a place in space, and
    must not change it. `impossible` is a row between fixed atoms that moves by itself, which must be refused;
    `drifting` are members that nothing ties and that fly apart.
    """

    kinds: list[str]
    x: Array
    v: Array
    masses: Array
    images: Array
    cell: Array
    pbc: Array
    items: list[Item]
    rows: Dense
    placed: Array
    impossible: bool
    drifting: bool
    flat: bool
    springs: Array
    anchors: Array
    stepper: str
    dt: float
    steps: int

    @property
    def families(self) -> list[str]:
        return sorted({i.family + (" moving" if i.how == "moving" else "") for i in self.items if i.family})

    def stored(self, x: Array | None = None, images: Array | None = None, cell: Array | None = None) -> Array:
        """Positions as the engine gets them."""
        return (self.x if x is None else x) + (self.images if images is None else images) @ (
            self.cell if cell is None else cell
        )

    @property
    def elsewhere(self) -> bool:
        """Whether atoms that keep to a place do so in another image than that of the whole molecule."""
        return bool(np.any(self.images[self.placed]))

    def constraints(self) -> list[families.Constraint]:
        """The rows in the package's words; new objects at each call."""
        return [_constraint(item, self) for item in self.items if item.family]

    def links(self, x: Array, cell: Array | None = None, every: bool = False) -> tuple[float, float]:
        """The longest vectors whose image is taken as the shortest one, in units of half the cell's width.

        First between neighbors in a row (`every`: any two atoms of a row) that nothing ties, then of what ties: for
        each molecule the longest of the shortest distances that make it whole, and bonds through the boundary.
        """
        cell = self.cell if cell is None else cell
        half = half_width(cell, self.pbc)
        free, parent, tied = 0.0, *self.bodies(x, cell)
        for item in self.items:
            for i, j in _loose_pairs(item, every):
                if _root(parent, i) != _root(parent, j):
                    free = max(free, float(np.linalg.norm(x[i] - x[j])))
        return free / half, tied / half

    def bodies(self, x: Array, cell: Array) -> tuple[list[int], float]:
        """Which atoms distances tie together, as a forest of parents, and the longest vector that this needs."""
        tied, parent = 0.0, list(range(len(x)))
        bonds = [(r, *r.vectors[0]) for i in self.items for r in _tying(i)]
        for length, i, j in sorted((row_length(r, x, cell), i, j) for r, i, j in bonds):
            a, b = _root(parent, i), _root(parent, j)
            if a != b:
                parent[a] = b
                tied = max(tied, length)
        for item in self.items:
            for row in item.rows:
                if row.images and np.any(row.images):
                    tied = max(tied, row_length(row, x, cell))
        return parent, tied

    def nearness(self, x: Array, cell: Array | None = None, every: bool = False) -> float:
        """Above 1, a refusal since half the cell is near is justified."""
        free, tied = self.links(x, cell, every)
        return max(free / NEAR_FREE, tied / NEAR_TIED)

    @property
    def features(self) -> list[str]:
        """What is special about this case."""
        half = half_width(self.cell, self.pbc)
        lengths = [r.target for i in self.items if i.family == "Distance" for r in i.rows]
        longest = max(lengths, default=0.0)
        angles = self.cell @ self.cell.T
        found = {
            "longer than half the cell": longest > half,
            "longer than the cell": longest > 2 * half,
            "oblique": bool(np.abs(angles - np.diag(np.diag(angles))).max() > 1e-9),
            "partly periodic": not self.pbc.all(),
            "moving target": any(i.how == "moving" for i in self.items),
            "set-up beyond half the cell": max(self.links(self.x)) >= 1,
            "drifting": self.drifting,
            "converted rows": self.flat,
            "fixed atoms": len(self.rows.pinned) > 0,
            "far images": bool(np.abs(self.images).max() > 5),
            "wrapped or elsewhere": bool(np.any(self.images)),
            "places in other images": self.elsewhere,
            "free links": self.links(self.x)[0] > 0,
        }
        return [name for name, present in found.items() if present]


def _loose_pairs(item: Item, every: bool) -> Iterator[tuple[int, int]]:
    """Pairs of atoms of rows that depend on differences of positions, but for distances."""
    if item.family in ("FixedAtoms", "Sphere", "Plane", "CenterOfMass", "Distance") or "place" in item.arguments:
        return
    for atoms in item.listed:
        yield from itertools.combinations(atoms, 2) if every else itertools.pairwise(atoms)


def _tying(item: Item) -> list[Row]:
    return [r for r in item.rows if not np.any(r.images)] if item.family == "Distance" else []


def row_length(row: Row, x: Array, cell: Array) -> float:
    d = sum(w * x[a] for a, w in row.vectors[0].items())
    return float(np.linalg.norm(d + (np.array(row.images[0]) @ cell if row.images else 0.0)))


def _root(parent: list[int], i: int) -> int:
    while parent[i] != i:
        i = parent[i]
    return i


def _constraint(item: Item, world: World) -> families.Constraint:
    """The package's object of an item."""
    arguments = {k: v for k, v in item.arguments.items() if k != "place"}
    make = getattr(families, item.family)
    moved = world.images @ world.cell
    if item.family == "FixedAtoms":
        atoms = np.asarray(arguments["atoms"])
        slots = np.searchsorted(world.rows.pinned, atoms)
        places, waves = world.rows.places[slots] + moved[atoms], world.rows.waves[:, slots]
        if item.how == "moving":
            return make(atoms, _moving(places, waves))
        return make(atoms, None if item.how == "open" else places)
    rows = item.rows
    values = np.array([r.target for r in rows])
    if item.family == "Sphere":
        arguments["center"] = arguments["center"] + moved[arguments["atoms"][0]]
    elif item.family in ("Plane", "CenterOfMass") or "place" in item.arguments:
        values = values + [sum(c @ moved[a] for a, c in r.coefficients.items()) for r in rows]
    target = None
    if item.how == "given":
        target = values
    elif item.how == "moving":
        target = _moving(values, np.array([[r.amplitude, r.omega, r.phase] for r in rows]).T)
    name = "radius" if item.family == "Sphere" else "offset" if item.family == "Plane" else "target"
    if item.family == "CenterOfMass" and target is not None and item.how == "given":
        target = values.reshape(1, -1)
    return make(**arguments, **{name: target})


def _moving(values: Array, waves: Array) -> families.MovingTarget:
    return families.MovingTarget(
        lambda t: values + wave(*waves, t), lambda t: wave(*waves, t, 1), lambda t: wave(*waves, t, 2)
    )


def world(seed: int) -> World:
    """The system of this number; the same at every call."""
    for attempt in range(200):
        try:
            return _world(np.random.default_rng([20261122, seed, attempt]))
        except Unsuitable:
            continue
    raise RuntimeError(f"no system for seed {seed}")


def _world(rng: np.random.Generator) -> World:
    b = Builder(rng)
    names = list(KINDS)
    chances = np.array([KINDS[k][0] for k in names])
    for _ in range(int(rng.choice([1, 1, 2, 2, 3]))):
        name = str(rng.choice(names, p=chances / chances.sum()))
        first = len(b.x)
        KINDS[name][1](b)
        if len(b.x) > 14 and first:
            raise Unsuitable
        b.kinds.append(name)
    if len(b.x) < 3 or len(b.x) > 14:
        raise Unsuitable
    spectators = int(rng.integers(1, 9)) if rng.random() < 0.3 else 0
    if spectators:
        # Atoms that no row touches; where they are many, the engine works on a copy of the others.
        b.atoms(rng.uniform(-4, 4, (spectators * int(rng.choice([1, 4])), 3)))
    return _finished(b)


def _finished(b: Builder) -> World:
    rng = b.rng
    n = len(b.x)
    order = rng.permutation(n) if rng.random() < 0.5 else np.arange(n)
    x = np.empty((n, 3))
    x[order] = np.array(b.x)
    masses = 10 ** rng.uniform(0, rng.choice([0.0, 1.0, 2.0]), n)
    if rng.random() < 0.05:
        masses = 10 ** rng.uniform(-2, 4, n)
    items = [_renumbered(item, order) for item in b.items]
    for item in items:
        _weigh(item, masses)
    placed = np.zeros(n, bool)
    placed[[int(order[i]) for i in b.placed]] = True
    pinned = np.sort(np.array([int(order[i]) for i in b.fixed], dtype=np.int64))
    waves = np.zeros((3, len(pinned), 3))
    moving_points = {
        int(i) for it in items if it.family == "FixedAtoms" and it.how == "moving" for i in it.arguments["atoms"]
    }
    for slot, atom in enumerate(pinned):
        if int(atom) in moving_points:
            waves[:, slot] = [rng.uniform(-0.2, 0.2, 3), rng.uniform(0.5, 3, 3), rng.uniform(0, 6, 3)]
    drifting = bool(b.outward) and rng.random() < 0.2
    cell, pbc = b.cell, np.ones(3, bool)
    if cell is None:
        cell = random_cell(rng)
        if rng.random() < 0.4:
            pbc = rng.permutation([True, bool(rng.random() < 0.5), False])
    rows = Dense([r for i in items if i.held for r in i.rows], masses, cell, pinned, x[pinned], waves)
    w = World(b.kinds, x, x, masses, np.zeros((n, 3), int), cell, pbc, items, rows, placed, b.impossible, drifting,
              b.flat, x, x, "Rattle", 0.01, 1)  # fmt: skip
    _scale_cell(w, rng, b.cell is not None)
    rows.set_cell(w.cell)
    _settle_meaning(w)
    _set_targets(w, rng)
    s = _singular_values(rows, x)
    if np.any((s > DEPENDENT) & (s < s.max(initial=0.0) / WORST_CONDITION)):
        raise Unsuitable
    if np.sum(s >= DEPENDENT) == 3 * (n - len(pinned)):
        raise Unsuitable  # nothing can move, and a speed of 0 is no measure of what rounds
    if np.any(s < DEPENDENT) and (np.any(rows.waving[0]) or np.any(waves)):
        raise Unsuitable  # rows that depend on each other contradict each other once one of them moves
    if not b.impossible and np.any(np.abs(rows.value(x, 0.0)) > 1e-12):
        raise Unsuitable
    _store(w, rng)
    speed = rng.uniform(0.1, 1.0)
    v = speed * rng.normal(size=x.shape) / np.sqrt(masses)[:, None]
    w.dt = float(10 ** rng.uniform(-2.7, -1.3)) / speed
    w.steps = int(rng.integers(1, 5))
    w.stepper = str(rng.choice(STEPPERS))
    if w.stepper == "ProjectedVerlet" and (b.flat or np.any(s < DEPENDENT) or b.impossible):
        w.stepper = "Rattle"  # rows that depend on each other contradict each other off the surface
    if w.stepper in ("KahanLi6", "BlanesMoan4"):
        w.steps = min(w.steps, 2)
    if drifting:
        for i, j in b.outward:
            i, j = order[i], order[j]
            away = (x[i] - x[j]) / np.linalg.norm(x[i] - x[j])
            v[i], v[j] = v[i] + speed * away, v[j] - speed * away
        w.stepper, w.steps = "Rattle", 40
        w.dt = rng.uniform(0.3, 1.2) * half_width(w.cell, w.pbc) / (40 * speed)
    w.v = rows.velocities(x, v, 0.0)
    w.springs = rng.uniform(0, 2, (n, 1)) * (0.0 if drifting else 1.0)
    w.anchors = x + 0.3 * rng.normal(size=x.shape)
    return w


def _renumbered(item: Item, new: Array) -> Item:
    changed = dict(item.arguments)
    for name in ("pairs", "triples", "quads", "atoms", "bases", "group_a", "group_b", "groups"):
        if name in changed:
            changed[name] = _mapped(changed[name], new)
    rows = [r.renumbered(new) for r in item.rows]
    return replace(item, rows=rows, listed=_mapped(item.listed, new), arguments=changed)


def _mapped(table, new: Array):
    return [_mapped(t, new) for t in table] if isinstance(table, list | tuple) else int(new[table])


def _weigh(item: Item, masses: Array) -> None:
    """Weights of centers of mass, known once the masses are."""
    if item.family == "CenterDistance":
        vector = item.rows[0].vectors[0]
        for sign in (1.0, -1.0):
            group = [a for a, w in vector.items() if np.sign(w) == sign]
            for a in group:
                vector[a] = sign * masses[a] / masses[group].sum()
    elif item.family == "CenterOfMass":
        for row in item.rows:
            total = masses[list(row.coefficients)].sum()
            row.coefficients = {a: c * masses[a] / total for a, c in row.coefficients.items()}
    elif item.family == "RadiusOfGyration":
        vector = item.rows[0].vectors[0]
        weight = masses if item.arguments["mass_weighted"] else np.ones(len(masses))
        total = weight[list(vector)].sum()
        item.rows[0].vectors[0] = {a: float(weight[a] / total) for a in vector}


def _scale_cell(w: World, rng: np.random.Generator, settled: bool) -> None:
    """Let the longest link be this share of half the cell: a small one, nearly all, or more than all."""
    link = max(w.links(w.x))
    if settled:
        if link > 0.8:
            raise Unsuitable
        return
    share = rng.uniform(0.3, 0.8) if rng.random() > 0.03 else rng.uniform(1.02, 1.3)
    if w.drifting:
        share = rng.uniform(0.3, 0.6)
    half = link * half_width(w.cell, w.pbc) / share if link > 0 else rng.uniform(2, 5)
    w.cell = w.cell * (half / half_width(w.cell, w.pbc))


def _settle_meaning(w: World) -> None:
    """Leave out what no one could tell from the rows.

    A row within a molecule, two atoms of which are as near through the boundary as bonds are, may mean the one or the
    other; a distance says which by its target. So does one longer than half the cell.
    """
    free, tied = w.links(w.x)
    parent, longest = w.bodies(w.x, w.cell)
    half = half_width(w.cell, w.pbc)
    if free >= 1:
        raise Unsuitable
    for item in w.items:
        if item.family == "Distance":
            pairs = [tuple(r.vectors[0]) for r in _tying(item)]
        else:
            pairs = list(_loose_pairs(item, every=True))
        for i, j in pairs:
            if _root(parent, i) != _root(parent, j):
                continue
            d = w.x[j] - w.x[i]
            near = shortest(d, w.cell, w.pbc)
            if np.linalg.norm(near) < np.linalg.norm(d) - 1e-9 and np.linalg.norm(near) <= 1.6 * longest:
                if item.family != "Distance" or item.how == "moving":
                    raise Unsuitable
                item.how = "given"
        if tied >= 1 and item.family == "Distance":
            if item.how == "moving":
                raise Unsuitable
            item.how = "given"
    if tied >= 1 and longest < half:
        raise Unsuitable


def shortest(d: Array, cell: Array, pbc: Array) -> Array:
    """The shortest periodic image of a vector, by trying all."""
    images = d + _NEAR[np.all((_NEAR == 0) | pbc, axis=1)] @ cell
    return images[np.argmin(np.einsum("ki,ki->k", images, images))]


_NEAR = np.array(list(itertools.product(range(-3, 4), repeat=3)))


def _set_targets(w: World, rng: np.random.Generator) -> None:
    rows, q = w.rows, w.rows.measure(w.x)
    for k, row in enumerate(rows.rows):
        row.target = float(q[k])
    for item in w.items:
        for row in () if item.held else item.rows:
            row.target = row_length(row, w.x, w.cell)
        if item.how == "moving":
            for row in item.rows:
                row.amplitude = float(rng.uniform(-0.08, 0.08))
                row.omega, row.phase = float(rng.uniform(0.5, 3)), float(rng.uniform(0, 6))
    rows.waving = np.array([[r.amplitude, r.omega, r.phase] for r in rows.rows]).reshape(-1, 3).T
    rows.targets = q


def _singular_values(rows: Dense, x: Array) -> Array:
    b = rows.jacobian(x) * rows.root
    size = np.linalg.norm(b, axis=1, keepdims=True)
    s = np.linalg.svd(b[size[:, 0] > 0] / size[size[:, 0] > 0], compute_uv=False)
    return s if s.size else np.ones(1)


def _store(w: World, rng: np.random.Generator) -> None:
    """In which images the engine gets the atoms."""
    how = rng.random()
    n = len(w.x)
    if how < 0.5:
        w.images = wrapping(w.x, w.cell, w.pbc)
    elif how < 0.9:
        w.images = rng.integers(-2, 3, (n, 3))
    elif how < 0.95:
        w.images = rng.integers(-40, 41, (n, 3))
    kept = w.placed & (rng.random() < 0.3)
    w.images = np.where(kept[:, None] | ~w.pbc, 0, w.images)


def wrapping(x: Array, cell: Array, pbc: Array) -> Array:
    """Images that bring each atom into the cell."""
    return np.where(pbc, -np.floor(np.linalg.solve(cell.T, x.T).T), 0).astype(int)
