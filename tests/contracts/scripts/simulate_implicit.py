"""Peptide in implicit solvent (OBC), constant energy, restarted from a checkpoint."""

from sys import stdout

from openmm import VerletIntegrator
from openmm.app import CheckpointReporter, DCDReporter, ForceField, HBonds, PDBFile, Simulation, StateDataReporter
from openmm.unit import kelvin, picoseconds

pdb = PDBFile("alanine-dipeptide-implicit.pdb")
forcefield = ForceField("amber14-all.xml", "implicit/obc2.xml")
system = forcefield.createSystem(pdb.topology, constraints=HBonds)
integrator = VerletIntegrator(0.002 * picoseconds)
simulation = Simulation(pdb.topology, system, integrator)
simulation.context.setPositions(pdb.positions)
simulation.minimizeEnergy(maxIterations=60)
simulation.context.setVelocitiesToTemperature(300 * kelvin, 1)
simulation.reporters.append(DCDReporter("output.dcd", 10))
simulation.reporters.append(CheckpointReporter("restart.chk", 20))
simulation.reporters.append(StateDataReporter(stdout, 10, step=True, totalEnergy=True, temperature=True))
simulation.step(30)
simulation.loadCheckpoint("restart.chk")
simulation.step(20)
