"""Free energy along a torsion: hydrogen peroxide with GFN2-xTB, held at four angles, mean forces integrated.

Run with ``python examples/free_energy.py``; some ten seconds, with windows of 170 steps. ``--full`` takes 5000 steps,
and reaches each window from two sides, in some minutes. Windows are kept in a folder; a run that was stopped goes on.
"""

import sys
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
from ase.build import molecule
from tblite.ase import TBLite

from kcons.constraints import Dihedral, Distance
from kcons.free_energy import AseWindows, Settings, Windows, plot_profile

full = "--full" in sys.argv
atoms = molecule("H2O2")
torsion = Dihedral([[2, 0, 1, 3]])
bonds = Distance([[0, 1], [0, 2], [1, 3]])
model = partial(TBLite, method="GFN2-xTB", verbosity=0)  # makes a calculator: put yours here
sampler = AseWindows(atoms, model, {"torsion": torsion}, [bonds])
settings = Settings(relax=2, pull=20, equilibration=20, production=5000 if full else 170, every=5)

windows = Windows(
    sampler, f"free_energy{'_full' if full else ''}", settings, both_sides=full, executor=ThreadPoolExecutor(1)
)
result = windows.run(np.radians(np.arange(90, 181, 30)))
assert not result.failed
for window in result.windows:
    angle, force, error = np.degrees(window.value[0]), window.force[0], window.error[0]
    print(f"{angle:6.1f} degrees: mean force {force:8.3f} ± {error:.3f} kJ/mol/rad")

rise = result.profile.difference(np.pi, np.pi / 2)
print(f"free energy at 90 degrees, above that at 180: {rise.value:.2f} ± {rise.error:.2f} kJ/mol")
plot_profile(result.profile, coordinate="torsion / rad", energy="kJ/mol").savefig("free_energy.png")
