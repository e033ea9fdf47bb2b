"""OpenMM at 4 fs with all bonds and all angles held: how well the rows stay, and whether the energy drifts.

    python openmm_four_femtoseconds.py                   alanine dipeptide for 4 ps on the CPU
    python openmm_four_femtoseconds.py --full --out F    the committed results
    python openmm_four_femtoseconds.py --platform "CUDA mixed" --add F   three runs of villin more, into F
    python openmm_four_femtoseconds.py --show F          the tables of an earlier run

Alanine dipeptide and villin in implicit solvent (amber14, OBC2, no cutoff). What is held is what
constraints_of(..., "allangles") gives at an energy minimum. The run starts after 5 ps of Langevin dynamics at 300 K.
The drift is the slope in kT a nanosecond and degree of freedom, with its standard error from ten blocks: of the total
energy H at the ends of steps, and of the energy that steps of length h conserve to fourth order (Hairer, Lubich and
Wanner, Geometric Numerical Integration, IX.3),

    H + h^2 (f.M_par^+ f/24 - d(f.v)/dt/12),

which does not follow what a molecule does to the difference of the two when it changes its shape. Residuals are the
largest of all rows (nm, radian) at the ends of calls of 50 steps. With --full villin runs from other starts as well,
for 50 ps each: is a change of the energy one of precision, of the step, or of the run? Blocks within a run do not know
of a walk; the error of the mean over runs, from their scatter, does.
"""

from __future__ import annotations

import argparse
import copy
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import openmm
import study_scripts as scripts
from openmm import app, unit
from rich.console import Console

from kcons import ConstraintSet, Motion
from kcons.comparison import environment, json_files
from kcons.constraints import Angle, Constraint, Distance
from kcons.openmm import Langevin, ProjectedIntegrator, constraints_of, hold, positions_of
from kcons.topology import HeldRows, bond_angles

DATA = Path(__file__).resolve().parents[2] / "tests" / "data"
TEMPERATURE, STEP, CALL = 300.0, 0.004, 50
#: Platforms, steps and numbers of villin's other runs, each from a start of its own.
AGAIN = (("OpenCL mixed", STEP, 3), ("OpenCL double", STEP, 1), ("OpenCL mixed", STEP / 2, 1))
KT = 0.00831446261815324 * TEMPERATURE
#: The structures by name. Villin comes with OpenMM, in water and with ions, which are taken away.
STRUCTURES = {
    "alanine dipeptide": DATA / "alanine-dipeptide-implicit.pdb",
    "villin": Path(app.__file__).parent / "data" / "test.pdb",
}


# -- what is held -----------------------------------------------------------------------------------


@cache
def protein(path: Path) -> tuple[app.Topology, openmm.System, np.ndarray]:
    """Topology, System without constraints, and positions near a minimum of its energy."""
    pdb = app.PDBFile(str(path))
    model = app.Modeller(pdb.topology, pdb.positions)
    model.delete([residue for residue in model.topology.residues() if residue.name in ("HOH", "Cl", "Na")])
    field = app.ForceField("amber14-all.xml", "implicit/obc2.xml")
    system = field.createSystem(model.topology, nonbondedMethod=app.NoCutoff)
    context = openmm.Context(system, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatformByName("CPU"))
    context.setPositions(model.positions)
    openmm.LocalEnergyMinimizer.minimize(context, 1, 300)
    return model.topology, system, positions_of(context)


def condition(items: list[Constraint], x: np.ndarray, masses: np.ndarray) -> tuple[int, int, float]:
    """Rows, rank, and the condition number of the independent ones: rows of length 1, weighted with the masses."""
    whole = ConstraintSet(items, x, masses)
    rows = whole.jacobian(x).toarray() / np.sqrt(np.repeat(masses, 3))
    s = np.linalg.svd(rows / np.linalg.norm(rows, axis=1, keepdims=True), compute_uv=False)
    rank = int((s > 1e-9 * s[0]).sum())
    return len(rows), rank, float(s[0] / s[rank - 1])


def conditions(held: HeldRows, x: np.ndarray) -> dict[str, tuple[int, int, float]]:
    """Of the rows that are held, and of all bonds and all angles as they are."""
    bonds = held.topology.bonds
    plain = [Distance(bonds), Angle(bond_angles(bonds, len(x)))]
    return {
        "held": condition(list(held), x, held.topology.masses),
        "every angle": condition(plain, x, held.topology.masses),
    }


# -- the runs ---------------------------------------------------------------------------------------


def placed(
    system: openmm.System, held: HeldRows, x: np.ndarray, place: str, step: float, seed: int = 1, **options: Any
) -> tuple[Any, ...]:
    """Integrator, rows and Context on a copy of the System."""
    own = copy.deepcopy(system)
    part = hold(own, held.constraint_set.constraints, x)
    integrator = ProjectedIntegrator(step, parts=[part], **options)
    integrator.setRandomNumberSeed(seed)
    name, _, precision = place.partition(" ")
    properties = {"Precision": precision} if precision else {}
    context = openmm.Context(own, integrator, openmm.Platform.getPlatformByName(name), properties)
    return integrator, part, context


class Looks:
    """What a Context is asked for: its energy H, f.v, and f.M_par^+ f."""

    def __init__(self, context: openmm.Context, held: HeldRows, x: np.ndarray) -> None:
        self.context, self.masses = context, held.topology.masses
        self.motion = Motion(ConstraintSet(held.constraint_set.constraints, x, self.masses), x)

    def power(self) -> float:
        state = self.context.getState(velocities=True, forces=True)
        return float(np.sum(state.getForces(asNumpy=True)._value * state.getVelocities(asNumpy=True)._value))

    def energy(self) -> tuple[float, float]:
        state = self.context.getState(positions=True, forces=True, energy=True)
        x, f = state.getPositions(asNumpy=True)._value, state.getForces(asNumpy=True)._value
        along = self.motion.project_velocities(x, f / self.masses[:, None])
        total = (state.getKineticEnergy() + state.getPotentialEnergy()).value_in_unit(unit.kilojoule_per_mole)
        return float(total), float(self.masses @ np.einsum("ij,ij->i", along, along))


def run(name: str, place: str, picoseconds: float, warm_up: float, step: float = STEP, seed: int = 1) -> dict[str, Any]:
    """One structure: drift, residuals; with the first seed, which is that of what comes before, conditions."""
    topology, system, x = protein(STRUCTURES[name])
    held = constraints_of(topology, x, "allangles", system=system)
    integrator, _, context = placed(system, held, x, place, step, seed, ensemble=Langevin(TEMPERATURE, 5.0))
    context.setPositions(x)
    integrator.setVelocitiesToTemperature(context, TEMPERATURE, seed)
    integrator.step(round(warm_up / step))
    start = context.getState(positions=True, velocities=True)
    integrator, part, context = placed(system, held, x, place, step)
    context.setState(start)
    energies, conserved, residuals, temperatures = [], [], [], []
    looks = Looks(context, held, x)
    for _ in range(round(picoseconds / step / CALL)):
        integrator.step(CALL - 2)
        before = looks.power()
        integrator.step(1)
        total, square = looks.energy()
        integrator.step(1)
        change = (looks.power() - before) / (2 * step)
        energies.append(total)
        conserved.append(total + step**2 * (square / 24 - change / 12))
        residuals.append(part.report(context, condition=False).residual)
        temperatures.append(integrator.computeSystemTemperature().value_in_unit(unit.kelvin))
    freedom = integrator.degrees_of_freedom()
    t = np.arange(len(energies)) * CALL * step * 1e-3
    drifts = [scripts.slope(t, np.array(values) / (KT * freedom)) for values in (energies, conserved)]
    return {
        "atoms": len(x),
        **({"conditions": conditions(held, x)} if seed == 1 else {}),
        "rows": held.summary(),
        "freedom": freedom,
        "place": place,
        "step": step,
        "seed": seed,
        "picoseconds": len(energies) * CALL * step,
        "temperature": float(np.mean(temperatures)),
        "residual": float(np.max(residuals)),
        "drift": dict(zip(("slope", "error"), drifts[0], strict=True)),
        "drift of what steps conserve": dict(zip(("slope", "error"), drifts[1], strict=True)),
        "scatter": [float(np.std(values) / KT) for values in (energies, conserved)],
    }


# -- output -----------------------------------------------------------------------------------------


def show(result: dict[str, Any]) -> None:
    console = Console(width=130)
    rows = []
    for name, runs in result["runs"].items():
        for which, (count, rank, number) in runs["conditions"].items():
            rows.append((f"{name}, {runs['atoms']} atoms", which, f"{count}", f"{rank}", f"{number:.3g}"))
    console.print(
        scripts.table("Rows", ("molecule", "angles", "rows", "rank", "condition"), {"molecule", "angles"}, rows)
    )
    headings = (
        "molecule",
        "platform",
        "fs",
        "ps",
        "freedom",
        "K",
        "residual",
        "drift, kT/ns/dof",
        "of what is conserved",
    )
    rows = [
        (
            name,
            runs["place"],
            f"{1000 * runs['step']:g}",
            f"{runs['picoseconds']:g}",
            f"{runs['freedom']}",
            f"{runs['temperature']:.0f}",
            f"{runs['residual']:.1e}",
            *(
                f"{drift['slope']:+.1e} ± {drift['error']:.0e}"
                for drift in (runs["drift"], runs["drift of what steps conserve"])
            ),
        )
        for name, runs in [*result["runs"].items(), *(("villin", runs) for runs in result["again"])]
    ]
    console.print(scripts.table("Constant energy", headings, {"molecule", "platform"}, rows))
    console.print(over_runs(result))
    machine = result["machine"]
    console.print(f"OpenMM {machine['versions']['openmm']}; {machine['date']}")


def over_runs(result: dict[str, Any]) -> str:
    """Villin's mean slope over all runs of the full step, with an error from their scatter."""
    runs = [each for each in (result["runs"].get("villin"), *result["again"]) if each and each["step"] == STEP]
    if len(runs) < 3:
        return ""
    slopes = np.array([each["drift of what steps conserve"]["slope"] for each in runs])
    mean, error = slopes.mean(), slopes.std(ddof=1) / np.sqrt(len(slopes))
    return f"villin at 4 fs, of what is conserved: {mean:+.1e} ± {error:.0e}, from the scatter of {len(runs)} runs"


def added(known: dict[str, Any], place: str) -> dict[str, Any]:
    """A result with three runs of villin more, on another platform."""
    machine = environment()
    about = {key: machine[key] for key in ("cpu", "commit", "date")}
    more = [run("villin", place, 50.0, 5.0, STEP, seed) | about for seed in range(2, 5)]
    return known | {"again": [*known["again"], *more]}


def measured(chosen: argparse.Namespace) -> dict[str, Any]:
    """All runs, of which those that are done are in the file; with --full runs on other platforms stay in it."""
    names = chosen.structure or (list(STRUCTURES) if chosen.full else ["alanine dipeptide"])
    place = chosen.platform or ("OpenCL mixed" if chosen.full else "CPU")
    picoseconds = chosen.picoseconds or (100.0 if chosen.full else 4.0)
    known = json_files.read(chosen.out)["again"] if chosen.full and chosen.out and chosen.out.exists() else []
    others = [each for each in known if each["place"] not in {where for where, _, _ in AGAIN}]
    machine = environment()
    result: dict[str, Any] = {"machine": machine, "full": chosen.full, "runs": {}, "again": others}

    def keep() -> None:
        if chosen.out:
            json_files.write(chosen.out, result)

    for name in names:
        result["runs"][name] = run(name, place, picoseconds, 5.0 if chosen.full else 0.2)
        keep()
    about = {key: machine[key] for key in ("cpu", "commit", "date")}
    own: list[dict[str, Any]] = []
    for where, step, count in AGAIN * chosen.full:
        for seed in range(2, 2 + count):
            own.append(run("villin", where, picoseconds / 2, 5.0, step, seed) | about)
            result["again"] = [*own, *others]
            keep()
    return result


def main() -> None:
    parser = scripts.options(__doc__, full="both molecules, 100 ps on OpenCL in mixed precision")
    parser.add_argument("--platform", help="such as CPU or 'OpenCL mixed'")
    parser.add_argument("--structure", action="append", choices=list(STRUCTURES), help="may be given several times")
    parser.add_argument("--picoseconds", type=float, help="length of the runs")
    parser.add_argument("--add", type=Path, metavar="F", help="a result to add three runs of villin to")
    chosen = parser.parse_args()
    if chosen.add:
        json_files.write(chosen.add, added(json_files.read(chosen.add), chosen.platform or "CPU"))
    scripts.script(parser, measured, show, ["--show", str(chosen.add)] if chosen.add else None)


if __name__ == "__main__":
    main()
