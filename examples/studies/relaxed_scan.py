"""Relaxed torsion scans: the profile of a molecule, and what it costs beside geomeTRIC and Sella.

    python relaxed_scan.py --quick --out DIR   seconds: H2O2 by EMT, both ways
    python relaxed_scan.py --out DIR           minutes: 20 molecules by GFN2-xTB, for docs/evidence/free_energy.md

In full (needs tblite, geometric and sella, from the package index) every torsion is scanned at 24 values. Each of
the three programs relaxes each point from the same structure, that of the neighboring point with the group beyond the
bond turned, until no force along the constraint is larger than FMAX on any atom; geomeTRIC's other criteria are off,
all else is left as its authors set it. Counted are calls of energy and forces. Energies are compared with those that
geomeTRIC comes to from there with a criterion ten times sharper. geomeTRIC also runs a scan of its own, in which each
point begins from the last one. Counts and energies depend on the machine by rounding only.
"""

from __future__ import annotations

import contextlib
import io
import logging
import os
import tempfile
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import harness
import numpy as np
import pandas as pd
from ase import Atoms, units
from ase.build import molecule
from ase.calculators.emt import EMT

from kcons.ase import Constraints
from kcons.constraints import Dihedral
from kcons.free_energy import Scan, scan

#: The largest force left on an atom, eV/angstrom.
FMAX = 0.005
KJ = units.mol / units.kJ
POINTS = 24
#: What the scan that geomeTRIC makes by itself is called.
SCAN = "geomeTRIC's scan"
#: Molecules of ASE's G2 set, and the torsion of each.
MOLECULES: dict[str, tuple[int, int, int, int]] = {
    "H2O2": (2, 0, 1, 3),
    "C2H6": (2, 0, 1, 5),
    "CH3OH": (2, 0, 1, 3),
    "CH3CH2OH": (0, 1, 2, 3),
    "C3H8": (1, 0, 2, 6),
    "trans-butane": (0, 1, 2, 3),
    "isobutane": (3, 2, 0, 1),
    "CH3CHO": (0, 1, 3, 4),
    "HCOOH": (3, 0, 1, 2),
    "CH3COOH": (1, 0, 2, 3),
    "H3CNH2": (2, 0, 1, 3),
    "N2H4": (2, 0, 1, 4),
    "OCHCHO": (2, 0, 1, 4),
    "CH3COCH3": (0, 1, 2, 4),
    "CH3OCH3": (2, 1, 0, 3),
    "CH3SH": (3, 0, 1, 2),
    "butadiene": (0, 1, 2, 3),
    "CH3NO2": (2, 0, 1, 5),
    "HCOOCH3": (1, 0, 2, 4),
    "CH3ONO": (0, 1, 5, 6),
}


class Counted:
    """Energy and forces of a structure by GFN2-xTB, and how often they were asked for."""

    def __init__(self, atoms: Atoms) -> None:
        from tblite.ase import TBLite

        self.atoms = atoms.copy()
        self.atoms.calc = TBLite(method="GFN2-xTB", verbosity=0)
        self.calls = 0
        calculate = self.atoms.calc.calculate

        def counted(*given: Any, **named: Any) -> None:
            self.calls += 1
            calculate(*given, **named)

        self.atoms.calc.calculate = counted


def start(atoms: Atoms, quad: tuple[int, int, int, int], value: float, positions: np.ndarray) -> np.ndarray:
    """A structure with its torsion turned to a value."""
    turned = atoms.copy()
    turned.positions[:] = positions
    held = Constraints([Dihedral([quad], value)])
    turned.set_constraint(held)
    held.restore(turned)
    return turned.positions.copy()


def engine(counted: Counted, frame: Any) -> Any:
    """What geomeTRIC asks for energies."""
    from geometric.engine import Engine

    class OfAtoms(Engine):
        def calc_new(self, coords: np.ndarray, dirname: str) -> dict[str, Any]:
            counted.atoms.positions[:] = coords.reshape(-1, 3) * units.Bohr
            counted.calls += 1
            energy = counted.atoms.get_potential_energy() / units.Hartree
            gradient = -counted.atoms.get_forces().ravel() / units.Hartree * units.Bohr
            counted.calls -= 1  # the calculator counts
            return {"energy": energy, "gradient": gradient}

    return OfAtoms(frame)


def criteria(fmax: float) -> dict[str, float]:
    """Of geomeTRIC: the largest force on an atom, and nothing else."""
    others = dict.fromkeys(("energy", "grms", "drms", "dmax"), 1e3)
    return {f"convergence_{name}": v for name, v in {**others, "gmax": fmax / units.Hartree * units.Bohr}.items()}


def by_geometric(
    atoms: Atoms, quad: tuple[int, ...], value: float, positions: np.ndarray, fmax: float = FMAX
) -> tuple[float, int]:
    """Energy in eV, and calls."""
    from geometric.internal import DelocalizedInternalCoordinates
    from geometric.molecule import Molecule
    from geometric.optimize import Optimize
    from geometric.params import OptParams
    from geometric.prepare import parse_constraints

    frame = Molecule()
    frame.elem, frame.xyzs, frame.comms = list(atoms.symbols), [positions.copy()], [""]
    frame.build_topology()
    numbers = " ".join(str(a + 1) for a in quad)
    names, values = parse_constraints(frame, f"$set\ndihedral {numbers} {np.degrees(value):.12f}\n")
    internals = DelocalizedInternalCoordinates(
        frame, build=True, connect=False, addcart=False, constraints=names, cvals=values[0]
    )
    counted = Counted(atoms)
    with tempfile.TemporaryDirectory() as folder:
        found = Optimize(
            positions.ravel() / units.Bohr, frame, internals, engine(counted, frame), folder,
            OptParams(**criteria(fmax)), print_info=False,
        )  # fmt: skip
    return float(found.qm_energies[-1]) * units.Hartree, counted.calls


def scanned_by_geometric(atoms: Atoms, quad: tuple[int, ...], first: float, positions: np.ndarray) -> int:
    """Calls of its own scan once around, in the steps of this one."""
    from geometric.molecule import Molecule
    from geometric.optimize import run_optimizer

    frame = Molecule()
    frame.elem, frame.xyzs, frame.comms = list(atoms.symbols), [positions.copy()], [""]
    frame.build_topology()
    counted = Counted(atoms)
    begin = np.degrees(first)
    end = begin + 360.0 * (POINTS - 1) / POINTS
    home = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            numbers = " ".join(str(a + 1) for a in quad)
            Path("scan.txt").write_text(f"$scan\ndihedral {numbers} {begin:.10f} {end:.10f} {POINTS}\n")
            with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
                run_optimizer(
                    customengine=engine(counted, frame), input="scan.in", prefix="scan", constraints="scan.txt",
                    check=0, **criteria(FMAX),
                )  # fmt: skip
        finally:
            os.chdir(home)
    return counted.calls


def by_sella(atoms: Atoms, quad: tuple[int, ...], value: float, positions: np.ndarray) -> tuple[float, int]:
    """Energy in eV, and calls."""
    from sella import Constraints as Held
    from sella import Sella

    counted = Counted(atoms)
    counted.atoms.positions[:] = positions
    held = Held(counted.atoms)
    held.fix_dihedral(tuple(quad), target=float(np.degrees(value)))
    search = Sella(counted.atoms, constraints=held, internal=True, order=0, logfile=None)
    search.run(fmax=FMAX, steps=200)
    if not search.converged():
        raise RuntimeError("not converged")
    return counted.atoms.get_potential_energy(), counted.calls


def by_ase(atoms: Atoms, quad: tuple[int, ...], value: float, positions: np.ndarray) -> tuple[float, int]:
    """Energy in eV, and calls, of BFGS under the constraint of kcons."""
    from ase.optimize import BFGS

    counted = Counted(atoms)
    counted.atoms.positions[:] = positions
    counted.atoms.set_constraint(Constraints([Dihedral([list(quad)], value)]))
    if not BFGS(counted.atoms, logfile=None).run(fmax=FMAX, steps=200):
        raise RuntimeError("not converged")
    return counted.atoms.get_potential_energy(), counted.calls


def compared(name: str) -> dict[str, Any]:
    """One molecule: calls of each program, and how far its energies are from the sharp ones, in kJ/mol."""
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    quad = MOLECULES[name]
    atoms = molecule(name)
    counted = Counted(atoms)
    turn = Dihedral([quad])
    begin = float(turn.measure(atoms.positions[None, list(quad)], 0.0)[0])
    values = begin + 2 * np.pi * np.arange(POINTS) / POINTS
    found = scan(counted.atoms, turn, values, fmax=FMAX, both_ways=False)
    both = scan(counted.atoms, turn, values, fmax=FMAX)
    result: dict[str, Any] = {
        "molecule": name,
        "torsion": list(quad),
        "barrier": float(np.ptp(both.energies)) * KJ,
        "failures": len(found.failed) + len(both.failed),
        "calls": {"kcons": found.evaluations},
        "points": {"kcons": [attempt.evaluations for attempt in found.attempts]},
        "both ways": {
            "relaxations": len(both.attempts),
            "calls": both.evaluations,
            "hysteresis": float(np.nanmax(both.hysteresis)) * KJ,
            "lower": float(np.max(found.energies - both.energies)) * KJ,
        },
        "off": {},
    }
    starts = [
        start(
            atoms,
            quad,
            found.grid.at(a.point)[0],
            atoms.positions if a.source is None else found.attempts[a.source].positions,
        )
        for a in found.attempts
    ]
    angles = [found.grid.at(attempt.point)[0] for attempt in found.attempts]
    sharp = np.array([by_geometric(atoms, quad, v, x, FMAX / 10)[0] for v, x in zip(angles, starts, strict=True)])
    result["off"]["kcons"] = float(np.max(np.abs([attempt.energy for attempt in found.attempts] - sharp))) * KJ
    programs: dict[str, Callable[..., tuple[float, int]]] = {
        "geomeTRIC": by_geometric,
        "Sella": by_sella,
        "ASE": by_ase,
    }
    for program, relaxed in programs.items():
        energies, calls = zip(*(relaxed(atoms, quad, v, x) for v, x in zip(angles, starts, strict=True)), strict=True)
        result["calls"][program], result["points"][program] = sum(calls), list(calls)
        result["off"][program] = float(np.max(np.abs(np.array(energies) - sharp))) * KJ
    result["calls"][SCAN] = scanned_by_geometric(atoms, quad, begin, atoms.positions)
    return result


def rows(name: str) -> Iterator[dict[str, Any]]:
    """A row a program."""
    found = compared(name)
    about = {"part": "programs", "molecule": name, "barrier": found["barrier"], "failures": found["failures"]}
    for program, calls in found["calls"].items():
        yield {**about, "program": program, "calls": calls, "off": found["off"].get(program)}
    yield {**about, "program": "kcons, both ways", **found["both ways"]}


def profile() -> Iterator[dict[str, Any]]:
    """H2O2 by EMT."""
    atoms = molecule("H2O2")
    atoms.calc = EMT()
    found: Scan = scan(atoms, Dihedral([[2, 0, 1, 3]]), np.radians(np.arange(0, 360, 30)), fmax=FMAX)
    energies = (found.energies - found.energies.min()) * KJ
    for point, energy in zip(found.grid.points, energies.tolist(), strict=True):
        angle = found.grid.shown(point)[0]
        yield {"part": "profile", "degrees": angle, "energy": energy, "calls": found.evaluations}


def tables(table: pd.DataFrame) -> dict[str, pd.DataFrame]:
    if "program" not in table:
        return {
            "H2O2 by EMT, kJ/mol": harness.shown(table, "profile", degrees="{:.0f}", energy="{:.3f}", calls="{:.0f}")
        }
    columns = {"program": "{}", "calls": "{:.0f}", "off": "{:.4f}"}
    return {
        f"{POINTS} points, forces to {FMAX} eV/Å: calls by GFN2-xTB; how far energies are off, kJ/mol": harness.shown(
            table, "programs", molecule="{}", barrier="{:.2f}", **columns
        ),
        "All": table.groupby("program", sort=False).calls.sum().reset_index(),
    }


def main() -> None:
    harness.main(
        "relaxed_scan",
        harness.options(__doc__, "relaxed-scan"),
        lambda chosen: {"H2O2": profile} if chosen.quick else {name: partial(rows, name) for name in MOLECULES},
        tables,
    )


if __name__ == "__main__":
    main()
