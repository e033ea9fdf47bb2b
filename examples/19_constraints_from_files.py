"""Constraints from files: villin as MDAnalysis, ASE and OpenMM see it, adenylate kinase, and a million atoms.

python examples/19_constraints_from_files.py             half a minute
python examples/19_constraints_from_files.py --million   and the time that a million atoms take
"""

from __future__ import annotations

import argparse
import time
import warnings
from pathlib import Path

import ase.io
import MDAnalysis
import numpy as np
from openmm import app
from rich.console import Console
from rich.table import Table

import kcons.ase
import kcons.mdanalysis
import kcons.openmm
from kcons import Motion
from kcons.mdanalysis import open_universe
from kcons.topology import HeldRows, Snapshot, Topology, held_rows

VILLIN = Path(app.__file__).parent / "data" / "test.pdb"
KINDS = ("hbonds", "allbonds", "hangles")


def three_views(console: Console) -> None:
    """One file, three readers, the same rows."""
    universe, atoms, pdb = open_universe(VILLIN), ase.io.read(VILLIN), app.PDBFile(str(VILLIN))
    table = Table(title="Villin in water, 8867 atoms: rows as MDAnalysis, ASE and OpenMM see it")
    for heading in ("constrain", "rows", "same atoms", "largest difference of targets, Å"):
        table.add_column(heading, justify="right")
    for kind in KINDS:
        one = kcons.mdanalysis.constraints_of(universe, kind)
        two = kcons.ase.constraints_of(atoms, kind)
        three = kcons.openmm.constraints_of(pdb.topology, pdb.positions, kind)
        same, apart = True, 0.0
        for a, b, c in zip(one, two, three, strict=True):
            unit = 1.0 if a.family == "Angle" else 10.0
            same &= bool(np.array_equal(a.atoms, b.atoms) and np.array_equal(a.atoms, c.atoms))
            apart = max(
                apart, float(np.abs(a.target - b.target).max()), float(np.abs(a.target - unit * c.target).max())
            )
        table.add_row(kind, one.summary(), "yes" if same else "no", f"{apart:.0e}")
    console.print(table)


def described(title: str, rows: HeldRows, console: Console) -> None:
    motion = Motion(rows.constraint_set, rows.snapshot.positions)
    extra = f"; {rows.bonds_guessed:,} bonds guessed" if rows.bonds_guessed else ""
    sites = f"; {len(rows.virtual_sites):,} virtual sites placed" if len(rows.virtual_sites) else ""
    console.print(f"{title}: {rows.summary()}{extra}{sites}")
    console.print(f"    rank {motion.rank:,}, degrees of freedom {motion.degrees_of_freedom:,}")


def adenylate_kinase(console: Console) -> None:
    """Real files of several engines, where MDAnalysisTests is installed."""
    try:
        from MDAnalysis.tests import datafiles
    except ImportError:
        console.print("adenylate kinase: python -m pip install MDAnalysisTests")
        return
    of = kcons.mdanalysis.constraints_of
    described("CHARMM PSF and CRD, hangles", of(open_universe(datafiles.PSF, datafiles.CRD), "hangles"), console)
    described("PDB without bonds, hbonds", of(open_universe(datafiles.PDB_small), "hbonds"), console)
    described(
        "Gromacs TPR and GRO, TIP4P water, hbonds", of(open_universe(datafiles.TPR, datafiles.GRO), "hbonds"), console
    )
    rings = of(open_universe(datafiles.PSF, datafiles.CRD), "hbonds", rigid_residues=["PHE", "TYR", "HSD"])
    console.print(f"CHARMM, hbonds, with PHE, TYR and HSD rigid: {rings.summary()}")


def million(console: Console) -> None:
    """333,400 waters in a box, as arrays."""
    n = 333_400
    edge = int(np.ceil(n ** (1 / 3)))
    grid = 3.1 * np.stack(np.meshgrid(*[np.arange(edge)] * 3, indexing="ij"), -1).reshape(-1, 3)[:n]
    angle = np.radians(104.52)
    shape = np.array([[0, 0, 0], [0.9572, 0, 0], [0.9572 * np.cos(angle), 0.9572 * np.sin(angle), 0]])
    turned = shape @ np.linalg.qr(np.random.default_rng(0).normal(size=(n, 3, 3)))[0]
    topology = Topology(
        names=np.tile(["OW", "HW1", "HW2"], n),
        elements=np.tile(["O", "H", "H"], n),
        masses=np.tile([15.999, 1.008, 1.008], n),
        residues=np.repeat(np.arange(n), 3),
        residue_names=np.full(n, "SOL"),
        residue_ids=np.arange(n).astype(str),
        chains=np.full(n, ""),
        bonds=np.zeros((0, 2), dtype=np.int64),
    )
    x = (grid[:, None] + turned).reshape(-1, 3)
    made = Snapshot(topology, x, cell=np.eye(3) * 3.1 * edge, pbc=np.ones(3, dtype=bool))
    table = Table(title=f"{3 * n:,} atoms, from arrays to a constraint set")
    for heading in ("what", "rows", "processor time, s", "wall time, s"):
        table.add_column(heading, justify="right")
    cases = {
        "rigid water, hbonds": {"constrain": "hbonds"},
        "flexible, bonds guessed, all angles": {"constrain": "allangles", "rigid_water": False},
        "every molecule a rigid residue": {"constrain": "none", "rigid_water": False, "rigid_residues": ["SOL"]},
    }
    for name, options in cases.items():
        cpu, wall = time.process_time(), time.perf_counter()
        rows = held_rows(made, **options)  # type: ignore[arg-type]
        took = time.process_time() - cpu, time.perf_counter() - wall
        table.add_row(name, f"{rows.constraint_set.n_rows:,}", f"{took[0]:.1f}", f"{took[1]:.1f}")
    console.print(table)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--million", action="store_true", help="time a million atoms")
    options = parser.parse_args()
    console = Console(width=130)
    console.print(f"MDAnalysis {MDAnalysis.__version__}")
    with warnings.catch_warnings():
        # Readers miss elements, ASE takes HG for mercury, bonds are guessed: all said in the table or in the docs.
        warnings.simplefilter("ignore")
        three_views(console)
        adenylate_kinase(console)
        if options.million:
            million(console)


if __name__ == "__main__":
    main()
