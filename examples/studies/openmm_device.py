"""Steps on the device: speed, residual and drift beside OpenMM's own integrators and those without the plugin.

    python openmm_device.py --quick --out DIR                     water alone, a minute on the CPU platform
    python openmm_device.py --platform "CUDA mixed" --device "H100" --out DIR    a quarter of an hour on a GPU

Speeds are medians of runs that take turns, relative to openmm.VerletIntegrator at 2 fs on the same System. Of villin in
water the bonds to hydrogen are held, all bonds, and all bonds and angles of the protein at 4 fs.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

import harness
import openmm
import pandas as pd
from openmm import app
from openmm_platforms import FRICTION, STEP, TEMPERATURE, VILLIN, drift, placed, protein, residual, start_of, water

from kcons.openmm import (
    Isokinetic,
    Langevin,
    NoseHoover,
    Precision,
    ProjectedIntegrator,
    constraints_of,
    move_constraints,
    positions_of,
)

#: Ensembles by name, and what OpenMM has beside them.
KINDS: dict[str, tuple[Any, Callable[[float], openmm.Integrator] | None]] = {
    "rattle": (None, openmm.VerletIntegrator),
    "Langevin": (
        Langevin(TEMPERATURE, FRICTION),
        lambda dt: openmm.LangevinMiddleIntegrator(TEMPERATURE, FRICTION, dt),
    ),
    "NoseHoover": (
        NoseHoover(TEMPERATURE, FRICTION),
        lambda dt: openmm.NoseHooverIntegrator(TEMPERATURE, FRICTION, dt),
    ),
    "Isokinetic": (Isokinetic(TEMPERATURE), None),
}
#: By plugin or not.
WAYS = {True: "device", False: "program"}
#: Steps of a timed call, rounds, and picoseconds for the drift, by whether it is the full study.
LENGTH = {True: (400, 15, 100.0), False: (3, 3, 0.1)}


def integrators() -> dict[str, openmm.Integrator]:
    """OpenMM's own, those of the device and those without, at 2 fs."""
    made: dict[str, openmm.Integrator] = {}
    for name, (ensemble, other) in KINDS.items():
        if other is not None:
            made[f"OpenMM beside {name}"] = other(STEP)
        for device in (True, False):
            made[f"{name}, {WAYS[device]}"] = ProjectedIntegrator(STEP, ensemble=ensemble, device=device)
    return made


def without_forces(place: str, full: bool) -> Iterator[dict[str, Any]]:
    """Rigid water whose forces cost nothing: what is beside the forces in a step, here of order 4 as well."""
    system, positions = water(2.4 if full else 1.3)
    start = start_of(system, positions, place, 20)
    while system.getNumForces():
        system.removeForce(0)
    made = integrators()
    for device in (True, False):
        made[f"blanes-moan4, {WAYS[device]}"] = ProjectedIntegrator(STEP, "blanes-moan4", device=device)
    with warnings.catch_warnings():
        # Nothing is sampled: speeds only.
        warnings.filterwarnings("ignore", message=".*momentum", category=UserWarning)
        rows = list(measured("rigid water without forces", system, start, made, place, *LENGTH[full]))
    yield from rows


def side_by_side(title: str, make: Callable[[], Any], place: str, full: bool) -> Iterator[dict[str, Any]]:
    """All integrators on one System."""
    system, positions = make()
    start = start_of(system, positions, place, 2000 if full else 20)
    yield from measured(title, system, start, integrators(), place, *LENGTH[full])


def measured(
    title: str,
    system: openmm.System,
    start: openmm.State,
    made: Mapping[str, openmm.Integrator],
    place: str,
    steps: int,
    rounds: int,
    picoseconds: float,
) -> Iterator[dict[str, Any]]:
    """Milliseconds a step, residual, and drift at constant energy."""
    contexts = {name: placed(system, integrator, place) for name, integrator in made.items()}
    for name, context in contexts.items():
        context.setState(start)
        made[name].step(2 * steps)
        context.getState(energy=True)

    def call(name: str) -> None:
        made[name].step(steps)
        contexts[name].getState(energy=True)

    calls = {name: partial(call, name) for name in made}
    precision = str(Precision.of(next(iter(contexts.values()))))
    about = {"part": "speed", "system": title, "atoms": system.getNumParticles(), "precision": precision}
    for name, row in harness.speeds(harness.in_turn(calls, rounds, clock=time.perf_counter), steps).items():
        off = residual(system, positions_of(contexts[name])) if system.getNumConstraints() else 0.0
        moved: dict[str, float] = {}
        if name.startswith("rattle"):
            contexts[name].setState(start)
            freedom = made[name].degrees_of_freedom()
            moved = drift(made[name], contexts[name], picoseconds, freedom)
        yield {**about, "integrator": name, **row, "residual": off, **moved}


def bonds_and_angles(place: str, full: bool) -> Iterator[dict[str, Any]]:
    """All bonds and angles of villin by kernels at 4 fs, beside Verlet with bonds to hydrogen at 2 fs."""
    plain, positions = protein(VILLIN, app.HBonds)
    start = start_of(plain, positions, place, 2000 if full else 20)
    system, _ = protein(VILLIN, app.HBonds)
    move_constraints(system)
    topology = app.PDBFile(str(VILLIN)).topology
    held = constraints_of(topology, start.getPositions(), "allangles", system=system)
    integrator, again = (ProjectedIntegrator(2 * STEP, parts=list(held), device=True) for _ in range(2))
    found = {"OpenMM beside rattle": openmm.VerletIntegrator(STEP)}
    rows = list(measured("Villin, HBonds", plain, start, found, place, *LENGTH[full]))
    context = placed(system, integrator, place)
    context.setPositions(start.getPositions())
    context.setPeriodicBoxVectors(*start.getPeriodicBoxVectors())
    integrator.applyConstraints(context)
    integrator.setVelocitiesToTemperature(context, TEMPERATURE, 1)
    now = context.getState(positions=True, velocities=True)
    rows += measured("Villin, bonds and angles, 4 fs", system, now, {"rattle, device": again}, place, *LENGTH[full])
    rows[-1]["ratio"] = rows[0]["ms"] / rows[-1]["ms"]
    yield from rows


def pieces(chosen: argparse.Namespace) -> dict[str, Callable[[], Iterator[dict[str, Any]]]]:
    full = not chosen.quick
    systems: dict[str, Callable[[], Any]] = {"rigid water": partial(water, 4.3 if full else 1.3)}
    for name in ("HBonds", "AllBonds"):
        systems[f"Villin, {name}"] = partial(protein, VILLIN, getattr(app, name))
    found: dict[str, Callable[[], Iterator[dict[str, Any]]]] = {}
    for place in chosen.platform or ["CPU"]:
        found |= {f"{place}, {name}": partial(side_by_side, name, make, place, full) for name, make in systems.items()}
        found[f"{place}, without forces"] = partial(without_forces, place, full)
        found[f"{place}, angles"] = partial(bonds_and_angles, place, full)
    wanted = chosen.part or ("" if full else ("rigid water", "without forces"))
    return {name: piece for name, piece in found.items() if name.endswith(wanted)}


def tables(table: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Milliseconds a step, speed relative to Verlet's, largest residual, drift in kT/ns a degree of freedom."""
    columns = {"system": "{}", "precision": "{}", "integrator": "{}", "ms": "{:.3f}", "ratio": "{:.2f}"}
    moved = {"residual": "{:.0e}", "slope": "{:+.1e}", "error": "{:.0e}"}
    return {"speed": harness.shown(table, "speed", **columns, **moved)}


def main() -> None:
    parser = harness.options(__doc__, "openmm-device")
    parser.add_argument("--platform", action="append", help="such as 'CUDA mixed'; may be given several times")
    parser.add_argument("--part", default="", help="one of: rigid water, HBonds, AllBonds, without forces, angles")
    parser.add_argument("--device", default="", help="the name of the processor, where that is a GPU")
    harness.main("openmm_device", parser, pieces, tables)


if __name__ == "__main__":
    main()
