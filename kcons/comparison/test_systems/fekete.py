"""Particles that repel each other on one sphere and are slowed down until they rest: Fekete points (Thomson's problem).

Only the end is known, not the way: for 20 unit charges the least energy is 150.881568334. The error of a method is
therefore how far its energy still is above that.
"""

from __future__ import annotations

import numpy as np

from kcons.comparison.test_systems.potential import Potential
from kcons.comparison.test_systems.sphere import NO_SPHERE
from kcons.comparison.test_systems.system import REDUCED, Reference, TestSystem
from kcons.constraints import Sphere
from kcons.constraints.constraint_set import ConstraintSet
from kcons.constraints.target import FloatArray
from kcons.errors import InputError

#: Least energies of N unit charges on the unit sphere. Wales and Ulker, Phys. Rev. B 74, 212101 (2006), Cambridge
#: Cluster Database, tables of the Thomson problem; here to the last digit, from minimisation with BFGS.
OPTIMA = {4: 3.6742346141747673, 6: 9.985281374238571, 12: 49.165253057862714, 20: 150.8815683337565}
#: Close to twice the frequency of the softest mode (0.40 for 20 particles): critical damping.
FRICTION = 0.8
#: Of the energy, relative: less cannot be told from nothing.
ROUNDING = 1e-14
#: No two particles start closer than this, as a fraction of sqrt(4 pi/N).
APART = 0.6


def build(size: int = 20, seed: int = 1) -> TestSystem:
    """`size` particles at rest at random places of the unit sphere.

    Parameters
    ----------
    size : int
        A key of `OPTIMA`.
    seed : int
        Of the places.

    Raises
    ------
    InputError
        No optimum is known for this size.
    """
    if size not in OPTIMA:
        known = ", ".join(map(str, OPTIMA))
        raise InputError(f"the optimum is known for {known} particles, not for {size}", item="size")
    x = _scattered(size, np.random.default_rng(seed))
    potential = Potential(repulsion, "1/r")

    def above(positions: FloatArray) -> float:
        return max(abs(repulsion(positions)[0] - OPTIMA[size]), ROUNDING * OPTIMA[size])

    def optimum(time: float) -> Reference:
        return Reference(x, ROUNDING * OPTIMA[size], f"the least energy known, {OPTIMA[size]:.13g}")

    return TestSystem(
        name="fekete",
        title=f"{size} particles repel each other on a sphere, friction {FRICTION:g}; error: energy above the optimum",
        constraint_set=ConstraintSet(Sphere(np.arange(size), np.zeros(3), 1.0), x, np.ones(size)),
        positions=x,
        velocities=np.zeros_like(x),
        potential=potential,
        symbols=["X"] * size,
        # Until rounding is all that is left.
        horizon=64.0,
        time_steps=(0.32, 0.16, 0.08, 0.04),
        tolerances=(1e-2, 1e-4, 1e-6),
        units=REDUCED,
        refusals={"ase-bonds": NO_SPHERE, "ase-internals": NO_SPHERE},
        solution=optimum,
        friction=FRICTION,
        shortfall=above,
    )


def repulsion(x: FloatArray) -> tuple[float, FloatArray]:
    """Energy sum 1/r over pairs, and forces, shape (n, 3)."""
    d = x[:, None] - x
    r = np.sqrt(np.sum(d * d, axis=2))
    np.fill_diagonal(r, np.inf)
    inverse = 1.0 / r
    return 0.5 * float(inverse.sum()), np.einsum("ij,ijk->ik", inverse**3, d)


def _scattered(size: int, rng: np.random.Generator) -> FloatArray:
    """Random points of the unit sphere, none close to another, shape (size, 3)."""
    least = APART * np.sqrt(4.0 * np.pi / size)
    found: list[FloatArray] = []
    while len(found) < size:
        n = rng.standard_normal(3)
        n /= np.linalg.norm(n)
        if all(np.linalg.norm(n - other) > least for other in found):
            found.append(n)
    return np.array(found)
