"""Short trajectories of everything that can be held and every way to run it, as hashes of the states they end in.

A change that is not meant to change what is computed must leave every one of them as it was::

    python tests/contracts/same_trajectories.py --against HEAD

runs this file here and on a clean checkout of a commit, prints what differs, and exits with 1 if anything does. Only
public names are imported, so that commits with another layout can run it. The checkout stays in the folder for
temporary files, with the kernels that were compiled there: the first comparison with a commit takes minutes, later
ones half of one. Another processor gives other hashes, so that none are kept.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tarfile
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path

# Sums by several threads may be taken in another order.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OPENMM_CPU_THREADS", "1")

import numpy as np

import kcons
from kcons import ConstraintSet, Motion, Rattle, State, System, run
from kcons.constraints import (
    Angle,
    CenterDistance,
    Custom,
    Dihedral,
    Distance,
    FixedAtoms,
    KnifeEdge,
    MovingTarget,
    Plane,
    RadiusOfGyration,
    Sphere,
)
from kcons.errors import KconsError
from kcons.steppers import (
    BlanesMoan4,
    BlanesMoan6,
    BlanesMoan6a,
    Geodesic,
    KahanLi6,
    ReversibilityCheck,
    Splitting,
    Suzuki4,
    Yoshida4,
)
from kcons.thermostats import Isokinetic, Langevin, NoseHooverChain, TemperatureSplit, thermal_velocities

ROOT = Path(__file__).resolve().parents[2]
STEPPERS = [
    *(Rattle(), Geodesic(4), Yoshida4(), Suzuki4(), KahanLi6()),
    *(BlanesMoan4(), BlanesMoan6(), BlanesMoan6a()),
    Splitting((1.0,), (0.5, 0.5)),
]
FEW = [Rattle(), Geodesic(3), Suzuki4(), BlanesMoan4(), BlanesMoan6a()]
ONLY_COMPOSED = [Rattle(), Geodesic(3), Suzuki4(), KahanLi6()]

Built = tuple[System, State]


# -- systems ----------------------------------------------------------------------------------------


def springs(x, t):
    """Each atom in a harmonic well of its own strength, and an attraction of neighbors."""
    return -np.linspace(0.1, 0.3, len(x))[:, None] * x - 0.05 * (x - np.roll(x, 3, axis=0))


def dragged(x, v, t):
    """Springs, drag that is not linear, and a magnetic field."""
    return springs(x, t) - 0.1 * np.abs(v) * v + np.cross(v, [0.0, 0.3, 1.0])


def built(rows, x, masses, *, seed=5, speed=0.3, force=springs, time=0.0, options=None, **more) -> Built:
    """A system, and a start with random velocities on the constraints."""
    held = ConstraintSet(rows, x, masses, time=time, **(options or {}))
    system = System(Motion(held, x, time=time), force, **more)
    v = speed * np.random.default_rng(seed).normal(size=x.shape)
    return system, system.initial_state(x, v, time=time, project=True)


#: Pairs and masses of one molecule of each kind.
KINDS = {
    "dumbbell": ([[0, 1]], [1.0, 2.0]),
    "methylene": ([[0, 1], [0, 2]], [12.0, 1.0, 1.0]),
    "methyl": ([[0, 1], [0, 2], [0, 3]], [12.0, 1.0, 1.0, 1.0]),
    "water": ([[0, 1], [0, 2], [1, 2]], [16.0, 1.0, 1.0]),
    "chain": ([[k, k + 1] for k in range(9)], [14.0] * 10),
    "long": ([[k, k + 1] for k in range(59)], [14.0] * 60),
    "longer": ([[k, k + 1] for k in range(149)], [14.0] * 150),
    "ring": ([[k, (k + 1) % 6] for k in range(6)] + [[0, 6]], [12.0] * 6 + [1.0]),
    "tetrahedron": ([[i, j] for i in range(4) for j in range(i)], [1.0, 2.0, 3.0, 4.0]),
}
GROUPS = ["methyl", "methylene", "dumbbell", "methyl", "dumbbell"]


def molecules(*names, ions=2, fixed=(), at=0.0, cell=None, scatter=False, **more) -> Built:
    """Molecules of some kinds one after another, and free atoms after them."""
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
        if name == "water":
            shape = np.array([[0.0, 0, 0], [1.0, 0, 0], [-0.3, 0.9, 0]]) @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
        x.append(shape + 0.2 * number)
    x.append(rng.normal(size=(ions, 3)))
    x = np.concatenate(x) + at
    if cell is not None and scatter:
        x = x + rng.integers(-1, 2, size=x.shape) * np.diag(cell)
    m = np.concatenate([*masses, np.full(ions, 23.0)])
    rows = [Distance(np.concatenate(pairs))] if pairs else []
    if fixed:
        rows.append(FixedAtoms(list(fixed)))
    options = None if cell is None else {"cell": cell, "pbc": True}
    return built(rows, x, m, options=options, **more)


def bent_chain(n=8):
    """A chain of atoms that has angles and dihedrals to hold."""
    k = np.arange(n)
    return np.stack([1.2 * k, 0.7 * (k % 2), 0.5 * np.sin(k)], axis=1), np.linspace(10.0, 16.0, n)


def angled(**more) -> Built:
    x, m = bent_chain()
    return built([Distance([[k, k + 1] for k in range(7)]), Angle([[0, 1, 2], [4, 5, 6]])], x, m, **more)


def twisted(**more) -> Built:
    x, m = bent_chain()
    return built([Distance([[0, 1], [3, 4]]), Dihedral([[0, 1, 2, 3], [3, 4, 5, 6]])], x, m, **more)


def on_spheres(extra=(), **more) -> Built:
    rng = np.random.default_rng(2)
    x = rng.normal(size=(6, 3))
    x[:5] /= np.linalg.norm(x[:5], axis=1)[:, None]
    rows = [Sphere([0, 1, 2, 3, 4], np.zeros(3), 1.0), FixedAtoms([5]), *extra]
    return built(rows, x, np.linspace(1.0, 2.0, 6), **more)


def on_functions(**more) -> Built:
    """Atoms on a surface of one's own, and a collective variable of one's own."""
    x = np.array([[1.0, 0.2, 0.3], [0.4, 1.1, -0.2], [2.0, 0.1, 0.0], [2.5, 1.0, 0.4]])
    wave = Custom([[0], [1]], lambda r: r[0, 2] - 0.3 * np.sin(r[0, 0]), lambda r: [[-0.3 * np.cos(r[0, 0]), 0, 1]])
    spread = Custom([[1, 2, 3]], lambda r: (r[0] - r[1]) @ (r[2] - r[1]), _spread_gradient)
    return built([wave, spread], x, [1.0, 2.0, 1.5, 1.0], **more)


def _spread_gradient(r):
    a, b = r[0] - r[1], r[2] - r[1]
    return [b, -a - b, a]


def skates(**more) -> Built:
    x = np.array([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0], [2.0, 0.3, 0.1], [2.4, 0.9, -0.2]])
    rows = [
        Distance([[0, 1], [2, 3]]),
        KnifeEdge([0, 2], [1, 3], [0, 0, 1], contact=0.5),
        Plane([0, 1], [0.0, 0.0, 1.0], 0.0),
    ]
    return built(rows, x, [1.0, 1.0, 2.0, 1.0], **more)


def crystal(sides=(4, 4, 4), *, angle=False, **more) -> Built:
    """A dense cluster: nearest neighbors of a lattice, for the sparse solvers."""
    places = np.indices(sides).reshape(3, -1).T
    number = {tuple(p): k for k, p in enumerate(places.tolist())}
    steps = np.eye(3, dtype=int).tolist()
    pairs = [
        [number[tuple(p)], number[there]]
        for p in places.tolist()
        for s in steps
        if (there := tuple(np.add(p, s).tolist())) in number
    ]
    x = places + 0.1 * np.random.default_rng(4).normal(size=places.shape)
    rows = [Distance(pairs), *([Angle([[0, 1, 2], [5, 6, 7]]), Dihedral([[0, 1, 5, 6]])] if angle else [])]
    return built(rows, x, np.linspace(1.0, 3.0, len(x)), **more)


def grouped(**more) -> Built:
    x = np.random.default_rng(9).normal(size=(12, 3)) * 2
    rows = [CenterDistance([0, 1, 2], [3, 4, 5], 3.0), RadiusOfGyration([6, 7, 8, 9, 10, 11], 2.0)]
    return built(rows, x, np.linspace(1.0, 4.0, 12), **more)


def driven(**more) -> Built:
    """A rod that breathes on a fixed atom, and a bond whose length swings."""
    x = np.array([[0.0, 0, 0], [1.0, 0, 0], [1.5, 0.7, 0.2], [3.0, 0.1, 0.4], [3.7, 1.1, 0.2]])
    grows = MovingTarget(lambda t: 1 + 0.2 * t, lambda t: 0.2, lambda t: 0.0)
    swings = MovingTarget(lambda t: 1.2 + 0.1 * np.sin(t), lambda t: 0.1 * np.cos(t), lambda t: -0.1 * np.sin(t))
    rows = [FixedAtoms([0]), Distance([0, 1], grows), Distance([3, 4], swings), Angle([[1, 2, 3]])]
    return built(rows, x, [1.0, 1.0, 2.0, 1.0, 1.5], time=0.3, **more)


BOX, SKEWED = np.diag([19.0, 18.0, 17.0]), np.array([[19.0, 0, 0], [2.0, 18.0, 0], [1.0, -3.0, 17.0]])
#: Name: how to build it, and the steppers that run on it.
SYSTEMS: dict[str, tuple[Callable[[], Built], list]] = {
    "waters": (lambda: molecules(*["water"] * 11, ions=0), STEPPERS),
    "waters without forces": (lambda: molecules(*["water"] * 3, force=None), FEW),
    "dumbbells": (lambda: molecules("dumbbell", "dumbbell", ions=0), STEPPERS),
    "small clusters": (lambda: molecules(*GROUPS), STEPPERS),
    "many small clusters": (lambda: molecules(*["dumbbell", "methyl"] * 30), FEW),
    "waters and small clusters": (lambda: molecules(*["water"] * 9, *GROUPS, "chain", fixed=(0, 30)), FEW),
    "chains": (lambda: molecules("chain", "long", "dumbbell"), FEW),
    "long chains": (lambda: molecules("longer", "long", ions=0), FEW),
    "rings": (lambda: molecules("ring", "tetrahedron"), FEW),
    "few held among many": (lambda: molecules("methyl", "water", ions=30), FEW),
    "fixed atoms": (lambda: molecules("chain", "methyl", "water", "dumbbell", fixed=(0, 3, 10, 11, 14)), FEW),
    "nothing held": (lambda: molecules(ions=4), FEW),
    "periodic": (lambda: molecules(*GROUPS, "water", cell=BOX, scatter=True), FEW),
    "skewed cell": (lambda: molecules(*GROUPS, "water", cell=SKEWED), FEW),
    "angle in a cell": (lambda: angled(options={"cell": BOX, "pbc": True}), FEW),
    "far away": (lambda: molecules(*GROUPS, at=1e5, force=None), FEW),
    "far away, forced": (lambda: molecules(*GROUPS, "water", at=1e4, force=lambda x, t: 0.1 * (x.mean(0) - x)), FEW),
    "far away, an angle": (lambda: far_angle(), FEW),
    "angle": (angled, STEPPERS),
    "dihedrals": (twisted, FEW),
    "spheres": (on_spheres, STEPPERS),
    "spheres and a plane": (lambda: on_spheres([Plane([0], [0.0, 0.6, 0.8], 0.1)]), FEW),
    "functions": (on_functions, FEW[:4]),
    "nonholonomic": (skates, [Rattle(), Geodesic(3), Suzuki4()]),
    "crystal": (crystal, [Rattle(), Suzuki4()]),
    "large crystal": (lambda: crystal((7, 7, 5)), [Rattle()]),
    "crystal with angles": (lambda: crystal(angle=True), [Rattle(), Suzuki4()]),
    "groups": (grouped, FEW),
    "moving targets": (driven, STEPPERS),
    "friction": (lambda: molecules(*["water"] * 3, friction=0.3), STEPPERS),
    "friction and an angle": (lambda: angled(friction=0.2), FEW),
    "friction on spheres": (lambda: on_spheres(friction=0.2), FEW),
    "friction and moving targets": (lambda: driven(friction=0.3), FEW),
    "velocity-dependent": (lambda: molecules(*GROUPS, force=dragged, velocity_dependent=True), ONLY_COMPOSED),
    "velocity-dependent, an angle": (
        lambda: angled(force=dragged, velocity_dependent=True, friction=0.1),
        ONLY_COMPOSED,
    ),
    "velocity-dependent, moving targets": (lambda: driven(force=dragged, velocity_dependent=True), ONLY_COMPOSED),
}


def far_angle() -> Built:
    x, m = bent_chain()
    rows = [Distance([[k, k + 1] for k in range(7)]), Angle([[0, 1, 2], [4, 5, 6]])]
    return built(rows, x + 3e4, m, force=lambda x, t: 0.1 * (x.mean(axis=0) - x))


# -- trajectories -----------------------------------------------------------------------------------


def trail(system: System, state: State, stepper, dt=0.02, **more) -> list[State]:
    """Steps one by one, many that nobody looks at, some that are looked at, and steps back."""
    seen: list[State] = []
    for _ in range(2):
        state = stepper.step(system, state, dt)
    state = run(system, state, dt, 4, stepper=stepper, **more)
    state = run(system, state, dt, 4, stepper=stepper, observers=[seen.append], every=2, **more)
    if not isinstance(stepper, Langevin):
        state = run(system, state, -dt, 2, stepper=stepper, **more)
    return [*seen, state]


def plain_steppers() -> Iterator[tuple[str, list[State]]]:
    for name, (make, steppers) in SYSTEMS.items():
        for stepper in steppers:
            label = "drift, kick, drift" if type(stepper) is Splitting else repr(stepper)
            system, state = make()
            if system.friction and stepper.order > 4:
                continue
            yield f"{name}: {label}", trail(system, state, stepper)
    checked = ReversibilityCheck(Rattle(), 1e-6)
    yield f"small clusters: {checked!r}", trail(*molecules(*GROUPS), checked)


def balanced(x, t):
    """Soft pairs: no place in space."""
    d = x[:, None] - x[None, :]
    return 2 * (d * np.exp(-(d * d).sum(-1))[..., None]).sum(1) + np.cross([0.3, 0.1, 1.0], x - x.mean(axis=0))


THERMOSTATTED: dict[str, Callable[[], Built]] = {
    "waters": lambda: molecules(*["water"] * 5, ions=0),
    "small clusters": lambda: molecules(*GROUPS),
    "fixed atoms": lambda: molecules(*GROUPS, "water", fixed=(0, 5)),
    "chains": lambda: molecules("longer", "methyl"),
    "periodic": lambda: molecules(*GROUPS, "water", cell=BOX, scatter=True),
    "far away": lambda: molecules(*GROUPS, at=1e5, force=balanced),
    "angle": angled,
    "spheres": on_spheres,
    "nothing forced": lambda: molecules(*GROUPS, force=None),
    "crystal": crystal,
    "free cluster": lambda: molecules(*GROUPS, force=balanced),
    "moving targets": driven,
}


def thermostats() -> Iterator[tuple[str, list[State]]]:
    for name, make in THERMOSTATTED.items():
        system, state = make()
        v = thermal_velocities(system, state.positions, 0.2, 11, time=state.time)
        state = State(state.positions, v, state.time, remainder=state.remainder)
        yield f"{name}: velocities", [state]
        chosen = [
            Langevin(0.2, 0.5, 3),
            Langevin(0.2, 0.5, 3, substeps=1),
        ]
        if name != "moving targets":
            chosen += [Isokinetic(0.2, order=order) for order in (2, 4, 6)]
            chosen += [Isokinetic(), Isokinetic(0.2, convention="notes", momentum="free")]
            chosen += [NoseHooverChain(0.2, 2.0), NoseHooverChain(0.2, 2.0, length=2)]
        if name in ("free cluster", "far away"):
            chosen.append(Isokinetic(0.2, momentum="conserved"))
        for k, stepper in enumerate(chosen):
            yield f"{name}: {k} {type(stepper).__name__}", trail(system, state, stepper)
    for name in ("small clusters", "angle"):
        system, state = THERMOSTATTED[name]()
        # What a strong force does to a kick that is opposed to it.
        slow = State(state.positions, 1e-3 * state.velocities, state.time)
        yield f"{name}: slow Isokinetic", trail(system, slow, Isokinetic(), 0.5)
        split = TemperatureSplit(system, rng=1)
        split.add(state.positions)
        yield f"{name}: configurational sample", [State(split._series[0], np.zeros(0))]


def changing_cell() -> Iterator[tuple[str, list[State]]]:
    """A force function that is a barostat, too."""
    for stepper in (Rattle(), Suzuki4(), Isokinetic(), Langevin(0.2, 0.5, 3)):
        system, state = molecules(*GROUPS, "water", cell=BOX, scatter=True)
        motion, forced = system.motion, system.force

        def shrinking(x, t, motion=motion, forced=forced):
            motion.set_cell((1 - 1e-3 * t) * BOX)
            return forced(x, t)

        system.force = shrinking
        # The cell that was there when the step began is another one when its state is looked at.
        yield f"changing cell: {type(stepper).__name__}", trail(system, state, stepper, check_every=0)


def restoring() -> Iterator[tuple[str, list[State]]]:
    """Starts off the constraints, near and far, brought back."""
    for name, (make, _) in SYSTEMS.items():
        system, state = make()
        if name.startswith("far away"):
            continue
        rng = np.random.default_rng(8)
        for size in (1e-3, 0.1):
            x = state.positions + size * rng.normal(size=state.positions.shape)
            try:
                found = system.motion.restore_positions(x, time=state.time)
            except KconsError as error:
                # Not to be had, then and now.
                found = np.array([float(len(type(error).__name__))])
            yield f"restored from {size}: {name}", [State(found, np.zeros(0))]


def through_ase() -> Iterator[tuple[str, list[State]]]:
    from ase import units
    from ase.build import molecule
    from ase.calculators.emt import EMT
    from ase.md.verlet import VelocityVerlet

    from kcons.ase import (
        ConstrainedDynamics,
        ConstrainedLangevin,
        ConstrainedNoseHoover,
        IsokineticDynamics,
        constrain,
        draw_velocities,
        rigid_water,
    )

    def ethanol():
        atoms = molecule("CH3CH2OH")
        atoms.calc = EMT()
        constrain(atoms, [Distance([[0, 1], [1, 2]]), Angle([[0, 1, 2]], np.radians(107.8))], project=True)
        return atoms

    def waters():
        atoms = molecule("H2O") + molecule("H2O")
        atoms.positions[3:] += [0.0, 0.4, 3.0]
        atoms.set_cell([9.0, 9.0, 9.0])
        atoms.pbc = True
        atoms.calc = EMT()
        constrain(atoms, [rigid_water(atoms, "tip3p"), FixedAtoms([0])], project=True)
        return atoms

    dynamics: dict[str, Callable] = {
        "VelocityVerlet": lambda atoms: VelocityVerlet(atoms, units.fs),
        "Rattle": lambda atoms: ConstrainedDynamics(atoms, units.fs),
        "Suzuki4": lambda atoms: ConstrainedDynamics(atoms, units.fs, Suzuki4()),
        "Langevin": lambda atoms: ConstrainedLangevin(atoms, units.fs, temperature_K=300, friction=0.1, rng=4),
        "Isokinetic": lambda atoms: IsokineticDynamics(atoms, units.fs, temperature_K=300),
        "NoseHoover": lambda atoms: ConstrainedNoseHoover(atoms, units.fs, temperature_K=300, tdamp=50 * units.fs),
    }
    for name, make in (("ethanol", ethanol), ("waters", waters)):
        for label, begin in dynamics.items():
            atoms = make()
            draw_velocities(atoms, temperature_K=300, rng=np.random.default_rng(6))
            begin(atoms).run(4)
            yield f"ASE, {name}: {label}", [State(atoms.get_positions(), atoms.get_velocities())]


def through_openmm() -> Iterator[tuple[str, list[State]]]:
    import openmm

    from kcons.openmm import Isokinetic as OfOpenMM
    from kcons.openmm import Langevin as Noise
    from kcons.openmm import ProjectedIntegrator, SurfaceIntegrator, hold

    x = np.random.default_rng(3).normal(size=(10, 3)) * 0.3
    x[6:8] *= 0.5 / np.linalg.norm(x[6:8], axis=1)[:, None]

    def springy():
        system = openmm.System()
        well = openmm.CustomExternalForce("40*(x^2+y^2+z^2)+5*sin(7*x*y)")
        for k in range(10):
            system.addParticle(1.0 + 1.5 * k)
            well.addParticle(k, [])
        system.addForce(well)
        for i, j in ((0, 1), (0, 2), (1, 2), (3, 4), (4, 5)):
            system.addConstraint(i, j, float(np.linalg.norm(x[i] - x[j])))
        return system

    def carried(system, scheme, ensemble=None):
        part = hold(system, [Angle([[3, 4, 5]]), Dihedral([[4, 5, 8, 9]])], x)
        return ProjectedIntegrator(0.001, scheme, parts=[part], ensemble=ensemble)

    def around(system, scheme, **more):
        return SurfaceIntegrator(0.001, scheme, surfaces=Sphere([6, 7], np.zeros(3), 0.5), system=system, **more)

    schemes = ("rattle", "geodesic", "yoshida4", "suzuki4", "kahan-li6")
    schemes += ("blanes-moan4", "blanes-moan6", "blanes-moan6a", "isokinetic4", "isokinetic6")
    made = {f"ProjectedIntegrator {s}": lambda system, s=s: ProjectedIntegrator(0.001, s) for s in schemes}
    made["Langevin"] = lambda system: ProjectedIntegrator(0.001, ensemble=Noise(300.0, 2.0))
    for s in ("rattle", "isokinetic4"):
        made[f"Isokinetic {s}"] = lambda system, s=s: ProjectedIntegrator(0.001, s, ensemble=OfOpenMM(300.0))
    for s in ("rattle", "suzuki4", "blanes-moan6a"):
        made[f"carried {s}"] = lambda system, s=s: carried(system, s)
        made[f"spheres {s}"] = lambda system, s=s: around(system, s)
    made["spheres geodesic"] = lambda system: around(system, "geodesic")
    made["carried Langevin"] = lambda system: carried(system, "rattle", Noise(300.0, 2.0))
    made["carried Isokinetic"] = lambda system: carried(system, "rattle", OfOpenMM(300.0))
    made["spheres Isokinetic"] = lambda system: around(system, "isokinetic4", ensemble=OfOpenMM(300.0))
    for name, make in made.items():
        system = springy()
        integrator = make(system)
        if hasattr(integrator, "setRandomNumberSeed"):
            integrator.setRandomNumberSeed(5)
        integrator.setConstraintTolerance(1e-12)
        context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
        context.setPositions(x)
        context.setVelocities(np.random.default_rng(4).normal(size=x.shape))
        seen = []
        for steps in (1, 1, 4):
            integrator.step(steps)
            state = context.getState(positions=True, velocities=True)
            found = state.getPositions(asNumpy=True), state.getVelocities(asNumpy=True)
            seen.append(State(*(np.array(a._value) for a in found)))
        yield f"OpenMM: {name}", seen


# -- hashes -----------------------------------------------------------------------------------------


def digest(states: list[State]) -> str:
    """Of all that the states hold, but for the forces: these are a function of the rest."""
    total = hashlib.sha256()
    for state in states:
        numbers = [state.positions, state.velocities, [state.time, state.time_remainder, state.step]]
        for extra in (state.remainder, state.thermostat):
            numbers.append([] if extra is None else extra)
        for values in numbers:
            total.update(np.ascontiguousarray(values, dtype=np.float64).tobytes())
    return total.hexdigest()


PARTS = (plain_steppers, thermostats, changing_cell, restoring, through_ase, through_openmm)


def hashes() -> dict[str, str]:
    """Name and hash of every trajectory; of a part whose package is not installed, that it is not there."""
    warnings.simplefilter("ignore", UserWarning)  # some of the systems sample no temperature
    found: dict[str, str] = {}
    for part in PARTS:
        begin = time.perf_counter()
        try:
            for name, states in part():
                if name in found:
                    raise SystemExit(f"two trajectories have the name {name}")
                found[name] = digest(states)
        except ModuleNotFoundError as error:
            found[part.__name__] = f"not here: {error.name}"
        print(f"{part.__name__}: {time.perf_counter() - begin:.1f} s", file=sys.stderr)
    return found


def run_on(folder: Path) -> dict[str, str]:
    """The hashes of the package in `folder`, by this file and an interpreter of its own."""
    with tempfile.TemporaryDirectory() as kept:
        out = Path(kept) / "hashes.json"
        environment = {**os.environ, "PYTHONPATH": str(folder)}
        known = -1
        # A process that compiles kernels may round otherwise than one that finds them compiled.
        while known != (compiled := len(list(folder.rglob("*.nbc")))):
            known = compiled
            subprocess.run([sys.executable, __file__, "--write", str(out)], env=environment, cwd=kept, check=True)
        found = dict(json.loads(out.read_text()))
    if Path(found.pop("package")) != folder / "kcons":
        raise SystemExit(f"another kcons than that in {folder} was run")
    return found


def checkout(commit: str) -> Path:
    """A clean checkout of `commit` in the folder for temporary files; made once."""
    whole = subprocess.run(
        ["git", "rev-parse", "--verify", f"{commit}^{{commit}}"], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout.strip()
    folder = Path(tempfile.gettempdir()) / f"kcons-{whole[:12]}"
    if not (folder / "whole").exists():
        archive = subprocess.run(["git", "archive", whole], cwd=ROOT, check=True, capture_output=True).stdout
        with tarfile.open(fileobj=BytesIO(archive)) as opened:
            opened.extractall(folder, filter="data")
        (folder / "whole").touch()
    return folder


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--against", metavar="COMMIT", help="compare with this commit; status 1 if anything differs")
    parser.add_argument("--write", metavar="FILE", help="write the hashes of the package that is imported, and stop")
    options = parser.parse_args()
    if options.write:
        package = str(Path(kcons.__file__).resolve().parent)
        Path(options.write).write_text(json.dumps({"package": package, **hashes()}, indent=1))
        return 0
    here = run_on(ROOT)
    if not options.against:
        print(json.dumps(here, indent=1))
        return 0
    there = run_on(checkout(options.against))
    different = [name for name in here.keys() | there.keys() if here.get(name) != there.get(name)]
    for name in sorted(different):
        print(f"differs: {name}")
    print(f"{len(here) - len(different)} of {len(here)} trajectories are those of {options.against}, bit for bit")
    return 1 if different else 0


if __name__ == "__main__":
    sys.exit(main())
