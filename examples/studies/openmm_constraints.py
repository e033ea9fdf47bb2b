"""What kcons' constraint solver does inside OpenMM: speed against CCMA, set-up, steps a second, and hard cases.

    python openmm_constraints.py --quick --out DIR   small systems, a minute
    python openmm_constraints.py --out DIR           everything, five minutes

One process, one thread, CPU platform. Times are processor times of the process, taken in turn, and ratios are medians
over the turns, so that they hold on a shared machine.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENMM_CPU_THREADS", "1")

import argparse
import itertools
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import harness
import numpy as np
import openmm
import pandas as pd
from openmm import app, unit

from kcons import ConstraintSet
from kcons.comparison import system_of
from kcons.constraints import Distance
from kcons.errors import KconsError
from kcons.motion import Motion
from kcons.openmm import (
    CarriedConstraints,
    ProjectedIntegrator,
    hold,
    masses_of,
    move_constraints,
    positions_of,
    velocities_of,
)

DATA = Path(__file__).resolve().parents[2] / "tests" / "data"
KT = 2.494  # 300 K in kJ/mol


def context_of(system: openmm.System, integrator: openmm.Integrator, platform: str = "CPU") -> openmm.Context:
    properties = {"Threads": "1"} if platform == "CPU" else {}
    return openmm.Context(system, integrator, openmm.Platform.getPlatformByName(platform), properties)


# -- systems --------------------------------------------------------------------------------------


def dhfr(constraints: Any, obc: bool = False, **options: Any) -> tuple[openmm.System, np.ndarray]:
    """Dihydrofolate reductase in vacuum or in implicit solvent (OpenMM's own 'gbsa' benchmark)."""
    pdb = app.PDBFile(str(DATA / "5dfr_minimized.pdb"))
    files = ("amber99sb.xml", "amber99_obc.xml") if obc else ("amber99sb.xml",)
    system = app.ForceField(*files).createSystem(
        pdb.topology, constraints=constraints, rigidWater=False, removeCMMotion=False, **options
    )
    return system, pdb.getPositions(asNumpy=True).value_in_unit(unit.nanometer)


def chain(bonds: int) -> tuple[openmm.System, np.ndarray]:
    """A freely jointed chain."""
    u = np.random.default_rng(3).normal(size=(bonds, 3))
    x = np.vstack([np.zeros(3), np.cumsum(0.153 * u / np.linalg.norm(u, axis=1)[:, None], axis=0)])
    pairs = [(k, k + 1) for k in range(bonds)]
    return system_of(np.full(bonds + 1, 14.0), pairs=pairs, lengths=0.153), x - x.mean(axis=0)


def water(molecules: int) -> tuple[openmm.System, np.ndarray]:
    """Rigid TIP3P water with PME."""
    field = app.ForceField("tip3p.xml")
    modeller = app.Modeller(app.Topology(), unit.Quantity([], unit.nanometer))
    modeller.addSolvent(field, numAdded=molecules)
    edge = modeller.topology.getUnitCellDimensions().value_in_unit(unit.nanometer)[0]
    system = field.createSystem(
        modeller.topology, nonbondedMethod=app.PME, nonbondedCutoff=min(0.9, 0.45 * edge), removeCMMotion=False
    )
    return system, np.array(modeller.positions.value_in_unit(unit.nanometer))


# -- the solver alone -----------------------------------------------------------------------------


def solver(name: str, system: openmm.System, x: np.ndarray, tolerance: float, repeats: int) -> dict:
    """P and V of `Context.applyConstraints` and of `Motion` on the same displaced positions and velocities."""
    masses = masses_of(system)
    bare = openmm.XmlSerializer.clone(system)
    for k in reversed(range(bare.getNumForces())):
        if not isinstance(bare.getForce(k), openmm.HarmonicAngleForce):  # CCMA takes its coupling from it
            bare.removeForce(k)
    start = time.process_time()
    context = context_of(bare, openmm.VerletIntegrator(0.002))
    setup_ccma = time.process_time() - start
    start = time.process_time()
    rows = move_constraints(openmm.XmlSerializer.clone(bare), keep_water=False)
    held = ConstraintSet(rows, x, masses)
    motion = Motion(held, x)
    setup = time.process_time() - start
    on = motion.restore_positions(x)
    v = np.random.default_rng(5).normal(size=x.shape) * np.sqrt(KT / masses)[:, None]
    moved = on + 0.002 * motion.project_velocities(on, v)
    landed = motion.project_positions(moved, moved)
    work, speed = moved.copy(), v.copy()

    def reset() -> None:
        context.setPositions(moved)
        context.setVelocities(v)
        np.copyto(work, moved)
        np.copyto(speed, v)

    samples: dict[str, list[float]] = {key: [] for key in ("ccma_p", "ccma_v", "p", "v")}

    def timed(key: str, call: Callable[[], Any]) -> None:
        begun = time.process_time()
        call()
        samples[key].append((time.process_time() - begun) / held.n_rows * 1e9)

    for _ in range(repeats):
        reset()
        timed("ccma_p", lambda: context.applyConstraints(tolerance))
        timed("p", lambda: motion.project_positions(work, moved, out=work))
        context.setPositions(landed)
        timed("ccma_v", lambda: context.applyVelocityConstraints(tolerance))
        timed("v", lambda: motion.project_velocities(landed, speed, out=speed))
    rate = held.jacobian(landed)
    error = float(np.max(np.abs(held.value(work)) / held.scale))
    velocity_error = float(np.abs(rate @ speed.ravel()).max())
    reset()
    context.applyConstraints(tolerance)
    theirs = positions_of(context)
    context.setPositions(landed)
    context.applyVelocityConstraints(tolerance)
    tangent = velocities_of(context)
    return {
        "name": name,
        "rows": held.n_rows,
        "tolerance": tolerance,
        **{f"{key}_ns": float(np.median(values)) for key, values in samples.items()},
        "p_ratio": harness.ratio(samples["ccma_p"], samples["p"]),
        "v_ratio": harness.ratio(samples["ccma_v"], samples["v"]),
        "ccma_error": float(np.max(np.abs(held.value(theirs)) / held.scale)),
        "error": error,
        "ccma_velocity_error": float(np.abs(rate @ tangent.ravel()).max()),
        "velocity_error": velocity_error,
        "ccma_setup_s": setup_ccma,
        "setup_s": setup,
    }


def setup(name: str, make: Callable[[], tuple[openmm.System, np.ndarray]]) -> dict:
    """Seconds from a System to a Context that is ready.

    With constraints in the System; with the same distances given to kcons; with constraints moved over to kcons.
    """
    system, _ = make()
    rows = system.getNumConstraints()
    start = time.process_time()
    context_of(system, openmm.VerletIntegrator(0.001))
    theirs = time.process_time() - start
    moved, given = [], []
    for _ in range(3):
        system, x = make()
        start = time.process_time()
        part = hold(system, [], x, take="all", keep_water=False)
        context_of(system, ProjectedIntegrator(0.001, parts=[part]))
        moved.append(time.process_time() - start)
        system, x = make()
        distances = move_constraints(system, keep_water=False)
        start = time.process_time()
        part = CarriedConstraints(system, distances, x)
        part.add_to(system)
        context_of(system, ProjectedIntegrator(0.001, parts=[part]))
        given.append(time.process_time() - start)
    return {"name": name, "rows": rows, "ccma_s": theirs} | {
        "given_s": float(np.median(given)),
        "moved_s": float(np.median(moved)),
        "given_ratio": theirs / float(np.median(given)),
        "moved_ratio": theirs / float(np.median(moved)),
    }


# -- steps a second -------------------------------------------------------------------------------


def ready(context: openmm.Context, x: np.ndarray, part: Any = None) -> None:
    context.setPositions(x)
    context.applyConstraints(1e-8)
    if part is not None:
        part.apply_positions(context)
    context.setVelocitiesToTemperature(300, 1)
    if part is not None:
        part.apply_velocities(context)


def speeds(name: str, times: dict[str, list[float]], steps: int) -> dict:
    return {
        "name": name,
        "ms_a_step": {label: 1e3 * float(np.median(t)) / steps for label, t in times.items()},
        "ratio": {label: harness.ratio(times["VerletIntegrator"], t) for label, t in times.items()},
    }


def pairs_in_water(x: np.ndarray, count: int) -> list[tuple[int, int]]:
    """Oxygens that are close, each in one pair."""
    oxygens = x[::3]
    free, pairs = set(range(len(oxygens))), []
    while len(pairs) < count:
        i = min(free)
        free.remove(i)
        rest = np.array(sorted(free))
        j = int(rest[np.argmin(np.linalg.norm(oxygens[rest] - oxygens[i], axis=1))])
        free.remove(j)
        pairs.append((3 * i, 3 * j))
    return pairs


def steps_in_water(molecules: int, rows: tuple[int, ...], steps: int, repeats: int) -> dict:
    system, x = water(molecules)
    calls: dict[str, Callable[[], Any]] = {}
    keep = []

    def add(name: str, integrator: openmm.Integrator, one: openmm.System, part: Any = None) -> None:
        context = context_of(one, integrator)
        ready(context, start, part)
        integrator.step(5)
        keep.append((context, part))
        calls[name] = lambda: integrator.step(steps)

    context = context_of(system, openmm.LangevinMiddleIntegrator(300, 5, 0.001))
    context.setPositions(x)
    openmm.LocalEnergyMinimizer.minimize(context, 100, 50)
    context.getIntegrator().step(100)
    start = positions_of(context)
    verlet = openmm.VerletIntegrator(0.001)
    add("VerletIntegrator", verlet, openmm.XmlSerializer.clone(system))
    add("ProjectedIntegrator", ProjectedIntegrator(0.001), openmm.XmlSerializer.clone(system))
    for count in rows:
        one = openmm.XmlSerializer.clone(system)
        part = hold(one, Distance(pairs_in_water(start, count)), start)
        add(f"{count} carried", ProjectedIntegrator(0.001, parts=[part]), one, part)
    times = harness.in_turn(calls, repeats)
    for _, part in keep:
        if part is not None:
            part.check(_)
    return speeds(f"PME water, {3 * molecules} atoms", times, steps)


def steps_in_dhfr(name: str, tolerance: float, steps: int, repeats: int, **options: Any) -> dict:
    system, x = dhfr(app.AllBonds, **options)
    moved = openmm.XmlSerializer.clone(system)
    part = hold(moved, [], x, take="all")
    calls: dict[str, Callable[[], Any]] = {}
    keep = []
    for label, integrator, one, held in (
        ("VerletIntegrator", openmm.VerletIntegrator(0.001), system, None),
        ("ProjectedIntegrator", ProjectedIntegrator(0.001, tolerance=tolerance), system, None),
        ("carried", ProjectedIntegrator(0.001, parts=[part]), moved, part),
    ):
        integrator.setConstraintTolerance(tolerance)
        context = context_of(one, integrator)
        ready(context, x, held)
        integrator.step(3)
        keep.append(context)
        calls[label] = lambda integrator=integrator: integrator.step(steps)
    times = harness.in_turn(calls, repeats)
    part.check(keep[-1])
    return speeds(f"DHFR AllBonds, {name}, {tolerance:g}", times, steps)


# -- hard cases -----------------------------------------------------------------------------------


def polygon(n: int) -> np.ndarray:
    angle = 2 * np.pi * np.arange(n) / n
    return 0.07 / np.sin(np.pi / n) * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)


def honeycomb(m: int, n: int) -> tuple[np.ndarray, list[tuple[int, int]]]:
    """m x n hexagons with 3mn + 2m + 2n - 1 bonds."""
    turn = np.pi / 6 + np.pi / 3 * np.arange(6)
    corners = 0.14 * np.c_[np.cos(turn), np.sin(turn), 0 * turn]
    centers = [[0.14 * np.sqrt(3) * (j + i / 2), 0.21 * i, 0.0] for i, j in itertools.product(range(m), range(n))]
    every = (np.array(centers)[:, None] + corners).reshape(-1, 3)
    x = every[np.unique(np.round(every, 6), axis=0, return_index=True)[1]]
    near = np.abs(np.linalg.norm(x[:, None] - x[None], axis=2) - 0.14) < 1e-6
    return x, [(int(i), int(j)) for i, j in np.argwhere(np.triu(near))]


def alanine_dipeptide() -> tuple[np.ndarray, list[tuple[int, int]], np.ndarray]:
    pdb = app.PDBFile(str(DATA / "alanine-dipeptide-implicit.pdb"))
    masses = np.array([atom.element.mass.value_in_unit(unit.dalton) for atom in pdb.topology.atoms()])
    pairs = [(bond[0].index, bond[1].index) for bond in pdb.topology.bonds()]
    return pdb.getPositions(asNumpy=True).value_in_unit(unit.nanometer), pairs, masses


def hard_cases() -> dict[str, tuple[np.ndarray, np.ndarray, list[tuple[int, int]], float]]:
    """Name: positions (nm), masses, pairs held at the distance they have, and how far off to start."""
    every = lambda n: list(itertools.combinations(range(n), 2))  # noqa: E731
    methane = np.array([[0.0, 0, 0], [1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) * 0.109 / np.sqrt(3)
    bipyramid = np.vstack([polygon(3), [[0, 0, 0.12], [0, 0, -0.12]]])
    sides = [(i, (i + 1) % 6) for i in range(6)]
    meta = [tuple(sorted((i, (i + 2) % 6))) for i in range(6)]
    para = [(i, i + 3) for i in range(3)]
    line = np.array([[-0.116, 0, 0], [0, 0, 0], [0.116, 0, 0]])
    diamond = np.array([[0, 0, 0], [0.27, 0, 0], [0.135, 0.2338, 0], [0.135, -0.2338, 0]])
    flat, bonds = honeycomb(4, 6)
    zigzag = np.c_[0.12 * np.arange(12), 0.04 * (np.arange(12) % 2), 0 * np.arange(12)]
    carbon = lambda n: np.full(n, 12.0)  # noqa: E731
    water_like = np.array([[0, 0, 0], [0.09572, 0, 0], [-0.024, 0.09266, 0]])
    peptide, bonds_of_peptide, masses = alanine_dipeptide()
    return {
        "methane, 10 distances": (methane, np.array([12.0, 1, 1, 1, 1]), every(5), 0.0),
        "bipyramid, 10": (bipyramid, carbon(5), every(5), 0.0),
        "hexagon, 9 (with para)": (polygon(6), carbon(6), sides + para, 0.0),
        "hexagon, 12 (with meta)": (polygon(6), carbon(6), sides + meta, 0.0),
        "hexagon, 15": (polygon(6), carbon(6), every(6), 0.0),
        "square, 6": (polygon(4), carbon(4), every(4), 0.0),
        "collinear, 3": (line, np.array([16.0, 12, 16]), every(3), 0.0),
        "Martini diamond, 5": (diamond, np.full(4, 45.0), every(4)[:5], 0.0),
        "Martini diamond, 6": (diamond, np.full(4, 45.0), every(4), 0.0),
        "honeycomb, 91 bonds": (flat, carbon(len(flat)), bonds, 0.0),
        "chain, masses 1:1000": (zigzag, np.tile([1.0, 1000.0], 6), [(i, i + 1) for i in range(11)], 0.0),
        "water, start 20 % off": (water_like, np.array([16.0, 1, 1]), every(3), 0.2),
        "alanine dipeptide, start 20 % off": (peptide, masses, bonds_of_peptide, 0.2),
    }


def hard_system(x: np.ndarray, masses: np.ndarray, **constraints: Any) -> openmm.System:
    """Each atom on a weak spring of its own, also out of planes and lines."""
    force = openmm.CustomExternalForce("50*((x-a)^2+(y-b)^2+(z-c)^2)")
    for name in "abc":
        force.addPerParticleParameter(name)
    for k, away in enumerate(np.random.default_rng(2).normal(size=x.shape)):
        force.addParticle(k, x[k] + 0.05 * away)
    return system_of(masses, force, **constraints)


def lengths_of(x: np.ndarray, pairs: list) -> np.ndarray:
    return np.array([np.linalg.norm(x[i] - x[j]) for i, j in pairs])


def run_carried(x: np.ndarray, masses: np.ndarray, pairs: list, off: float, steps: int) -> dict:
    """Largest relative error over the run with rows of kcons, or why they were refused."""
    lengths = lengths_of(x, pairs)
    system = hard_system(x, masses)
    try:
        part = hold(system, Distance(pairs, lengths), x)
        integrator = ProjectedIntegrator(0.001, parts=[part])
        context = context_of(system, integrator, "Reference")
        context.setPositions((1 + off) * x)
        part.apply_positions(context)
        context.setVelocitiesToTemperature(300, 1)
        part.apply_velocities(context)
        part.check(context)
        worst = 0.0
        for _ in range(steps):
            integrator.step(1)
            reached = lengths_of(positions_of(context), pairs)
            worst = max(worst, float(np.max(np.abs(reached / lengths - 1))))
        part.check(context)
    except KconsError as error:
        return {"refused": f"{type(error).__name__}: {error}"}
    return {"error": worst, "rank": part.rank()}


def run_builtin(x: np.ndarray, masses: np.ndarray, pairs: list, off: float, steps: int) -> dict:
    """The same with OpenMM's own constraints and VerletIntegrator at a tolerance of 1e-10."""
    lengths = lengths_of(x, pairs)
    system = hard_system(x, masses, pairs=pairs, lengths=lengths)
    integrator = openmm.VerletIntegrator(0.001)
    integrator.setConstraintTolerance(1e-10)
    done = 0
    worst = 0.0
    try:
        context = context_of(system, integrator, "Reference")
        context.setPositions((1 + off) * x)
        context.applyConstraints(1e-10)
        context.setVelocitiesToTemperature(300, 1)
        for done in range(steps):
            integrator.step(1)
            there = positions_of(context)
            worst = max(worst, float(np.max(np.abs(lengths_of(there, pairs) / lengths - 1))))
            if not np.isfinite(worst) or not np.all(np.isfinite(there)):
                return {"error": float("inf"), "raised": "", "steps": done}
    except openmm.OpenMMException as error:
        return {"error": worst, "raised": str(error), "steps": done}
    return {"error": worst, "raised": "", "steps": steps}


# -- all of it ------------------------------------------------------------------------------------


def one(part: str, measure: Callable[[], dict]) -> Iterator[dict[str, Any]]:
    """One row; of whole steps one for each integrator."""
    found = measure()
    if part != "steps":
        yield {"part": part, **found}
        return
    for name, ms in found["ms_a_step"].items():
        yield {"part": part, "name": found["name"], "integrator": name, "ms": ms, "speed": found["ratio"][name]}


def hard(case: str, steps: int) -> dict[str, Any]:
    ours, theirs = (run(*hard_cases()[case], steps) for run in (run_carried, run_builtin))
    return {"name": case, "kcons": ours.get("refused") or ours["error"], "OpenMM": theirs["raised"] or theirs["error"]}


def pieces(chosen: argparse.Namespace) -> dict[str, Any]:
    jobs: list[tuple[str, str, Callable[[], dict]]] = []
    if chosen.quick:
        jobs.append(("solver", "chain", lambda: solver("chain, 300 bonds", *chain(300), 1e-10, 7)))
        jobs.append(("setup", "chain", lambda: setup("chain, 300 bonds", lambda: chain(300))))
        jobs.append(("steps", "water", lambda: steps_in_water(27, (1, 5), 5, 3)))
        cases = ["methane, 10 distances", "collinear, 3"]
    else:
        for name, kind, tolerance, repeats in (
            ("DHFR AllBonds", app.AllBonds, 1e-10, 101),
            ("DHFR AllBonds", app.AllBonds, 1e-6, 101),
            ("DHFR HAngles", app.HAngles, 1e-10, 51),
        ):
            job = lambda n=name, k=kind, t=tolerance, r=repeats: solver(n, *dhfr(k), t, r)  # noqa: E731
            jobs.append(("solver", f"{name}, {tolerance:g}", job))
        far = "freely jointed chain, 10000 bonds"
        jobs.append(("solver", far, lambda: solver(far, *chain(10_000), 1e-10, 51)))
        jobs.append(("setup", "DHFR", lambda: setup("DHFR HAngles", lambda: dhfr(app.HAngles))))
        jobs.append(("setup", "chain", lambda: setup("chain, 100000 bonds", lambda: chain(100_000))))
        jobs.append(("steps", "water", lambda: steps_in_water(900, (1, 20), 50, 11)))
        vacuum = {"nonbondedMethod": app.NoCutoff}
        solvent = {"nonbondedMethod": app.CutoffNonPeriodic, "nonbondedCutoff": 2.0 * unit.nanometer, "obc": True}
        for name, options, count in (("vacuum", vacuum, 50), ("implicit solvent", solvent, 10)):
            for tolerance in (1e-10, 1e-6):
                job = partial(steps_in_dhfr, name, tolerance, count, 11, **options)
                jobs.append(("steps", f"{name}, {tolerance:g}", job))
        cases = list(hard_cases())
    jobs += [("hard", case, partial(hard, case, 50 if chosen.quick else 500)) for case in cases]
    return {f"{part}, {name}": partial(one, part, job) for part, name, job in jobs}


def tables(table: pd.DataFrame) -> dict[str, pd.DataFrame]:
    times = {name: "{:.0f}" for name in ("ccma_p_ns", "p_ns", "p_ratio", "ccma_v_ns", "v_ns", "v_ratio")}
    made = {"ccma_s": "{:.2f}", "given_s": "{:.3f}", "given_ratio": "{:.0f}", "moved_s": "{:.3f}"}
    return {
        "The solver alone: OpenMM's CCMA and kcons on the same input, ns a row": harness.shown(
            table, "solver", name="{}", rows="{:.0f}", tolerance="{:g}", **times, ccma_error="{:.0e}", error="{:.0e}"
        ),
        "From a System to a Context, s": harness.shown(
            table, "setup", name="{}", rows="{:.0f}", **made, moved_ratio="{:.0f}"
        ),
        "Speed of whole steps: milliseconds, and times VerletIntegrator's steps a second": harness.shown(
            table, "steps", name="{}", integrator="{}", ms="{:.2f}", speed="{:.2f}"
        ),
        "Hard cases: largest relative error of a distance over 500 steps": harness.shown(
            table, "hard", name="{}", kcons="{}", OpenMM="{}"
        ),
    }


def main() -> None:
    harness.main("openmm_constraints", harness.options(__doc__, "openmm-constraints"), pieces, tables)


if __name__ == "__main__":
    main()
