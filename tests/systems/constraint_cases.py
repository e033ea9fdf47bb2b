"""One object of every family, several rows each where that is possible, over eight atoms; and values of coordinates.

`CASES` maps a name to a function that builds the object, `VALUES` to an object, a place, and what its coordinate is
there by other means; `scattered` gives positions at which no row is close to singular.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from kcons import constraints as kc

N_ATOMS = 8
MASSES = np.array([1.0, 12.0, 16.0, 1.0, 14.0, 32.0, 2.0, 19.0])
TIME = 0.7


def scattered(seed: int) -> np.ndarray:
    """Random positions, atoms at least 0.8 apart and no three neighbors in the list nearly in a line."""
    rng = np.random.default_rng(seed)
    while True:
        x = rng.uniform(-2.0, 2.0, size=(N_ATOMS, 3))
        apart = np.linalg.norm(x[:, None] - x[None], axis=2)[np.triu_indices(N_ATOMS, 1)]
        u = x[:, None] - x[None]
        unit = u / np.maximum(np.linalg.norm(u, axis=2), 1e-9)[..., None]
        sines = np.linalg.norm(np.cross(unit[:, :, None], unit[:, None]), axis=3)
        off = ~np.eye(N_ATOMS, dtype=bool)
        bent = sines[off[:, :, None] & off[:, None] & off[None]].min()
        if apart.min() > 0.8 and bent > 0.2 and np.linalg.norm(x[:, :2], axis=1).min() > 0.4:
            return x


def _rotation() -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))
    return q


def spread(atoms: object, *, given: bool = True) -> kc.Custom:
    """exp(-|r_0 - r_1|^2/8) + |r_1 - r_2|^2/5, its gradient given or not."""

    def function(r):
        return np.exp(-np.sum((r[0] - r[1]) ** 2) / 8) + np.sum((r[1] - r[2]) ** 2) / 5

    def gradient(r):
        a, b = r[0] - r[1], r[1] - r[2]
        first, second = -a / 4 * np.exp(-a @ a / 8), 2 * b / 5
        return np.array([first, second - first, -second])

    return kc.Custom(atoms, function, gradient if given else None, translation_invariant=True)


#: Across the blade and in the plane that it glides on, of any length; (a, b, c) is normal to this.
_SIDE = "(b*(z2 - z1) - c*(y2 - y1))", "(c*(x2 - x1) - a*(z2 - z1))", "(a*(y2 - y1) - b*(x2 - x1))"
_SIDEWAYS = " + ".join(f"{n}*(v{q}1 + s*(v{q}2 - v{q}1))" for n, q in zip(_SIDE, "xyz", strict=True))
BLADE = f"({_SIDEWAYS})/sqrt({' + '.join(f'{n}**2' for n in _SIDE)})"


def blade(ends: object, normal: object = (0.0, 0.0, 1.0), contact: object = 0.0) -> kc.VelocityFormula:
    """A knife edge from its back to its front, which touches at `contact` between them and does not glide sideways."""
    return kc.VelocityFormula(BLADE, ends, {**dict(zip("abc", normal, strict=True)), "s": contact})


CASES: dict[str, Callable[[], kc.Constraint]] = {
    "Distance": lambda: kc.Distance([[0, 1], [2, 3], [7, 1]]),
    "Distance moving": lambda: kc.Distance([[4, 6], [5, 0]], lambda t: [1 + 0.1 * np.sin(t), 2.0]),
    "DistanceDifference": lambda: kc.DistanceDifference([[3, 5], [5, 6]]),
    "DistanceDifference of a star and a pair": lambda: kc.DistanceDifference(
        [[1, 0], [1, 2], [7, 1], [4, 6]], weights=[1.0, -0.5, 2.0, -1.0]
    ),
    "DistanceDifference around a ring, moving": lambda: kc.DistanceDifference(
        [[0, 1], [1, 2], [2, 0]], lambda t: 4.0 + 0.1 * np.sin(t), weights=[1.0, -1.0, 1.5]
    ),
    "Angle": lambda: kc.Angle([[0, 1, 2], [3, 4, 5], [7, 1, 6]]),
    "Dihedral": lambda: kc.Dihedral([[0, 1, 2, 3], [7, 6, 2, 4]]),
    "Sphere": lambda: kc.Sphere([0, 3], [[0.1, 0.2, -0.3], [1.0, 0.0, 3.0]]),
    "Torus": lambda: kc.Torus([1, 2, 5], [0.1, 0.0, 0.2], [0.1, 0.2, 1.0], [1.5, 0.9, 3.0]),
    "Ellipsoid": lambda: kc.Ellipsoid([4, 5], [0.1, 0.2, 0.3], [1.0, 2.0, 3.0], _rotation(), target=None),
    "Elliptic cylinder": lambda: kc.Ellipsoid([4, 5], [0.0, 0.0, 0.0], [1.0, np.inf, 3.0], target=None),
    "Plane": lambda: kc.Plane([0, 1], [[1.0, 2.0, 3.0], [0.0, 0.0, 1.0]], offset=[0.2, -0.4]),
    "Line": lambda: kc.Line([3, 4], [0.1, 0.2, 0.3], [1.0, 1.0, -0.5]),
    "CenterOfMass": lambda: kc.CenterOfMass([[0, 1, 2], [3, 4, 5]], axes=(0, 2)),
    "CenterDistance": lambda: kc.CenterDistance([[0, 1, 2], [3, 4, 5]], [[3, 4], [6, 7]]),
    "RadiusOfGyration": lambda: kc.RadiusOfGyration([[0, 1, 2, 3], [4, 5, 6, 7]]),
    "RadiusOfGyration equal weights": lambda: kc.RadiusOfGyration([0, 1, 2, 3, 5], mass_weighted=False),
    "Custom": lambda: spread([[0, 1, 2], [5, 3, 4]]),
    "Custom without a gradient": lambda: spread([[0, 1, 2], [5, 3, 4]], given=False),
    "Formula": lambda: kc.Formula("z1*exp(x1/4) - a*sin(b*y1)", [0, 3], {"a": 0.4, "b": [1.0, 2.0]}, target=None),
    "Formula of differences": lambda: kc.Formula(
        "atan2(x1 - x2, y2 - y3) + abs(z1 - z3 + 9)**1.5 - sqrt((x1 - x3)**2 + (z2 - z1)**2)/3",
        [[0, 1, 2], [5, 3, 4]],
        target=None,
    ),
    "Formula moving": lambda: kc.Formula("(x1 - x2)**2 + sin(z1)*cos(w*t)/(2 + x1**2) - t**3", [0, 1], {"w": 0.8}),
    "LinearCombination": lambda: kc.LinearCombination([[0, 1], [5, 2]], [[1.0, 2.0, 0.0], [0.0, -1.0, 3.0]]),
    "LinearRelation": lambda: kc.LinearRelation([0, 3], [1, 2], [0.3, 0.7]),
    "FixedAtoms": lambda: kc.FixedAtoms([6, 1]),
    "FixedAtoms moving": lambda: kc.FixedAtoms([6, 1], lambda t: [[np.sin(t), 0.0, 0.0], [0.0, t**2, np.cos(t)]]),
    "VelocityFormula": lambda: kc.VelocityFormula(
        "vz1 - a*sin(b*y1)*vx1 + x1*vy1", [0, 3], {"a": 0.4, "b": [1.0, 2.0]}
    ),
    "VelocityFormula of differences": lambda: kc.VelocityFormula(
        "((x1 - x2)*(vy1 - vy2) - (y1 - y2)*vx1)/sqrt((x1 - x2)**2 + (y1 - y2)**2 + 1)", [[1, 2], [5, 6]]
    ),
    "VelocityFormula moving": lambda: kc.VelocityFormula(
        "cos(w*t)*vx1 + sin(w*t - z1)*vy2", [0, 1], {"w": 0.8}, np.sin
    ),
    "blade": lambda: blade([[0, 1], [3, 4]], [[0.0, 0.2], [0.0, 0.1], [1.0, 1.0]], contact=[0.0, 0.3]),
}

ORIGIN, UP = [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]
#: Chlorine, hydrogen, bromine: 5 apart, then 12.
TRANSFER = [[0, 1], [1, 2]]
APART = np.array([ORIGIN, [3.0, 4.0, 0.0], [3.0, 4.0, 12.0]])


def bent(degrees: float, first: float = 1.0, last: float = 1.0) -> np.ndarray:
    """Three atoms with the vertex at the origin."""
    theta = np.radians(degrees)
    return np.array([[first, 0, 0], [0, 0, 0], [last * np.cos(theta), last * np.sin(theta), 0]])


def twisted(degrees: float) -> np.ndarray:
    phi = np.radians(degrees)
    return np.array([[1.0, 0, -0.3], [0, 0, 0], [0, 0, 1.0], [np.cos(phi), np.sin(phi), 1.4]])


def on_ellipsoid(axes: list[float], rotation: np.ndarray) -> np.ndarray:
    y = np.random.default_rng(1).normal(size=3)
    return np.array([[0.5, 0.1, 0.2] + rotation @ (y / np.linalg.norm(y) * axes)])


ROTATION = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
SCATTERED = scattered(0)
TURNS = (-179.99, -90, -0.001, 0, 180)
#: What is held, where, and what the coordinate is there.
VALUES = {
    "distance": (kc.Distance([0, 1]), APART, [5.0]),
    "difference": (kc.DistanceDifference(TRANSFER, weights=[2.0, -1.0]), APART, [-2.0]),
    **{f"angle {a}": (kc.Angle([0, 1, 2]), bent(a, 1.3, 0.7), [np.radians(a)]) for a in (0.001, 20, 109.5, 179.9999)},
    **{f"dihedral {a}": (kc.Dihedral([0, 1, 2, 3]), twisted(a), [np.radians(a)]) for a in TURNS},
    "sphere": (kc.Sphere(0, [1.0, 0.0, 0.0]), [[1.0, 3.0, 4.0]], [5.0]),
    "cylinder": (kc.Ellipsoid(0, [0.0, 0.0, 7.0], [2.0, 2.0, np.inf]), [[3.0, 4.0, -100.0]], [3.0]),
    "torus": (kc.Torus(0, UP, [0.0, 0.0, 2.0], 3.0), [[0.0, 5.0, 2.5]], [2.5]),
    "torus, inside": (kc.Torus(0, UP, [0.0, 0.0, 2.0], 3.0), [[0.0, 2.5, 1.0]], [0.5]),
    "ellipsoid": (kc.Ellipsoid(0, [0.5, 0.1, 0.2], [1, 2, 4], ROTATION), on_ellipsoid([1, 2, 4], ROTATION), [0.0]),
    "ellipsoid, outside": (kc.Ellipsoid(0, ORIGIN, [1.0, 2.0, 4.0]), [[0.0, 0.0, 8.0]], [4 / math.sqrt(7)]),
    "elliptic cylinder": (
        kc.Ellipsoid(0, ORIGIN, [2.0, np.inf, 0.5]), [[2.0 * np.cos(0.3), 17.0, 0.5 * np.sin(0.3)]], [0.0]
    ),
    "plane": (kc.Plane(0, [0.0, 3.0, 4.0]), [[9.0, 5.0, 5.0]], [7.0]),
    "fixed": (kc.FixedAtoms([2, 0]), APART, [3, 4, 12, 0, 0, 0]),
    "combination": (kc.LinearCombination([0, 1], [[1.0, 2.0, 0.0], [0.0, -1.0, 3.0]]), APART, [-4.0]),
    "relation": (kc.LinearRelation([0], [1, 2], [0.25, 0.75]), APART, [-3.0, -4.0, -9.0]),
    "centers": (
        kc.CenterDistance([0, 1, 2], [5, 7]), SCATTERED,
        [math.dist(*(MASSES[g] @ SCATTERED[g] / MASSES[g].sum() for g in ([0, 1, 2], [5, 7])))],
    ),
    "center of mass": (
        kc.CenterOfMass([[0, 1, 2], [5, 3, 4]], axes=(2, 0)), SCATTERED,
        [MASSES[g] @ SCATTERED[g, axis] / MASSES[g].sum() for g in ([0, 1, 2], [5, 3, 4]) for axis in (2, 0)],
    ),
    "formula": (kc.Formula("sqrt((sqrt((x1 - a)**2 + (y1 + 0.1)**2) - R)**2 + (z1 - c)**2)", [4],
                        {"a": 0.2, "R": 1.5, "c": 0.3}, None), SCATTERED,
                [math.hypot(math.hypot(SCATTERED[4, 0] - 0.2, SCATTERED[4, 1] + 0.1) - 1.5, SCATTERED[4, 2] - 0.3)]),
    "gyration": (
        kc.RadiusOfGyration([0, 1, 2]), SCATTERED,
        [np.sqrt(np.cov(SCATTERED[:3].T, aweights=MASSES[:3], ddof=0).trace())],
    ),
    "gyration, equal weights": (
        kc.RadiusOfGyration([0, 1, 2], mass_weighted=False), SCATTERED, [np.sqrt(SCATTERED[:3].var(axis=0).sum())]
    ),
}  # fmt: skip
