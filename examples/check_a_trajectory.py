"""Did a trajectory keep its constraints? A run of ethanol with its C-H and O-H bonds held, and one without, checked.

Run with ``python examples/check_a_trajectory.py`` for these two, which it makes and writes as DCD files; or with
``python examples/check_a_trajectory.py RUN.xtc TOPOLOGY.tpr``, files of any engine whose bonds to hydrogen were held.
"""

import sys
from pathlib import Path

from ase import units
from ase.build import molecule
from ase.calculators.emt import EMT
from ase.io import write
from ase.md.verlet import VelocityVerlet

from kcons.ase import ConstrainedDynamics, constrain, constraints_of, draw_velocities
from kcons.constraints import Distance
from kcons.mdanalysis import ConstraintCheck, check_trajectory, open_universe, write_ase


def show(name, check):
    unit = check.units[0]
    print(f"{name}: {len(check.frames)} frames, {check.n_rows} rows of rank {check.rank}; {check.precision}")
    print(f"  rms {unit.rms:.1e} Å, of which rounding makes {unit.rounding_rms:.1e} Å; {check.worst[0].name} is worst")
    print(f"  {check.verdict}\n")


def run(hold, name):
    """50 fs of ethanol."""
    atoms = molecule("CH3CH2OH")
    atoms.calc = EMT()
    write("ethanol.xyz", atoms)  # which atoms there are
    bonds = constraints_of(atoms, "hbonds", guess_bonds=True)
    if hold:
        constrain(atoms, bonds)
    draw_velocities(atoms, 300, rng=1)
    dynamics = (ConstrainedDynamics if hold else VelocityVerlet)(atoms, 1 * units.fs)
    with write_ase(dynamics, name, interval=5):
        dynamics.run(50)
    return Distance(bonds[0].atoms)  # held at what they are in the first frame


if sys.argv[2:]:
    show(Path(sys.argv[1]).name, check_trajectory(sys.argv[1], sys.argv[2], "hbonds"))
else:
    for hold, name in ((True, "held.dcd"), (False, "free.dcd")):
        pairs = run(hold, name)
        check = ConstraintCheck(open_universe("ethanol.xyz", name), pairs).run().check
        show(name, check)
        assert (check.status == "kept") == hold
