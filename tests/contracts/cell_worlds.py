"""Random molecules in random cells: whole molecules, which are the truth, and what the engine is given of them.

Each molecule is made whole. The engine gets every atom in an image of its own, wrapped into the cell or anywhere,
and rows in the package's words; the oracle gets the whole molecules and rows of its own (`cell_oracle`). Linear and
planar molecules that are held by all their distances have no regular distance rows: the oracle holds them by
distances of two or three atoms and by where the others lie between these.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from cell_molecules import KINDS, Builder, Item, Unsuitable, half_width, random_cell
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
