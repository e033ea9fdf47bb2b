"""Peptide in explicit solvent, PME, bonds with hydrogen held."""

from sys import stdout

from openmm import LangevinMiddleIntegrator, Vec3
from openmm.app import PME, ForceField, HBonds, Modeller, PDBFile, PDBReporter, Simulation, StateDataReporter
from openmm.unit import femtosecond, kelvin, nanometer, picosecond

pdb = PDBFile("alanine-dipeptide-implicit.pdb")
forcefield = ForceField("amber14-all.xml", "amber14/tip3pfb.xml")
modeller = Modeller(pdb.topology, pdb.positions)
modeller.addSolvent(forcefield, boxSize=Vec3(1.6, 1.6, 1.6))
system = forcefield.createSystem(
    modeller.topology, nonbondedMethod=PME, nonbondedCutoff=0.7 * nanometer, constraints=HBonds
)
integrator = LangevinMiddleIntegrator(300 * kelvin, 1 / picosecond, 2 * femtosecond)
simulation = Simulation(modeller.topology, system, integrator)
simulation.context.setPositions(modeller.positions)
simulation.minimizeEnergy(maxIterations=60)
simulation.reporters.append(PDBReporter("output.pdb", 20))
simulation.reporters.append(StateDataReporter(stdout, 10, step=True, potentialEnergy=True, temperature=True))
simulation.step(40)
