"""Systems that use the kernels which `kcons warmup` compiles."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from kcons import ConstraintSet, Motion, State, System, run
from kcons import constraints as held
from kcons.constraints import Angle, Constraint, Dihedral, Distance
from kcons.constraints.compilation import announcer
from kcons.constraints.target import FloatArray
from kcons.steppers import BlanesMoan6, Rattle, Stepper
from kcons.thermostats import CellRescaling, CellSystem, ConstantPressure, Isokinetic, Langevin, NoseHooverChain

#: As many molecules of a kind as are held eight at a time, and some that are left over; so many that nothing is left to
#: Python.
MANY, LARGE = 19, 400
STEPPERS: tuple[Stepper, ...] = (Rattle(), BlanesMoan6())

TRIANGLE, PAIRS = np.array([[0.0, 0.0, 0.0], [0.96, 0.0, 0.0], [-0.24, 0.93, 0.0]]), [[0, 1], [0, 2], [1, 2]]
ZIGZAG = np.cumsum(np.tile([[0.9, 1.2, 0.1], [1.2, -0.9, 0.4]], (20, 1)), axis=0)


def water() -> None:
    """rigid water and other rigid triangles"""
    _use(TRIANGLE, Distance(PAIRS), copies=MANY)


def bonds() -> None:
    """bond lengths: X-H groups, chains, rings, molecules"""
    tetrahedron = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    for rows in range(1, 7):
        _use(ZIGZAG[: rows + 1], Distance([[k, k + 1] for k in range(rows)]), copies=MANY)
    _use(tetrahedron, Distance([[i, j] for i in range(4) for j in range(i)]), copies=MANY)
    _use(ZIGZAG, Distance([[k, k + 1] for k in range(39)]))
    branches = [[k, k + 1] for k in range(15)] + [[3, 20], [3, 21], [8, 22], [0, 5]]
    for copies in (1, 3, LARGE):
        _use(ZIGZAG, Distance(branches), copies=copies)


def molecules(copies: int = 1) -> None:
    """small molecules with angles, dihedrals and other rows"""
    rows = Distance([[k, k + 1] for k in range(5)]), Angle([[0, 1, 2], [1, 2, 3]]), Dihedral([[0, 1, 2, 3]])
    _use(ZIGZAG[:8], *rows, copies=copies)


def proteins() -> None:
    """the same for many rows"""
    molecules(LARGE)


def surfaces() -> None:
    """particles on surfaces, groups of atoms"""
    origin, up = [-5.0, 0.0, 0.0], [0.0, 0.0, 1.0]
    rows = held.Sphere(0, origin), held.Cylinder(1, origin, up), held.Torus(2, origin, up, 1.0), held.Plane(3, up)
    ellipsoid = held.Ellipsoid(4, origin, [1.0, 2.0, 3.0], target=None)
    _use(ZIGZAG[:10], *rows, ellipsoid, held.CenterDistance([5], [6]), held.RadiusOfGyration([7, 8, 9]))
    _use(ZIGZAG[:3], held.DistanceDifference([[0, 1], [1, 2]]))


def thermostats() -> None:
    """Langevin, isokinetic and Nosé-Hoover dynamics on bond lengths, and a barostat"""
    kinds = Isokinetic(1.0, momentum="free"), NoseHooverChain(1.0, 1.0, momentum="free"), Langevin(1.0, 1.0, 1)
    _use(ZIGZAG[:2], Distance([[0, 1]]), copies=MANY, steppers=kinds)
    x = _copies(ZIGZAG[:2], 2)
    system = CellSystem(Motion(ConstraintSet(Distance([[0, 1], [2, 3]]), x, np.ones(4), cell=100.0 * np.eye(3)), x))
    stepper = ConstantPressure(Langevin(1.0, 1.0, 1), CellRescaling(1.0, 1.0, 1.0, every=1))
    run(system, system.initial_state(x), 1e-3, 1, stepper=stepper)


def ase() -> None:
    """dynamics of ASE"""
    from ase import Atoms, units
    from ase.calculators.lj import LennardJones

    from kcons.ase import ConstrainedLangevin, constrain

    pair = Atoms("N2", [[0.0, 0.0, 0.0], [1.1, 0.0, 0.0]], calculator=LennardJones())
    constrain(pair, [Distance([[0, 1]])])
    ConstrainedLangevin(pair, units.fs, temperature_K=300, friction=0.01 / units.fs, rng=1).run(2)


def check() -> None:
    """kcons check: rigid water and other bond lengths"""
    import MDAnalysis

    from kcons.mdanalysis import ConstraintCheck

    universe = MDAnalysis.Universe.empty(3, trajectory=True)
    universe.atoms.positions, universe.dimensions = TRIANGLE, [40.0, 40.0, 40.0, 90.0, 90.0, 90.0]
    ConstraintCheck(universe, Distance(PAIRS)).run()


def _copies(molecule: FloatArray, copies: int) -> FloatArray:
    """Equal molecules in a line."""
    return np.tile(molecule, (copies, 1)) + np.repeat(np.arange(copies), len(molecule))[:, None] * [0.0, 0.0, 8.0]


def _use(molecule: FloatArray, *rows: Constraint, copies: int = 1, steppers: tuple[Stepper, ...] = STEPPERS) -> None:
    """What is asked of an engine, and some steps, for equal molecules, free and in a cell."""
    n = len(molecule)
    x = _copies(molecule, copies)
    many = list(rows)
    if copies > 1:
        many = [type(item)(np.concatenate([item.atoms + k * n for k in range(copies)])) for item in rows]
    for cell in (None, (np.ptp(x) + 100.0) * np.eye(3)):
        motion = Motion(ConstraintSet(many, x, np.ones(len(x)), cell=cell), x)
        v = motion.project_velocities(x, np.random.default_rng(0).normal(size=x.shape) * 0.01)
        f = np.zeros_like(x)
        motion.constraint_force(x, v, f)
        motion.acceleration(x, v, f)
        motion.restore_positions(x + 1e-3 * v)
        for stepper in steppers:
            end = run(System(motion, lambda y, t: np.zeros_like(y)), State(x, v), 1e-3, 2, stepper=stepper)
            motion.report(end.positions, end.velocities)


def device() -> str:
    """steps on the device: the plugin of OpenMM"""
    from kcons.openmm.device import build

    why = build.refusal()
    if not why and not build.is_built():
        begun = time.perf_counter()
        build.library()
        announcer.seconds += time.perf_counter() - begun
    return why


#: What each returns is why it cannot be compiled here.
KINDS: dict[str, Callable[[], str | None]] = {
    use.__name__: use for use in (molecules, water, bonds, proteins, surfaces, thermostats, ase, check, device)
}
#: Packages that some of them need.
NEEDS = {"check": "MDAnalysis", "device": "openmm"}
