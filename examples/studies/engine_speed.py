"""How fast is the engine, and how exact? Every shape it has a solver for, against the MD engines' own constraints.

    python engine_speed.py --quick --out DIR         small systems, a minute
    python engine_speed.py --out DIR                 all sizes and slow peers, four minutes
    python engine_speed.py --certificates --out DIR  only what certificates take of a run

Times are medians of repeats in one process, one thread, warm. P is the position projection, V the velocity
projection, both through the public calls of `Motion`, checks included; each P starts from a fresh thermal
displacement of 2 fs at 300 K. 'bare' is a plain velocity-Verlet update of the same arrays, compiled by Numba, in
the same run: kick and drift, then kick.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import harness
import numba
import numpy as np
import pandas as pd
from ase import Atoms
from ase.calculators.calculator import Calculator, all_changes
from ase.constraints import FixBondLengths
from ase.md.verlet import VelocityVerlet

import kcons
from kcons import ConstraintSet, State, System
from kcons.ase import constrain
from kcons.comparison import system_of
from kcons.constraints import Angle, Constraint, Dihedral, Distance, Plane
from kcons.motion import Motion
from kcons.plan import make_plan
from kcons.solvers import SparseDistances

KT = 2.494e-4  # 300 K in amu Å²/fs²
STEP = 2.0  # fs
DATA = Path(__file__).resolve().parents[2] / "tests" / "data"


# -- systems: positions (Å), masses (amu), pairs --------------------------------------------------


def scattered(molecule: np.ndarray, n: int, spacing: float, seed: int) -> np.ndarray:
    """Copies of a molecule on a lattice, turned at random."""
    turns = np.linalg.qr(np.random.default_rng(seed).normal(size=(n, 3, 3)))[0]
    edge = int(np.ceil(n ** (1 / 3)))
    grid = np.stack(np.meshgrid(*[np.arange(edge)] * 3, indexing="ij"), -1).reshape(-1, 3)[:n] * spacing
    return np.ascontiguousarray((np.einsum("nij,kj->nki", turns, molecule) + grid[:, None]).reshape(-1, 3))


def water(n: int) -> tuple[np.ndarray, np.ndarray, list[Constraint]]:
    """Rigid TIP3P molecules."""
    x = scattered(np.array([[0, 0, 0], [0.9572, 0, 0], [-0.2399872, 0.9266272, 0]]), n, 3.1, 1)
    o = 3 * np.arange(n)
    pairs = np.concatenate([np.c_[o, o + 1], np.c_[o, o + 2], np.c_[o + 1, o + 2]])
    return x, np.tile([15.999, 1.008, 1.008], n), [Distance(pairs)]


def groups(n: int, hydrogens: int) -> tuple[np.ndarray, np.ndarray, list[Constraint]]:
    """X-H, CH2 or CH3 groups with their C-H bonds held."""
    ends = 1.09 * np.array([[0.943, 0, 0.333], [-0.471, 0.816, 0.333], [-0.471, -0.816, 0.333]])[:hydrogens]
    x = scattered(np.vstack([np.zeros(3), ends]), n, 4.0, 2)
    first = (hydrogens + 1) * np.arange(n)
    pairs = np.concatenate([np.c_[first, first + h] for h in range(1, hydrogens + 1)])
    return x, np.tile([12.011, *[1.008] * hydrogens], n), [Distance(pairs)]


def chain(bonds: int, kind: str) -> tuple[np.ndarray, np.ndarray, list[Constraint]]:
    """Open chain of equal bonds."""
    rng = np.random.default_rng(3)
    if kind == "freely jointed":
        u = rng.normal(size=(bonds, 3))
        u /= np.linalg.norm(u, axis=1)[:, None]
    elif kind == "straight":
        u = np.tile([1.0, 0, 0], (bonds, 1))
    else:
        half = np.deg2rad({"zigzag": 111.0, "175 degrees": 175.0}[kind] / 2)
        u = np.zeros((bonds, 3))
        u[:, 0] = np.sin(half)
        u[::2, 1], u[1::2, 1] = np.cos(half), -np.cos(half)
    x = np.vstack([np.zeros(3), np.cumsum(1.53 * u, axis=0)])
    x -= x.mean(axis=0)
    return x, np.full(bonds + 1, 14.0), [Distance(np.c_[np.arange(bonds), np.arange(1, bonds + 1)])]


def tree(carbons: int) -> tuple[np.ndarray, np.ndarray, list[Constraint]]:
    """Polymethylene with all its bonds held: a tree."""
    spine, _, _ = chain(carbons - 1, "zigzag")
    side = np.where(np.arange(carbons) % 2 == 0, 0.6, -0.6)
    x = np.empty((3 * carbons, 3))
    x[0::3] = spine
    x[1::3] = spine + np.c_[0 * side, -side, np.full(carbons, 0.9)]
    x[2::3] = spine + np.c_[0 * side, -side, np.full(carbons, -0.9)]
    c = 3 * np.arange(carbons)
    pairs = np.concatenate([np.c_[c, c + 1], np.c_[c, c + 2], np.c_[c[:-1], c[1:]]])
    return x, np.tile([12.011, 1.008, 1.008], carbons), [Distance(pairs)]


def protein(held: str) -> tuple[np.ndarray, np.ndarray, list[Constraint], Any]:
    """Dihydrofolate reductase (5DFR, 2489 atoms) under amber99sb; also its OpenMM System."""
    import openmm.unit as unit
    from openmm import app

    pdb = app.PDBFile(str(DATA / "5dfr_minimized.pdb"))
    choice = {"all bonds": app.AllBonds, "bonds and H angles": app.HAngles, "mixed": app.AllBonds}[held]
    system = app.ForceField("amber99sb.xml").createSystem(pdb.topology, constraints=choice, rigidWater=False)
    table = [system.getConstraintParameters(k) for k in range(system.getNumConstraints())]
    pairs = np.array([[i, j] for i, j, _ in table])
    lengths = np.array([d.value_in_unit(unit.angstrom) for _, _, d in table])
    masses = np.array([system.getParticleMass(i).value_in_unit(unit.dalton) for i in range(system.getNumParticles())])
    x = np.ascontiguousarray(pdb.getPositions(asNumpy=True).value_in_unit(unit.angstrom))
    constraints: list[Constraint] = [Distance(pairs, lengths)]
    if held == "mixed":
        constraints += _more_rows(pairs, masses)
    return x, masses, constraints, system


def _more_rows(pairs: np.ndarray, masses: np.ndarray) -> list[Constraint]:
    """Angles at CH2 groups outside of rings, dihedrals about their bonds, and some atoms held in planes."""
    neighbors: dict[int, list[int]] = {}
    for i, j in pairs.tolist():
        neighbors.setdefault(i, []).append(j)
        neighbors.setdefault(j, []).append(i)
    heavy = {a: [b for b in bonded if masses[b] > 2] for a, bonded in neighbors.items() if masses[a] > 2}
    centers = [
        a for a, bonded in heavy.items() if len(bonded) == 2 and len(neighbors[a]) == 4 and not _in_ring(a, heavy)
    ]
    angles = [(heavy[a][0], a, heavy[a][1]) for a in centers]
    angles += [(next(b for b in neighbors[a] if masses[b] < 2), a, heavy[a][0]) for a in centers]
    dihedrals = [
        (heavy[a][0], a, b, next(c for c in heavy[b] if c != a))
        for a in centers[::2]
        for b in heavy[a][1:]
        if len(heavy[b]) > 1 and heavy[a][0] not in heavy[b]
    ]
    planes = list(range(0, len(masses), 15))
    return [Angle(angles), Dihedral(dihedrals), Plane(planes, [0.0, 0.0, 1.0])]


def _in_ring(center: int, heavy: dict[int, list[int]]) -> bool:
    """Whether one neighbor of the center is reached from the other in five bonds without it."""
    first, goal = heavy[center]
    reached = {first}
    for _ in range(5):
        reached |= {b for a in reached for b in heavy[a] if b != center}
    return goal in reached


# -- measuring ------------------------------------------------------------------------------------


@numba.njit(cache=True)
def _kick_and_drift(x, v, f, w, dt):  # type: ignore[no-untyped-def]
    for i in range(x.shape[0]):
        for axis in range(3):
            v[i, axis] += 0.5 * dt * w[i] * f[i, axis]
            x[i, axis] += dt * v[i, axis]


@numba.njit(cache=True)
def _kick(v, f, w, dt):  # type: ignore[no-untyped-def]
    for i in range(v.shape[0]):
        for axis in range(3):
            v[i, axis] += 0.5 * dt * w[i] * f[i, axis]


def median(call: Callable[[], Any], reset: Callable[[], Any], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        reset()
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def bare(n_atoms: int, repeats: int = 60) -> float:
    """Seconds of a velocity-Verlet update of n_atoms atoms."""
    x = np.random.default_rng(0).random((n_atoms, 3))
    v, f, w = 0.01 * x, x.copy(), np.ones(n_atoms)

    def update() -> None:
        _kick_and_drift(x, v, f, w, 1e-9)
        _kick(v, f, w, 1e-9)

    update()
    return median(update, lambda: None, repeats)


def measure(name: str, x: np.ndarray, masses: np.ndarray, constraints: list[Constraint], path: str = "") -> dict:
    """P and V of one system through `Motion`; `path='generic'` puts chains on the sparse solver."""
    start = time.perf_counter()
    held = ConstraintSet(constraints, x, masses)
    motion = Motion(held, x)
    setup = time.perf_counter() - start
    held = motion.constraint_set
    if path == "generic":
        _use_sparse(motion, x)
    x = motion.restore_positions(x)
    thermal = np.random.default_rng(5).normal(size=x.shape) * np.sqrt(KT / masses)[:, None]
    fresh = x + STEP * motion.project_velocities(x, thermal)
    moved = motion.project_positions(fresh, x)
    tangent = motion.project_velocities(moved, thermal)
    sigma = np.abs(held.value(moved))
    jacobian = held.jacobian(moved)
    norms = np.sqrt(np.asarray(jacobian.multiply(jacobian).sum(axis=1)).ravel())
    rms = np.sqrt(np.mean(np.sum(tangent**2, axis=1)))
    repeats = int(np.clip(3e6 / held.n_rows, 7, 200))
    work, speed = fresh.copy(), thermal.copy()
    p = median(lambda: motion.project_positions(work, x, out=work), lambda: np.copyto(work, fresh), repeats)
    v = median(lambda: motion.project_velocities(moved, speed, out=speed), lambda: np.copyto(speed, thermal), repeats)
    plain = bare(len(x), repeats)
    return {
        "name": name,
        "rows": held.n_rows,
        "atoms": len(x),
        "solvers": sorted({kind.solver for kind in motion.plan.kinds}),
        "setup_s": setup,
        "p_ns": p / held.n_rows * 1e9,
        "v_ns": v / held.n_rows * 1e9,
        "bare_ns_atom": plain / len(x) * 1e9,
        "ratio_to_bare": (p + v) / plain,
        "sigma_over_tolerance": float(np.max(sigma / held.tolerance(moved))),
        "relative_error": float(np.max(sigma / held.scale)),
        "velocity_error": float(np.max(np.abs(jacobian @ tangent.ravel()) / norms) / rms),
    }


def _use_sparse(motion: Motion, x: np.ndarray) -> None:
    """Replace the chain solver of a plan by the sparse one."""
    held = motion.constraint_set
    (item,) = held.constraints
    plan = make_plan(held, x, 0.0)
    sparse = SparseDistances(np.arange(held.n_rows), item.atoms, held.target(), plan.inverse_masses)
    motion.plan.solvers[:] = [sparse]
    motion.plan.kinds[:] = [type(k)("sparse", k.clusters, k.rows, k.rank, k.example) for k in plan.kinds]


# -- peers ----------------------------------------------------------------------------------------


def openmm_constraints(x: np.ndarray, masses: np.ndarray, system: Any, tolerance: float, repeats: int) -> dict:
    """Time of OpenMM's own constraint algorithms alone: a CustomIntegrator with and without them, CPU platform."""
    import openmm
    from openmm import unit

    from kcons.openmm import positions_of, velocities_of

    table = [system.getConstraintParameters(k) for k in range(system.getNumConstraints())]
    pairs = [(i, j) for i, j, _ in table]
    angles = []
    for force in system.getForces():
        if isinstance(force, openmm.HarmonicAngleForce):  # CCMA takes its coupling from it
            angles.append(openmm.HarmonicAngleForce())
            angles[-1].setForceGroup(1)
            for k in range(force.getNumAngles()):
                angles[-1].addAngle(*force.getAngleParameters(k))
    lengths = np.array([d.value_in_unit(unit.nanometer) for _, _, d in table])
    bare_system = system_of(masses, *angles, pairs=pairs, lengths=lengths)
    integrators, contexts = {}, {}
    for what in ("neither", "positions", "velocities"):
        integrator = openmm.CustomIntegrator(0.001 * STEP)
        integrator.setConstraintTolerance(tolerance)
        integrator.setIntegrationForceGroups({0})
        integrator.addPerDofVariable("x0", 0)
        integrator.addPerDofVariable("v0", 0)
        integrator.addComputePerDof("x", "x0 + dt*v0")
        integrator.addComputePerDof("v", "v0")
        if what == "positions":
            integrator.addConstrainPositions()
        if what == "velocities":
            integrator.addConstrainVelocities()
        platform = openmm.Platform.getPlatformByName("CPU")
        context = openmm.Context(bare_system, integrator, platform, {"Threads": "1"})
        context.setPositions(x * 0.1)
        context.applyConstraints(1e-12)
        start = positions_of(context)
        thermal = np.random.default_rng(5).normal(size=x.shape) * np.sqrt(KT / masses)[:, None] * 100
        context.setVelocities(thermal)
        context.applyVelocityConstraints(1e-12)
        tangent = velocities_of(context)
        integrator.setPerDofVariableByName("x0", start)
        # Velocities are drawn back onto the surface at the start, positions from a step along it.
        integrator.setPerDofVariableByName("v0", thermal if what == "velocities" else tangent)
        if what == "velocities":
            integrator.setStepSize(0.0)
        integrator.step(repeats)
        integrators[what], contexts[what] = integrator, context
    samples: dict[str, list[float]] = {what: [] for what in integrators}
    for _ in range(15):
        for what, integrator in integrators.items():
            begin = time.perf_counter()
            integrator.step(repeats)
            samples[what].append((time.perf_counter() - begin) / repeats)
    times = {what: float(np.median(values)) for what, values in samples.items()}
    i, j = np.array(pairs).T
    reached = positions_of(contexts["positions"])
    n = len(pairs)
    return {
        "tolerance": tolerance,
        "p_ns": (times["positions"] - times["neither"]) / n * 1e9,
        "v_ns": (times["velocities"] - times["neither"]) / n * 1e9,
        "relative_error": float(np.max(np.abs(np.linalg.norm(reached[i] - reached[j], axis=1) / lengths - 1))),
    }


def settle(n: int, repeats: int) -> dict:
    """OpenMM's SETTLE on n rigid waters."""
    x, masses, (rows,) = water(n)
    i, j = rows.atoms.T
    system = system_of(masses, pairs=rows.atoms, lengths=np.linalg.norm(x[i] - x[j], axis=1) * 0.1)
    return openmm_constraints(x, masses, system, 1e-12, repeats)


class Nothing(Calculator):
    """No forces, in no time."""

    implemented_properties = ("energy", "forces")

    def calculate(self, atoms=None, properties=("energy",), system_changes=all_changes):  # type: ignore[no-untyped-def]
        super().calculate(atoms, properties, system_changes)
        self.results = {"energy": 0.0, "forces": np.zeros((len(atoms), 3))}


def ase_water(n: int, how: str) -> Atoms:
    x, masses, (rows,) = water(n)
    atoms = Atoms("OHH" * n, positions=x, masses=masses)
    atoms.calc = Nothing()
    speeds = np.random.default_rng(6).normal(size=x.shape) * np.sqrt(0.02585 / masses)[:, None]
    if how == "kcons":
        constrain(atoms, [rows])
    elif how == "ase":
        atoms.set_constraint(FixBondLengths(rows.atoms.tolist()))
    atoms.set_velocities(speeds)
    return atoms


def ase_step(n: int, how: str, steps: int, repeats: int = 7) -> float:
    """Seconds of a step of ASE's VelocityVerlet with a null calculator."""
    dynamics = VelocityVerlet(ase_water(n, how), 0.1)
    if steps > 1:
        dynamics.run(steps)
    return median(lambda: dynamics.run(steps), lambda: None, repeats) / steps


def fix_bond_lengths(n: int) -> dict:
    """P and V of ASE's FixBondLengths on n waters, once."""
    free = ase_water(n, "free")
    start = free.positions.copy()
    held = free.copy()
    constrain(held, [water(n)[2][0]])
    held.set_momenta(free.get_momenta())
    new = start + 0.2 * held.get_velocities()  # about 2 fs in ASE's unit
    theirs = FixBondLengths(water(n)[2][0].atoms.tolist())
    begin = time.perf_counter()
    theirs.adjust_positions(free, new)
    p = time.perf_counter() - begin
    momenta = free.get_momenta()
    begin = time.perf_counter()
    theirs.adjust_momenta(free, momenta)
    v = time.perf_counter() - begin
    return {"waters": n, "p_s": p, "v_s": v, "p_plus_v_s": p + v}


def one_bond(n_atoms: int) -> dict:
    """One held bond among many free atoms: the engine's share of a step."""
    rng = np.random.default_rng(7)
    x = rng.random((n_atoms, 3)) * 100
    x[1] = x[0] + [1.0, 0, 0]
    v = rng.normal(size=x.shape) * 1e-3
    motion = Motion(ConstraintSet(Distance([0, 1]), x, np.full(n_atoms, 12.0)), x)
    new = x + v

    def both() -> None:
        motion.project_positions(new, x, out=new)
        motion.project_velocities(new, v, out=v)

    both()
    return {"atoms": n_atoms, "p_plus_v_us": median(both, lambda: None, 300) * 1e6}


def first_call() -> dict:
    """Import, and the first call of a fresh installation (kernels compiled), each in a process of its own."""
    script = (
        "import time; t = time.perf_counter(); import kcons; a = time.perf_counter() - t\n"
        "import numpy as np; from kcons.constraints import Distance\n"
        "x = np.array([[0, 0, 0], [0.9572, 0, 0], [-0.24, 0.9266, 0]]); t = time.perf_counter()\n"
        "m = kcons.Motion(kcons.ConstraintSet(Distance([(0, 1), (0, 2), (1, 2)]), x, [16.0, 1.0, 1.0]), x)\n"
        "m.project_positions(x + 0.01 * x**2, x); m.project_velocities(x, x[::-1]); print(a, time.perf_counter() - t)\n"
    )
    with tempfile.TemporaryDirectory() as cache:
        environment = {**os.environ, "NUMBA_CACHE_DIR": cache}
        times = []
        for _ in range(6):
            done = subprocess.run(
                [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True
            )
            times.append([float(word) for word in done.stdout.split()])
    imports, first = np.array(times).T
    return {
        "import_s": float(np.median(imports[1:])),
        "first_call_s": float(first[0]),
        "first_call_cached_s": float(np.median(first[1:])),
    }


def certificate(name: str, x: np.ndarray, masses: np.ndarray, constraints: list[Constraint], seconds: float) -> dict:
    """What certificates take of a run without forces, by RATTLE with the default of `check_every`."""
    motion = Motion(ConstraintSet(constraints, x, masses), x)
    certify, spent = motion.certify, []

    def timed(*args: Any) -> None:
        begin = time.perf_counter()
        certify(*args)
        spent.append(time.perf_counter() - begin)

    motion.certify = timed  # type: ignore[method-assign]
    v = motion.project_velocities(x, 1e-3 * np.random.default_rng(3).normal(size=x.shape))
    system, state = System(motion), State(x, v)
    state = kcons.run(system, state, 0.5, 1001)  # the first is not representative: caches are cold
    spent.clear()
    done, begin = 0, time.perf_counter()
    while (passed := time.perf_counter() - begin) < seconds:
        state = kcons.run(system, state, 0.5, 2000)
        done += 2000
    return {
        "name": name, "rows": motion.constraint_set.n_rows, "steps": done, "step_us": passed / done * 1e6,
        "certificates": len(spent), "certificate_us": float(np.median(spent)) * 1e6, "share": sum(spent) / passed,
    }  # fmt: skip


# -- the study ------------------------------------------------------------------------------------


def row(part: str, measured: Callable[..., dict], make: Callable[[], tuple], **given: Any) -> Iterator[dict[str, Any]]:
    """What is measured on a system that is made for it."""
    found = measured(given.pop("name"), *make()[:3], **given)
    found["solvers"] = "+".join(found.get("solvers", ()))
    yield {"part": part, **found}


def peers(name: str, measured: Callable[[], dict]) -> Iterator[dict[str, Any]]:
    yield from ({"part": "peers", "name": name, "what": what, "value": v} for what, v in measured().items())


def ccma(held: str, tolerance: float) -> dict:
    x, masses, _, system = protein(held)
    return openmm_constraints(x, masses, system, tolerance, 20)


def in_ase(n: int) -> dict:
    times = {how: ase_step(n, how, 50) for how in ("free", "kcons")}
    return {**times, "ratio": times["kcons"] / times["free"]}


def certified(full: bool) -> dict[str, Any]:
    bent = np.array([[0.0, 0, 0], [1.1, 0.2, 0], [1.5, 1.3, 0.3], [2.6, 1.5, 1.1]])
    angles = [Distance([[0, 1], [1, 2], [2, 3]]), Angle([[0, 1, 2], [1, 2, 3]])]
    systems: dict[str, Callable[[], tuple]] = {
        "one bond": lambda: (bent[:2], np.array([12.0, 16.0]), [Distance([[0, 1]])]),
        "four atoms, bonds and angles": lambda: (bent, np.full(4, 12.0), angles),
        "rigid water, 100 molecules": partial(water, 100),
        "chain, zigzag, 1000 bonds": partial(chain, 1000, "zigzag"),
        **({"rigid water, 10000 molecules": partial(water, 10_000)} if full else {}),
    }
    given = {"seconds": 10.0 if full else 0.2}
    return {name: partial(row, "certificates", certificate, make, name=name, **given) for name, make in systems.items()}


def pieces(chosen: argparse.Namespace) -> dict[str, Any]:
    full = not chosen.quick
    if chosen.certificates:
        return certified(full)
    sizes = (1_000, 10_000, 100_000, 1_000_000) if full else (1_000,)
    systems: dict[str, Callable[[], tuple]] = {f"rigid water, {n} molecules": partial(water, n) for n in sizes[:3]}
    n = 10_000 if full else 1_000
    for hydrogens, label in ((1, "X-H"), (2, "CH2"), (3, "CH3")):
        systems[f"{label}, {n} groups"] = partial(groups, n, hydrogens)
    for kind in ("zigzag", "straight", "175 degrees", "freely jointed"):
        systems |= {f"chain, {kind}, {n} bonds": partial(chain, n, kind) for n in sizes}
    generic = {f"chain by the generic path, zigzag, {n} bonds": partial(chain, n, "zigzag") for n in sizes}
    systems |= generic | {f"tree (polymethylene), {n} bonds": partial(tree, n // 3) for n in sizes}
    others: dict[str, Callable[[], dict]] = {"ASE FixBondLengths": partial(fix_bond_lengths, 1_000 if full else 10)}
    if find_spec("openmm") is not None:
        held = ("all bonds", "bonds and H angles", "mixed") if full else ("all bonds",)
        systems |= {f"DHFR, {h}": partial(protein, h) for h in held}
        others["OpenMM SETTLE"] = partial(settle, 10_000 if full else 1_000, 20)
        for h in held[:2] if full else ():
            others |= {f"OpenMM CCMA, DHFR, {h}, {t:g}": partial(ccma, h, t) for t in (1e-6, 1e-12)}
    others |= {f"ASE VelocityVerlet, {n} waters, s": partial(in_ase, n) for n in ((100, 1000) if full else (100,))}
    others["one bond"] = partial(one_bond, 1_000_000 if full else 100_000)
    if full:
        others["import and first call"] = first_call
    found: dict[str, Any] = {
        name: partial(row, "engine", measure, make, name=name, path="generic" if name in generic else "")
        for name, make in systems.items()
    }
    return found | {name: partial(peers, name, measured) for name, measured in others.items()}


def tables(table: pd.DataFrame) -> dict[str, pd.DataFrame]:
    times = {"p_ns": "{:.1f}", "v_ns": "{:.1f}", "bare_ns_atom": "{:.2f}", "ratio_to_bare": "{:.2f}"}
    errors = {"sigma_over_tolerance": "{:.2f}", "velocity_error": "{:.0e}", "setup_s": "{:.3f}"}
    found = {
        "Engine: P and V in ns a row, bare in ns an atom, P + V over bare": harness.shown(
            table, "engine", name="{}", solvers="{}", rows="{:.0f}", **times, **errors
        ),
        "Peers": harness.shown(table, "peers", name="{}", what="{}", value="{:.4g}"),
        "Certificates in a run without forces": harness.shown(
            table, "certificates", name="{}", rows="{:.0f}", step_us="{:.1f}", certificate_us="{:.0f}", share="{:.2%}"
        ),
    }
    exponents = {start: exponent(table, start) for start in ("chain, zigzag", "chain by the generic", "tree")}
    grown = pd.DataFrame([{"systems": name, "exponent": f"{p:.3f}"} for name, p in exponents.items() if p is not None])
    return {title: frame for title, frame in {**found, "P + V against rows": grown}.items() if len(frame)}


def exponent(table: pd.DataFrame, start: str) -> float | None:
    """Fitted exponent of P + V against the number of rows."""
    rows = table[(table.part == "engine") & table.name.str.startswith(start)] if "name" in table else table[:0]
    if len(rows) < 2:
        return None
    return float(np.polyfit(np.log(rows["rows"]), np.log(rows["rows"] * (rows.p_ns + rows.v_ns)), 1)[0])


def main() -> None:
    parser = harness.options(__doc__, "engine-speed")
    parser.add_argument("--certificates", action="store_true", help="only what certificates take of a run")
    harness.main("engine_speed", parser, pieces, tables)


if __name__ == "__main__":
    main()
