"""A relaxed scan of a torsion: hydrogen peroxide with GFN2-xTB, every 15 degrees, all else relaxed.

Run with ``python examples/torsion_scan.py``; some ten seconds. Writes a table, a diagram and the structures into the
folder ``torsion_scan``. Replace the molecule, its atoms and the calculator by yours.
"""

import numpy as np
from ase import units
from ase.build import molecule
from tblite.ase import TBLite

from kcons.constraints import Dihedral
from kcons.free_energy import scan

atoms = molecule("H2O2")
atoms.calc = TBLite(method="GFN2-xTB", verbosity=0)
degrees = np.arange(-180, 180, 15)

found = scan(atoms, Dihedral([[2, 0, 1, 3]]), np.radians(degrees))
found.write("torsion_scan")
print(found.summary(), "\n")

kj_mol = (found.energies - found.energies.min()) * units.mol / units.kJ
for angle, energy in zip(degrees, kj_mol, strict=True):
    print(f"{angle:5d} degrees {energy:6.1f} kJ/mol  {'#' * round(2 * energy)}")

structure = found.structure((degrees.tolist().index(120),))
assert abs(structure.get_dihedral(2, 0, 1, 3) - 120) < 1e-9 and not found.failed
