"""Systems with rows of all kinds that kernels know, each also with its rows left to the engine."""

from __future__ import annotations

import numpy as np

from kcons import ConstraintSet, Motion, State, System
from kcons.constraints import (
    Angle,
    CenterDistance,
    Cylinder,
    Dihedral,
    Distance,
    Ellipsoid,
    FixedAtoms,
    KnifeEdge,
    Plane,
    Sphere,
)

PAIRS = [[0, 1], [0, 2], [1, 2]]
SHAPE = np.array([[0.0, 0, 0], [1.0, 0, 0], [-0.3, 0.9, 0]])


def springs(x, t):
    """Each atom in a harmonic well of its own strength, and an attraction of neighboring molecules."""
    return -np.linspace(0.1, 0.3, len(x))[:, None] * x - 0.05 * (x - np.roll(x, 3, axis=0))


def homing(x, t):
    return -0.1 * (x - x.mean(axis=0))


def started(rows, x, masses, force, rng, *, piecewise=False, away=0.0, **options) -> tuple[System, State]:
    """A system and where it begins; with `piecewise` its rows are left to the engine, with `away` atoms are moved."""
    system = System(Motion(ConstraintSet(rows, x, masses, **options), x), force)
    assert system.packed is not None
    if piecewise:
        system.packed = None
    return system, system.initial_state(x + away, 0.3 * rng.normal(size=x.shape), project=True)


def triangles(n: int = 11, *, ions: int = 0, at: float = 0.0, force=springs, **options) -> tuple[System, State]:
    """Rigid triangles that turn, and free atoms after them; 11 fill one group of lanes and part of a second."""
    rng = np.random.default_rng(3)
    turn = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    x = (np.einsum("ak,nkj->naj", SHAPE, turn) + 3.0 * np.arange(n)[:, None, None] / n).reshape(-1, 3)
    x = np.concatenate([x, rng.normal(size=(ions, 3))]) + at
    masses = np.concatenate([np.tile([16.0, 1.0, 1.0], n), np.full(ions, 23.0)])
    rows = Distance((3 * np.arange(n)[:, None, None] + np.array(PAIRS)).reshape(-1, 2))
    return started([rows], x, masses, force, rng, **options)


#: Pairs and masses of one molecule of each kind.
KINDS = {
    "dumbbells": ([[0, 1]], [1.0, 2.0]),
    "methylene": ([[0, 1], [0, 2]], [12.0, 1.0, 1.0]),
    "methyl": ([[0, 1], [0, 2], [0, 3]], [12.0, 1.0, 1.0, 1.0]),
    "chain": ([[k, k + 1] for k in range(9)], [14.0] * 10),
    "long": ([[k, k + 1] for k in range(59)], [14.0] * 60),
    "longer": ([[k, k + 1] for k in range(149)], [14.0] * 150),
    "ring": ([[k, (k + 1) % 6] for k in range(6)] + [[0, 6]], [12.0] * 6 + [1.0]),
    "tetrahedron": ([[i, j] for i in range(4) for j in range(i)], [1.0, 2.0, 3.0, 4.0]),
    "triangles": (PAIRS, [16.0, 1.0, 1.0]),
}


def molecules(
    *names: str, ions: int = 2, fixed: tuple[int, ...] = (), at=0.0, force=springs, scatter: bool = False, **options
) -> tuple[System, State]:
    """Molecules of some kinds one after another, in places of their own, and free atoms after them."""
    rng = np.random.default_rng(7)
    x, pairs, masses = [], [], []
    for number, name in enumerate(names):
        rows, m = KINDS[name]
        pairs.append(np.array(rows) + sum(map(len, masses)))
        masses.append(m)
        k = np.arange(len(m))
        shape = np.stack([np.cos(k), np.sin(k), 0.1 * k], axis=1)
        if name not in ("chain", "long", "longer"):
            shape = rng.normal(size=(len(m), 3))
        x.append(shape + 0.2 * number)
    x = np.concatenate([*x, rng.normal(size=(ions, 3))]) + at
    if scatter:
        x = x + rng.integers(-1, 2, size=x.shape) * np.diag(options["cell"])
    rows = ([Distance(np.concatenate(pairs))] if pairs else []) + ([FixedAtoms(list(fixed))] if fixed else [])
    return started(rows, x, np.concatenate([*masses, np.full(ions, 23.0)]), force, rng, **options)


BUTANE = np.array([[0.0, 0, 0], [1.5, 0, 0], [2.0, 1.4, 0], [3.5, 1.4, 0.5]])
BONDS = [[0, 1], [1, 2], [2, 3]]
#: Name -> rows on a chain of four atoms and two atoms apart, fixed atoms among them, and further options.
MIXED = {
    "cylinder": ([Cylinder([4], [0.0, 0, 0], [0, 0, 1.0])], {}),
    "two surfaces": ([Ellipsoid([4], [0, 0, 0], [1.0, 2, 3], target=None), Plane([5], [0, 0.6, 0.8])], {}),
    "angles": ([Distance(BONDS), Angle([[0, 1, 2], [1, 2, 3]])], {}),
    "dihedral and a surface": ([Distance(BONDS), Dihedral([[0, 1, 2, 3]]), Sphere([4], [0.0, 0, 0])], {}),
    "distances apart": ([Distance([*BONDS, [4, 5]]), Angle([[0, 1, 2]])], {}),
    "rigid triangles, and a plane": ([Distance([[0, 1], [0, 2], [1, 2]]), Plane([5], [0, 0.6, 0.8])], {}),
    "a blade": ([Distance([4, 5]), KnifeEdge(4, 5, [0, 0.1, 1.0], contact=0.1)], {}),
    "centers": ([CenterDistance([[0, 1], [2, 3]], [[4], [5]])], {}),
    "rows beside fixed atoms": (
        [Distance(BONDS), Angle([[0, 1, 2]]), Sphere([4], [0.0, 0, 0]), FixedAtoms([0, 5])],
        {},
    ),
    "few rows among many": ([Distance([[4, 5]]), Sphere([4], [0.0, 0, 0])], {"ions": 30}),
    "angles in a cell": ([Distance([*BONDS, [4, 5]]), Angle([[0, 1, 2]])], {"cell": np.diag([9.0, 8.0, 7.0])}),
    "far, with an angle": ([Distance(BONDS), Angle([[0, 1, 2]])], {"at": 1e5, "force": homing}),
}


def mixed(name: str, *, ions: int = 0, at: float = 0.0, force=springs, **options) -> tuple[System, State]:
    rng = np.random.default_rng(7)
    x = np.concatenate([BUTANE, [[0.3, 0.2, 4.0], [1.0, 1.0, 5.0]], rng.normal(size=(ions, 3))]) + at
    m = np.concatenate([[12.0, 14.0, 1.0, 16.0, 2.0, 3.0], np.full(ions, 23.0)])
    away = rng.integers(-1, 2, size=x.shape) @ options["cell"] if "cell" in options else 0.0
    return started(MIXED[name][0], x, m, force, rng, away=away, **options)


GROUPS = ["methyl", "methylene", "dumbbells", "methyl", "dumbbells"]
CELL = np.diag([19.0, 18.0, 17.0])
SKEWED = np.array([[19.0, 0, 0], [2.0, 18.0, 0], [1.0, -3.0, 17.0]])
MOLECULES = {
    "many dumbbells": (["dumbbells"] * 30, {}),
    "hydrogens": (GROUPS, {}),
    "chains": (["chain", "long", "dumbbells"], {}),
    "long chains": (["longer", "long", "chain"], {"ions": 0}),
    "long chains, and more": (["longer", "chain", *["triangles"] * 9, *GROUPS], {"fixed": (180,)}),
    "long chains among many": (["longer", "methyl"], {"ions": 300}),
    "far long chains": (["longer"], {"at": 1e5, "force": None}),
    "rings": (["ring", "tetrahedron"], {}),
    "few held among many": (["methyl", "triangles"], {"ions": 30}),
    "fixed atoms": (["chain", "methyl", "triangles", "dumbbells"], {"fixed": (0, 3, 10, 11, 14, 20)}),
    "fixed and nothing else": ([], {"fixed": (1,), "ions": 4}),
    "nothing": ([], {"ions": 4}),
    "periodic": ([*GROUPS, "triangles"], {"cell": CELL, "pbc": True, "scatter": True}),
    "skewed": ([*GROUPS, "triangles"], {"cell": SKEWED, "pbc": True}),
    "far": (GROUPS, {"at": 1e5, "force": None}),
    "far, forced": ([*GROUPS, "triangles"], {"at": 1e4, "force": homing}),
}
TRIANGLES = {
    "water and ions": {"ions": 5},
    "water in a cell": {"cell": np.diag([9.0, 8.0, 7.0]), "pbc": True},
    "water far away": {"at": 1e6, "force": None},
}
NAMES = [*MOLECULES, *TRIANGLES, *MIXED]


def held_system(name: str, **more) -> tuple[System, State]:
    """The system of a name, and where it begins."""
    if name in MOLECULES:
        kinds, options = MOLECULES[name]
        return molecules(*kinds, **{**options, **more})
    if name in TRIANGLES:
        return triangles(**{**TRIANGLES[name], **more})
    return mixed(name, **{**MIXED[name][1], **more})


def one_by_one(stepper, system: System, state: State, dt: float, steps: int) -> State:
    for _ in range(steps):
        state = stepper.step(system, state, dt)
    return state


def assert_same(one: State, two: State) -> None:
    """To the last bit."""
    for name in ("positions", "velocities", "forces", "remainder", "thermostat"):
        a, b = getattr(one, name), getattr(two, name)
        assert (a is None) == (b is None)
        assert a is None or np.array_equal(a, b), name
    assert (one.time, one.time_remainder, one.step) == (two.time, two.time_remainder, two.step)


def distance(a: State, b: State) -> float:
    return max(float(np.abs(a.positions - b.positions).max()), float(np.abs(a.velocities - b.velocities).max()))
