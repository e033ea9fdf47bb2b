"""Heavy hydrogens at 4 fs in OpenMM: what the integrators sample, what temperature they report, how energy drifts.

    python openmm_heavy_hydrogens.py --quick --out DIR   short runs
    python openmm_heavy_hydrogens.py --out DIR           what docs/evidence/openmm.md shows, some five minutes

Alanine dipeptide (amber14, no cutoff) with hydrogens of 3 dalton, each atom in a weak well, so that no momentum is
conserved; Reference platform, 300 K. Energies of bonds and angles are configurational averages. The reported
temperature is that of the kinetic energy of a State, the other that of the velocities of a State after the next half
kick. Standard errors are from 20 blocks, those of the drift from independent runs.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import harness
import numpy as np
import openmm
import pandas as pd
from openmm import app, unit

from kcons.openmm import (
    Isokinetic,
    Langevin,
    NoseHoover,
    NoseHooverMiddle,
    ProjectedIntegrator,
    masses_of,
    positions_of,
    velocities_of,
)
from kcons.thermostats.correlated_series import slope

PDB = Path(__file__).resolve().parents[2] / "tests" / "data" / "alanine-dipeptide-implicit.pdb"
TEMPERATURE, FRICTION, HEAVY = 300.0, 5.0, 3.0
KT = 0.00831446261815324 * TEMPERATURE
#: Picoseconds between samples.
APART = 0.04
Maker = Callable[[float], openmm.Integrator]
#: Integrators by name, given a step in ps.
INTEGRATORS: dict[str, Maker] = {
    "LangevinMiddleIntegrator": lambda h: openmm.LangevinMiddleIntegrator(TEMPERATURE, FRICTION, h),
    "kcons Langevin": lambda h: ProjectedIntegrator(h, ensemble=Langevin(TEMPERATURE, FRICTION)),
    "NoseHooverIntegrator": lambda h: openmm.NoseHooverIntegrator(TEMPERATURE, FRICTION, h),
    "kcons NoseHoover": lambda h: ProjectedIntegrator(h, ensemble=NoseHoover(TEMPERATURE, FRICTION)),
    "kcons NoseHooverMiddle": lambda h: ProjectedIntegrator(h, ensemble=NoseHooverMiddle(TEMPERATURE, FRICTION)),
    "kcons Isokinetic": lambda h: ProjectedIntegrator(h, ensemble=Isokinetic(TEMPERATURE)),
}
CONSERVING: dict[str, Maker] = {
    "VerletIntegrator": openmm.VerletIntegrator,
    "kcons rattle": ProjectedIntegrator,
}
#: What is run for which constraints: integrator and step in fs. The first is what the others are compared with.
RUNS = {
    "HBonds": [
        ("LangevinMiddleIntegrator", 1), ("LangevinMiddleIntegrator", 4), ("kcons Langevin", 4),
        ("NoseHooverIntegrator", 4), ("kcons NoseHoover", 2), ("kcons NoseHoover", 4), ("kcons NoseHooverMiddle", 4),
        ("kcons Isokinetic", 2), ("kcons Isokinetic", 4),
    ],
    "AllBonds": [
        ("LangevinMiddleIntegrator", 1), ("LangevinMiddleIntegrator", 4), ("kcons Langevin", 4),
        ("kcons NoseHoover", 4), ("kcons NoseHooverMiddle", 4),
    ],
}  # fmt: skip


# -- the system -------------------------------------------------------------------------------------


def alanine(constraints: str) -> tuple[openmm.System, np.ndarray]:
    """The System, forces of bonds in group 1 and of angles in group 2, and its minimum."""
    pdb = app.PDBFile(str(PDB))
    field = app.ForceField("amber14-all.xml")
    system = field.createSystem(
        pdb.topology, constraints=getattr(app, constraints), hydrogenMass=HEAVY, removeCMMotion=False
    )
    context = openmm.Context(system, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatformByName("Reference"))
    context.setPositions(pdb.positions)
    openmm.LocalEnergyMinimizer.minimize(context, 0.1, 500)
    x = positions_of(context)
    wells = openmm.CustomExternalForce("100*((x-a)^2+(y-b)^2+(z-c)^2)")
    for name in "abc":
        wells.addPerParticleParameter(name)
    for atom, place in enumerate(x):
        wells.addParticle(atom, place)
    system.addForce(wells)
    groups = {"HarmonicBondForce": 1, "HarmonicAngleForce": 2}
    for force in system.getForces():
        force.setForceGroup(groups.get(type(force).__name__, 0))
    return system, x


def placed(system: openmm.System, integrator: openmm.Integrator) -> openmm.Context:
    if hasattr(integrator, "setRandomNumberSeed"):
        integrator.setRandomNumberSeed(3)
    integrator.setConstraintTolerance(1e-10)
    return openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))


def start_of(system: openmm.System, x: np.ndarray, seed: int, steps: int) -> openmm.State:
    """After steps of 2 fs with a thermostat."""
    integrator = openmm.LangevinMiddleIntegrator(TEMPERATURE, FRICTION, 0.002)
    integrator.setRandomNumberSeed(seed)
    integrator.setConstraintTolerance(1e-10)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions(x)
    context.setVelocitiesToTemperature(TEMPERATURE, seed)
    integrator.step(steps)
    context.applyVelocityConstraints(1e-10)
    return context.getState(positions=True, velocities=True)


def energy(context: openmm.Context, **options: Any) -> tuple[float, float]:
    """Potential and kinetic, in kJ/mol."""
    state = context.getState(energy=True, **options)
    found = (state.getPotentialEnergy(), state.getKineticEnergy())
    return found[0].value_in_unit(unit.kilojoule_per_mole), found[1].value_in_unit(unit.kilojoule_per_mole)


def tangent(system: openmm.System, x: np.ndarray) -> np.ndarray:
    """Projection onto what the System's constraints allow, of vectors weighted with sqrt(m), (3n, 3n)."""
    rows = np.zeros((system.getNumConstraints(), *x.shape))
    for row, k in zip(rows, range(len(rows)), strict=True):
        i, j, _ = system.getConstraintParameters(k)
        row[i], row[j] = x[i] - x[j], x[j] - x[i]
    q = np.linalg.qr((rows / np.sqrt(masses_of(system))[:, None]).reshape(len(rows), -1).T)[0]
    return np.eye(x.size) - q @ q.T


def forces(context: openmm.Context) -> np.ndarray:
    found = context.getState(forces=True).getForces(asNumpy=True)
    return np.asarray(found.value_in_unit(unit.kilojoule_per_mole / unit.nanometer))


# -- what is measured -------------------------------------------------------------------------------


def harmonic(system: openmm.System, x: np.ndarray) -> np.ndarray:
    """Angular frequencies (1/ps) of the vibrations about x that the constraints allow."""
    context = placed(system, openmm.VerletIntegrator(0.001))
    weights = np.repeat(np.sqrt(masses_of(system)), 3)
    columns = []
    for k in range(x.size):
        shift = np.zeros(x.size)
        shift[k] = 1e-4
        ends = []
        for sign in (1, -1):
            context.setPositions(x + sign * shift.reshape(x.shape))
            ends.append(forces(context).ravel())
        columns.append((ends[1] - ends[0]) / 2e-4)
    hessian = np.array(columns) / weights[:, None] / weights
    allowed = tangent(system, x)
    squares = np.linalg.eigvalsh(allowed @ (hessian + hessian.T) / 2 @ allowed)
    return np.sqrt(np.sort(np.abs(squares))[system.getNumConstraints() :])


def sample(system: openmm.System, start: openmm.State, name: str, step: float, picoseconds: float) -> dict[str, Any]:
    """Means with standard errors of one run; energies in kJ/mol, temperatures in K."""
    integrator = INTEGRATORS[name](step)
    context = placed(system, integrator)
    context.setState(start)
    masses = masses_of(system)
    freedom = 3 * len(masses) - system.getNumConstraints()
    found = []
    for _ in range(max(20, round(picoseconds / APART))):
        integrator.step(round(APART / step))
        both, kinetic = energy(context)
        half = kinetic
        if name in ("kcons Langevin", "kcons NoseHooverMiddle"):
            # Velocities after half a kick along the constraints.
            root = np.sqrt(masses)[:, None]
            kick = tangent(system, positions_of(context)) @ (forces(context) / root).ravel()
            half = 0.5 * float(np.sum(((velocities_of(context) * root).ravel() + 0.5 * step * kick) ** 2))
        one, two = (energy(context, groups={group})[0] for group in (1, 2))
        found.append((one, two, both, *(2 * k / (freedom * KT) * TEMPERATURE for k in (kinetic, half))))
    blocks = np.array([block.mean(axis=0) for block in np.array_split(np.array(found), 20)])
    errors = blocks.std(axis=0, ddof=1) / np.sqrt(20)
    names = ("bonds", "angles", "potential", "reported", "half")
    means = np.mean(found, axis=0)
    return {key: {"mean": float(m), "error": float(e)} for key, m, e in zip(names, means, errors, strict=True)}


def drift(
    system: openmm.System, x: np.ndarray, make: Maker, warm_up: int, picoseconds: float, runs: int
) -> dict[str, float]:
    """Slope of the total energy at 4 fs, kT/ns and degree of freedom: mean and standard error of independent runs."""
    freedom = 3 * system.getNumParticles() - system.getNumConstraints()
    slopes = []
    for seed in range(1, runs + 1):
        integrator = make(0.004)
        context = placed(system, integrator)
        context.setState(start_of(system, x, seed, warm_up))
        energies = []
        for _ in range(round(picoseconds / 0.1)):
            integrator.step(25)
            energies.append(sum(energy(context)))
        t = np.arange(len(energies)) * 1e-4
        slopes.append(slope(t, np.array(energies) / (KT * freedom))[0])
    return {"slope": float(np.mean(slopes)), "error": float(np.std(slopes, ddof=1) / np.sqrt(runs))}


# -- the study --------------------------------------------------------------------------------------


def rows(constraints: str, full: bool) -> Iterator[dict[str, Any]]:
    """Averages of runs from one start, and drifts of the integrators that conserve energy."""
    warm_up = 5000 if full else 50
    system, x = alanine(constraints)
    start = start_of(system, x, 1, warm_up)
    omega = harmonic(system, x)
    yield {
        "part": "harmonic",
        "constraints": constraints,
        "shortest_fs": float(2e3 * np.pi / omega.max()),
        "expected_K": float(TEMPERATURE * (1 - np.mean((omega * 0.004) ** 2) / 4)),
    }
    for name, fs in RUNS[constraints] if full else [run for run in RUNS[constraints] if run[1] == 4][:2]:
        found = sample(system, start, name, 1e-3 * fs, 1000.0 if full else 0.1)
        flat = {f"{key}{'_error' if what == 'error' else ''}": v for key, m in found.items() for what, v in m.items()}
        yield {"part": "runs", "constraints": constraints, "integrator": name, "fs": fs, **flat}
    for name, make in CONSERVING.items():
        found = drift(system, x, make, warm_up, *((250.0, 4) if full else (0.5, 2)))
        yield {"part": "drift", "constraints": constraints, "integrator": name, **found}


def tables(table: pd.DataFrame) -> dict[str, pd.DataFrame]:
    means = {f"{key}{end}": "{:.2f}" for key in ("bonds", "angles", "reported", "half") for end in ("", "_error")}
    return {
        "3 dalton, 300 K: energies in kJ/mol, temperatures in K": harness.shown(
            table, "runs", constraints="{}", integrator="{}", fs="{:g}", **means
        ),
        "Harmonic, velocities at the ends of steps of 4 fs": harness.shown(
            table, "harmonic", constraints="{}", shortest_fs="{:.1f}", expected_K="{:.1f}"
        ),
        "Drift at 4 fs, kT/ns/dof": harness.shown(
            table, "drift", constraints="{}", integrator="{}", slope="{:+.1e}", error="{:.0e}"
        ),
    }


def main() -> None:
    def pieces(chosen: argparse.Namespace) -> dict[str, Any]:
        return {constraints: partial(rows, constraints, not chosen.quick) for constraints in RUNS}

    harness.main("openmm_heavy_hydrogens", harness.options(__doc__, "heavy-hydrogens"), pieces, tables)


if __name__ == "__main__":
    main()
