"""All bonds and all angles of alanine dipeptide at 4 fs in OpenMM: drift of the energy, and how closely rows are held.

    python examples/24_openmm_long_steps.py                    a short run
    python examples/24_openmm_long_steps.py --full --out F --platform CPU --platform "OpenCL mixed"    the committed one
    python examples/24_openmm_long_steps.py --show F           the table of an earlier run

Implicit solvent; of flat centres two angles and the plane are held. The drift is the slope of the total energy, in kT
a nanosecond and degree of freedom, with its standard error from ten blocks.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import openmm
from openmm import app
from rich.console import Console

from kcons.comparison import measure, scripts
from kcons.constraints import Angle, Dihedral, Distance
from kcons.openmm import Precision, ProjectedIntegrator, hold, positions_of

ALANINE = Path(__file__).resolve().parent.parent / "tests" / "data" / "alanine-dipeptide-implicit.pdb"
#: Time between two looks, and the whole of short runs, ps.
LOOK, SHORT = 0.1, 2.0
TEMPERATURE, KT = 300.0, 0.00831446261815324 * 300.0
Measured = dict[str, Any]
#: What is held, in the order of `bonds_and_angles`.
KINDS = (Distance, Angle, Dihedral)


# -- systems ----------------------------------------------------------------------------------------


def implicit(path: Path) -> tuple[app.Topology, openmm.System, Any]:
    """The molecule of a file in implicit solvent (OBC2)."""
    pdb = app.PDBFile(str(path))
    field = app.ForceField("amber14-all.xml", "implicit/obc2.xml")
    return pdb.topology, field.createSystem(pdb.topology), pdb.positions


def minimum(system: openmm.System, positions: Any) -> np.ndarray:
    context = placed(system, openmm.VerletIntegrator(0.001), "CPU")
    context.setPositions(positions)
    openmm.LocalEnergyMinimizer.minimize(context, 1.0, 300)
    return positions_of(context)


def placed(system: openmm.System, integrator: openmm.Integrator, place: str) -> openmm.Context:
    name, _, precision = place.partition(" ")
    properties = {"Precision": precision} if precision else {}
    return openmm.Context(system, integrator, openmm.Platform.getPlatformByName(name), properties)


def bonds_and_angles(topology: app.Topology) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Atoms of all bonds and all angles; of flat centres two angles and the plane.

    The third angle adds up with the others to 360 degrees in the plane, where its gradient is no new one.
    """
    bonds = sorted(sorted((bond[0].index, bond[1].index)) for bond in topology.bonds())
    neighbours: dict[int, list[int]] = {}
    for i, j in bonds:
        neighbours.setdefault(i, []).append(j)
        neighbours.setdefault(j, []).append(i)
    angles, planes = [], []
    for centre, around in sorted(neighbours.items()):
        pairs = list(combinations(around, 2))
        if len(around) == 3:
            pairs = pairs[:2]
            planes.append((around[0], centre, around[1], around[2]))
        angles += [(i, centre, k) for i, k in pairs]
    return np.array(bonds), np.array(angles), np.array(planes)


def coordinates(x: np.ndarray, bonds: np.ndarray, angles: np.ndarray, planes: np.ndarray) -> np.ndarray:
    """Lengths in nm; angles, and those of bonds with planes, in radian."""
    a, b, c = (x[angles[:, k]] for k in range(3))
    p, q, r, t = (x[planes[:, k]] for k in range(4))
    normal = np.cross(p - q, r - q)
    height = np.sum(normal * (t - q), axis=1)
    return np.concatenate(
        [
            np.linalg.norm(x[bonds[:, 0]] - x[bonds[:, 1]], axis=1),
            np.arctan2(np.linalg.norm(np.cross(a - b, c - b), axis=1), np.sum((a - b) * (c - b), axis=1)),
            np.arcsin(height / np.linalg.norm(normal, axis=1) / np.linalg.norm(t - q, axis=1)),
        ]
    )


# -- what is measured -------------------------------------------------------------------------------


def run(
    integrator: ProjectedIntegrator,
    context: openmm.Context,
    picoseconds: float,
    atoms: tuple[np.ndarray, np.ndarray, np.ndarray],
    wanted: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Total energies and temperatures at each `LOOK`, and by how much the worst row was off then."""
    energies, temperatures, off = [], [], 0.0
    for _ in range(round(picoseconds / LOOK)):
        integrator.step(round(LOOK / 0.004))
        state = context.getState(energy=True)
        energies.append((state.getKineticEnergy() + state.getPotentialEnergy())._value)
        temperatures.append(integrator.computeSystemTemperature()._value)
        off = max(off, float(np.abs(coordinates(positions_of(context), *atoms) - wanted).max()))
    return np.array(energies), np.array(temperatures), off


def drift(energies: np.ndarray, freedom: int) -> Measured:
    """Slope of energies at each `LOOK`, and its standard error from blocks."""
    t = 1e-3 * LOOK * np.arange(len(energies))
    y = energies / (KT * freedom)
    slope, level = np.polyfit(t, y, 1)
    left = np.array([block.mean() for block in np.array_split(y - slope * t - level, 10)])
    middle = np.array([block.mean() for block in np.array_split(t, 10)])
    error = left.std(ddof=2) / np.sqrt(np.sum((middle - middle.mean()) ** 2))
    return {"slope": float(slope), "error": float(error)}


def average(values: np.ndarray) -> Measured:
    blocks = np.array([block.mean() for block in np.array_split(values, 10)])
    return {"mean": float(values.mean()), "error": float(blocks.std(ddof=1) / np.sqrt(10))}


def holding(full: bool, places: list[str]) -> Iterator[Measured]:
    """All bonds and all angles at 4 fs, and the worst row at ten times a picosecond."""
    topology, bare, positions = implicit(ALANINE)
    start = minimum(bare, positions)
    atoms = bonds_and_angles(topology)
    wanted = coordinates(start, *atoms)
    for place in places:
        _, system, _ = implicit(ALANINE)
        rows = hold(system, [kind(some) for kind, some in zip(KINDS, atoms, strict=True)], start)
        integrator = ProjectedIntegrator(0.004, parts=[rows])
        context = placed(system, integrator, place)
        context.setPositions(start)
        for seed in range(10 if full else 1):  # the minimum takes up heat
            integrator.setVelocitiesToTemperature(context, TEMPERATURE, seed + 1)
            integrator.step(100)
        energies, temperatures, off = run(integrator, context, 100.0 if full else SHORT, atoms, wanted)
        freedom = integrator.degrees_of_freedom()
        yield {
            "held": f"{len(wanted)} rows, {freedom} degrees of freedom left",
            "platform": f"{Precision.of(context)}",
            "picoseconds": round(len(energies) * LOOK, 3),
            "drift": drift(energies, freedom),
            "temperature": average(temperatures),
            "worst row": off,
        }


# -- output -----------------------------------------------------------------------------------------


def show(result: Measured) -> None:
    headings = ("platform", "ps", "drift, kT/ns/dof", "temperature, K", "worst row, nm or radian")
    rows = []
    for row in result["rows"]:
        drifting, warmth = row["drift"], row["temperature"]
        rows.append(
            (
                row["platform"],
                f"{row['picoseconds']:g}",
                f"{drifting['slope']:+.1e} ± {drifting['error']:.0e}",
                f"{warmth['mean']:.0f} ± {warmth['error']:.0f}",
                f"{row['worst row']:.0e}",
            )
        )
    title = f"Alanine dipeptide, rattle, 4 fs, {result['rows'][0]['held']}"
    console = Console(width=120)
    console.print(scripts.table(title, headings, {"platform"}, rows))
    machine = result["machine"]
    console.print(f"{machine['cpu']}; OpenMM {machine['versions']['openmm']}; {machine['date']}")


def measured(chosen: argparse.Namespace) -> Measured:
    rows = list(holding(chosen.full, chosen.platform or ["Reference"]))
    return {"machine": measure.environment(), "full": chosen.full, "rows": rows}


def main() -> None:
    parser = scripts.options(__doc__, full="the sizes of the committed results")
    parser.add_argument("--platform", action="append", help="such as Reference or 'OpenCL mixed'; any number of times")
    scripts.script(parser, measured, show)


if __name__ == "__main__":
    main()
