"""Which method and which time step for your own molecules: error against cost, measured on a PDB file.

Run with ``python examples/compare_your_file.py [FILE.pdb]``; some ten seconds with villin in vacuum, which is taken
without a file, minutes with larger ones. On the command line: ``kcons compare FILE.pdb --constrain hbonds``.
"""

import sys
from pathlib import Path

from openmm import app

from kcons.comparison import compare, figure, observed_orders, rank, test_systems, text

path = sys.argv[1] if sys.argv[1:] else "villin.pdb"
if path == "villin.pdb":  # comes with OpenMM; without its water it takes seconds
    pdb = app.PDBFile(str(Path(app.__file__).parent / "data" / "test.pdb"))
    molecule = app.Modeller(pdb.topology, pdb.positions)
    molecule.deleteWater()
    with open(path, "w") as file:
        app.PDBFile.writeFile(molecule.topology, molecule.positions, file)

force_field = ("amber14-all.xml", "amber14/tip3pfb.xml")  # files of OpenMM, or yours
system = test_systems.from_file(path, quick=True, constrain="hbonds", force_field=force_field)
print(system.title)
methods = ["rattle", "blanes-moan4", "openmm-verlet"]  # `kcons compare --list` names all
table = compare(system, methods, budget=2, rounds=1)  # a row a method and time step; seconds for each method

print(table[["title", "setting", "error", "sigma", "step_seconds"]].to_string(index=False))
print(text(table, rank(table)))
print(f"halving the step of RATTLE divides the error by {2 ** observed_orders(table)['kcons RATTLE']:.1f}")
figure(table).savefig("compare.png", dpi=150)
