"""Which method and which time step for your own molecules: error against cost, measured on a PDB file.

Run with ``python examples/compare_your_file.py [FILE.pdb]``; some ten seconds with the file that it takes by default,
the rigid water of OpenMM's tip3p.pdb. The same from the command line: kcons compare FILE.pdb --constrain hbonds
"""

import sys
from pathlib import Path

from openmm import app

from kcons.comparison import compare, figure, observed_orders, rank, test_systems, text

path = sys.argv[1] if sys.argv[1:] else Path(app.__file__).parent / "data" / "tip3p.pdb"
force_field = ("amber14-all.xml", "amber14/tip3pfb.xml")  # files of OpenMM, or yours
system = test_systems.from_file(path, quick=True, constrain="hbonds", force_field=force_field)
print(system)
