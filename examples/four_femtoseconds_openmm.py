"""A protein in OpenMM at steps of 4 fs: bonds to hydrogen held, hydrogens made heavier, lengths checked.

Run with ``python examples/four_femtoseconds_openmm.py [FILE.pdb]``; some ten seconds. Without a file, villin is taken,
which comes with OpenMM, without its water. Replace the force field by yours.
"""

import sys
from pathlib import Path

from openmm import Platform, app, unit

from kcons.openmm import Langevin, ProjectedIntegrator, worst_length

pdb = app.PDBFile(sys.argv[1] if sys.argv[1:] else str(Path(app.__file__).parent / "data" / "test.pdb"))
molecule = app.Modeller(pdb.topology, pdb.positions)
molecule.deleteWater()  # for a short run in vacuum; with water, say nonbondedMethod=app.PME below
field = app.ForceField("amber14-all.xml", "amber14/tip3pfb.xml")
system = field.createSystem(molecule.topology, constraints=app.HBonds, hydrogenMass=3 * unit.dalton)

integrator = ProjectedIntegrator(4 * unit.femtoseconds, ensemble=Langevin(300 * unit.kelvin, 1 / unit.picosecond))
simulation = app.Simulation(molecule.topology, system, integrator, Platform.getPlatformByName("CPU"))
simulation.context.setPositions(molecule.positions)
simulation.minimizeEnergy(maxIterations=100)
integrator.setVelocitiesToTemperature(simulation.context, 300 * unit.kelvin, 1)

log = {"time": True, "potentialEnergy": True, "temperature": True}
simulation.reporters.append(app.StateDataReporter(sys.stdout, 20, **log, separator="  "))
simulation.step(100)

name, off = worst_length(simulation.context)
print(f"{system.getNumConstraints()} lengths held; {name} is off by most, {off:.0e} of its length")
print(f"{integrator.degrees_of_freedom()} degrees of freedom")
assert off < 1e-6
