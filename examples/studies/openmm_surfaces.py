"""Particles on surfaces in OpenMM: how exact, and how fast against VerletIntegrator of the same particles set free.

    python openmm_surfaces.py --quick --out DIR   few particles, seconds
    python openmm_surfaces.py --out DIR           1000 particles, minutes

Speed: liquid argon (density 0.8, reduced), each atom on a surface of its own through its place in the lattice; one
thread, the two integrators in turn, medians of the processor time a step.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator
from functools import partial
from typing import Any

os.environ.setdefault("OPENMM_CPU_THREADS", "1")

import harness
import numpy as np
import openmm
import pandas as pd
from openmm import unit

from kcons.constraints import Ellipsoid, Formula, Plane, Sphere, Torus
from kcons.openmm import SCHEMES, SurfaceIntegrator

CUTOFFS = (0.85, 1.0, 1.2)  # nm; 2.5 sigma, OpenMM's default, 3.5 sigma
SPHERE = "sqrt((x1-a)**2+(y1-b)**2+(z1-c)**2)-0.5"


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


#: The last column along [1, 1, 1].
TILTED = np.linalg.qr([[1.0, 1.0, 0.0], [1.0, 0.0, 1.0], [1.0, 0.0, 0.0]])[0][:, ::-1]


def surface(kind: str, x: np.ndarray) -> Any:
    """One surface for each particle, through where it is."""
    rng = np.random.default_rng(1)
    atoms, u = np.arange(len(x)), rng.normal(size=x.shape)
    u /= np.linalg.norm(u, axis=1)[:, None]
    center = x - 0.5 * u
    return {
        "spheres": lambda: Sphere(atoms, center),
        "cylinders along z": lambda: Ellipsoid(atoms, center, [0.5, 0.5, np.inf], target=None),
        "tilted cylinders": lambda: Ellipsoid(atoms, center, [0.5, 0.5, np.inf], TILTED, None),
        "planes": lambda: Plane(atoms, u),
        "ellipsoids": lambda: Ellipsoid(atoms, center, [0.4, 0.5, 0.6], target=None),
        "rotated ellipsoids": lambda: Ellipsoid(
            atoms, center, [0.4, 0.5, 0.6], np.linalg.qr(rng.normal(size=(3, 3)))[0], None
        ),
        "tori": lambda: Torus(atoms, x - 0.7 * u, [0, 0, 1], 1.0),
        "a formula": lambda: Formula(SPHERE, atoms, dict(zip("abc", center.T, strict=True))),
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


def started(system: openmm.System, integrator: openmm.Integrator, x: np.ndarray) -> openmm.Context:
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("CPU"))
    context.setPositions(x)
    context.setVelocitiesToTemperature(120, 1)
    if isinstance(integrator, SurfaceIntegrator):
        integrator.applyVelocityConstraints(context)
    return context


def speed(kind: str, scheme: str, device: bool, cutoff: float, full: bool) -> Iterator[dict[str, Any]]:
    n, repeats, steps = (1000, 15, 60) if full else (64, 3, 20)
    system, x = argon(n, cutoff)
    free = openmm.VerletIntegrator(0.002)
    free_context = started(system, free, x)
    system, x = argon(n, cutoff)
    held = SurfaceIntegrator(0.002, scheme, surfaces=surface(kind, x), system=system, positions=x, device=device)
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
    (item,) = held.surfaces
    slope = item.gradient(x_now[item.atoms], 0.0)[:, 0]
    size = np.linalg.norm(slope, axis=1)
    off = (item.measure(x_now[item.atoms], 0.0) - item.target_at(0.0)) / size
    across = np.abs(np.einsum("ij,ij->i", slope, v)) / size / np.linalg.norm(v, axis=1)
    verlet, ours = np.median(times, axis=0)
    del free_context
    yield {
        "part": "speed",
        "particles": n,
        "kind": kind,
        "scheme": scheme,
        "device": device,
        "cutoff_nm": cutoff,
        "verlet_us": float(verlet),
        "ours_us": float(ours),
        "ratio": float(np.median([a / b for a, b in times])),
        "off_nm": float(np.abs(off).max()),
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
        duration / steps * unit.picosecond, scheme, surfaces=Sphere(0, [0, 0, 0], 1.0), system=system, device=False
    )
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName("Reference"))
    context.setPositions([[0.8, 0.0, -0.6]])
    context.setVelocities([[0.0, 0.9, 0.0]])
    integrator.step(steps)
    return _state(context)[0]


def precision(duration: float, numbers: tuple[int, ...]) -> Iterator[dict[str, Any]]:
    exact = pendulum("blanes-moan6", 400, duration)
    for scheme in ("rattle", "geodesic", "suzuki4", "blanes-moan4", "blanes-moan6"):
        evaluations = SCHEMES[scheme]().force_evaluations
        for number in numbers:
            steps = number // evaluations
            error = float(np.abs(pendulum(scheme, steps, duration) - exact).max())
            yield {"part": "precision", "scheme": scheme, "evaluations": steps * evaluations, "error": error}


def pieces(chosen: argparse.Namespace) -> dict[str, Any]:
    full = not chosen.quick
    cases = [
        ("spheres", *case, cutoff)
        for cutoff in (CUTOFFS if full else CUTOFFS[1:2])
        for case in (("rattle", False), ("rattle", True), ("geodesic", True))
    ]
    cases += [(kind, "rattle", device, 1.0) for kind in (KINDS[1:] if full else KINDS[1:3]) for device in (False, True)]
    found: dict[str, Any] = {", ".join(map(str, case)): partial(speed, *case, full) for case in cases}
    return {**found, "pendulum": partial(precision, 4.0, (100, 200, 400) if full else (100, 200))}


def tables(table: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Processor time a step of argon atoms on surfaces, one thread; error of a spherical pendulum at t = 4."""
    columns = {"cutoff_nm": "{:g}", "verlet_us": "{:.0f}", "ours_us": "{:.0f}", "ratio": "{:.2f}", "off_nm": "{:.0e}"}
    return {
        "speed": harness.shown(table, "speed", kind="{}", device="{}", scheme="{}", **columns, across="{:.0e}"),
        "precision": harness.shown(table, "precision", scheme="{}", evaluations="{:.0f}", error="{:.0e}"),
    }


def main() -> None:
    harness.main("openmm_surfaces", harness.options(__doc__, "openmm-surfaces"), pieces, tables)


if __name__ == "__main__":
    main()
