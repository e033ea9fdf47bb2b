"""Particles on surfaces in OpenMM: how exact, and how fast against VerletIntegrator of the same particles set free.

    python openmm_surfaces.py                  few particles, seconds
    python openmm_surfaces.py --full --out F   1000 particles, minutes; F receives JSON
    python openmm_surfaces.py --show F         the tables of a file

Speed: liquid argon (density 0.8, reduced), each atom on a surface of its own through its place in the lattice; one
thread, the two integrators in turn, medians of the processor time a step.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENMM_CPU_THREADS", "1")

import numpy as np
import openmm
from openmm import unit
from rich.console import Console
from rich.table import Table

from kcons.comparison import environment, json_files, processor_of
from kcons.constraints import Cylinder, Ellipsoid, Plane, Sphere, Torus
from kcons.openmm import SCHEMES, ExpressionSurface, SurfaceIntegrator

CUTOFFS = (0.85, 1.0, 1.2)  # nm; 2.5 sigma, OpenMM's default, 3.5 sigma
SPHERE = "sqrt((x-a)^2+(y-b)^2+(z-c)^2)-0.5"


def argon(n: int, cutoff: float) -> tuple[openmm.System, np.ndarray]:
    edge = 0.34 * (n / 0.8) ** (1 / 3)
    system, forces = openmm.System(), openmm.NonbondedForce()
    system.setDefaultPeriodicBoxVectors([edge, 0, 0], [0, edge, 0], [0, 0, edge])
    forces.setNonbondedMethod(forces.CutoffPeriodic)
    forces.setCutoffDistance(min(cutoff, 0.49 * edge))
    for _ in range(n):
        system.addParticle(39.948)
        forces.addParticle(0, 0.34, 0.996)
    system.addForce(forces)
    side = round(n ** (1 / 3))
    return system, (np.array(list(np.ndindex(side, side, side)))[:n] + 0.5) * edge / side


def surface(kind: str, x: np.ndarray) -> Any:
    """One surface for each particle, through where it is."""
    rng = np.random.default_rng(1)
    atoms, u = np.arange(len(x)), rng.normal(size=x.shape)
    u /= np.linalg.norm(u, axis=1)[:, None]
    center = x - 0.5 * u
    return {
        "spheres": lambda: Sphere(atoms, center),
        "cylinders along z": lambda: Cylinder(atoms, center, [0, 0, 1]),
        "tilted cylinders": lambda: Cylinder(atoms, center, [1, 1, 1]),
        "planes": lambda: Plane(atoms, u),
        "ellipsoids": lambda: Ellipsoid(atoms, center, [0.4, 0.5, 0.6], target=None),
        "rotated ellipsoids": lambda: Ellipsoid(
            atoms, center, [0.4, 0.5, 0.6], np.linalg.qr(rng.normal(size=(3, 3)))[0], None
        ),
        "tori": lambda: Torus(atoms, x - 0.7 * u, [0, 0, 1], 1.0),
        "a formula": lambda: ExpressionSurface(atoms, SPHERE, dict(zip("abc", center.T, strict=True))),
    }[kind]()


KINDS = (
    "spheres",
    "cylinders along z",
    "tilted cylinders",
    "planes",
    "ellipsoids",
    "rotated ellipsoids",
    "tori",
    "a formula",
)
QUADRICS = KINDS[:6]


def started(system: openmm.System, integrator: openmm.Integrator, x: np.ndarray) -> openmm.Context:
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("CPU"))
    context.setPositions(x)
    context.setVelocitiesToTemperature(120, 1)
    if isinstance(integrator, SurfaceIntegrator):
        integrator.apply_velocities(context)
    return context


def speed(kind: str, scheme: str, compiled: bool, n: int, cutoff: float, repeats: int, steps: int) -> dict[str, Any]:
    system, x = argon(n, cutoff)
    free = openmm.VerletIntegrator(0.002)
    free_context = started(system, free, x)
    system, x = argon(n, cutoff)
    held = SurfaceIntegrator(0.002, scheme, surfaces=surface(kind, x), system=system, positions=x, compiled=compiled)
    context = started(system, held, x)
    times = []
    for repeat in range(repeats + 1):
        pair = []
        for integrator in (free, held):
            start = time.process_time()
            integrator.step(steps)
            pair.append((time.process_time() - start) / steps * 1e6)
        if repeat:  # the first one warms up
            times.append(pair)
    x_now, v = _state(context)
    part = held.surfaces[0]
    across = np.abs(np.einsum("ij,ij->i", part.normals(x_now), v)) / np.linalg.norm(v, axis=1)
    verlet, ours = np.median(times, axis=0)
    del free_context
    return {
        "kind": kind,
        "scheme": scheme,
        "compiled": compiled,
        "cutoff_nm": cutoff,
        "verlet_us": float(verlet),
        "ours_us": float(ours),
        "ratio": float(np.median([a / b for a, b in times])),
        "off_nm": float(np.abs(part.distances(x_now)).max()),
        "across": float(across.max()),
    }


def _state(context: openmm.Context) -> tuple[np.ndarray, np.ndarray]:
    state = context.getState(positions=True, velocities=True)
    return (
        np.array(state.getPositions(asNumpy=True).value_in_unit(unit.nanometer)),
        np.array(state.getVelocities(asNumpy=True).value_in_unit(unit.nanometer / unit.picosecond)),
    )


def pendulum(scheme: str, steps: int, duration: float) -> np.ndarray:
    """A spherical pendulum of length 1 with g = 1: where it is after `duration`."""
    system = openmm.System()
    system.addParticle(1.0)
    gravity = openmm.CustomExternalForce("z")
    gravity.addParticle(0)
    system.addForce(gravity)
    integrator = SurfaceIntegrator(
        duration / steps * unit.picosecond, scheme, surfaces=Sphere(0, [0, 0, 0], 1.0), system=system
    )
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions([[0.8, 0.0, -0.6]])
    context.setVelocities([[0.0, 0.9, 0.0]])
    integrator.step(steps)
    return _state(context)[0]


def precision(duration: float) -> list[dict[str, Any]]:
    exact = pendulum("blanes-moan6", 400, duration)
    rows = []
    for scheme in ("rattle", "geodesic", "suzuki4", "blanes-moan4", "blanes-moan6"):
        evaluations = SCHEMES[scheme]().force_evaluations
        for number in (100, 200, 400):
            steps = number // evaluations
            error = float(np.abs(pendulum(scheme, steps, duration) - exact).max())
            rows.append({"scheme": scheme, "evaluations": steps * evaluations, "error": error})
    return rows


def run(full: bool) -> dict[str, Any]:
    n, repeats, steps = (1000, 15, 60) if full else (64, 3, 20)
    result: dict[str, Any] = {"machine": environment(), "full": full, "particles": n, "speed": []}
    for cutoff in CUTOFFS if full else CUTOFFS[1:2]:
        for compiled in (False, True):
            result["speed"].append(speed("spheres", "rattle", compiled, n, cutoff, repeats, steps))
        result["speed"].append(speed("spheres", "geodesic", False, n, cutoff, repeats, steps))
    for kind in KINDS[1:]:
        for compiled in (False, True) if kind in QUADRICS else (False,):
            result["speed"].append(speed(kind, "rattle", compiled, n, 1.0, repeats, steps))
    result["precision"] = precision(4.0)
    return result


def show(result: dict[str, Any], console: Console) -> None:
    table = Table(title=f"{result['particles']} argon atoms on surfaces: processor time a step, one thread")
    for name in ("surfaces", "scheme", "cutoff/nm", "Verlet/µs", "held/µs", "ratio", "off/nm", "across"):
        table.add_column(name, justify="left" if name in ("surfaces", "scheme") else "right")
    for row in result["speed"]:
        table.add_row(
            row["kind"] + (", compiled" if row["compiled"] else ""),
            row["scheme"],
            f"{row['cutoff_nm']:g}",
            f"{row['verlet_us']:.0f}",
            f"{row['ours_us']:.0f}",
            f"{row['ratio']:.2f}",
            f"{row['off_nm']:.0e}",
            f"{row['across']:.0e}",
        )
    console.print(table)
    table = Table(title="Spherical pendulum: error at t = 4")
    table.add_column("scheme")
    for label in ("100", "200", "400"):
        table.add_column(f"{label} forces", justify="right")
    for scheme in dict.fromkeys(row["scheme"] for row in result["precision"]):
        table.add_row(scheme, *(f"{row['error']:.0e}" for row in result["precision"] if row["scheme"] == scheme))
    console.print(table)
    machine = result["machine"]
    console.print(
        f"{processor_of(machine)}, one thread; OpenMM {machine['versions']['openmm']}; commit {machine['commit']}, "
        f"{machine['date']}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--show", type=Path)
    arguments = parser.parse_args()
    console = Console(width=110)
    result = json_files.read(arguments.show) if arguments.show else run(arguments.full)
    show(result, console)
    if arguments.out:
        json_files.write(arguments.out, result)


if __name__ == "__main__":
    main()
