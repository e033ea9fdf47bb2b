"""Peptide in implicit solvent (GBn2), a state saved and loaded, XTC."""

from sys import stdout

from openmm import LangevinMiddleIntegrator
from openmm.app import ForceField, HBonds, PDBFile, Simulation, StateDataReporter, XTCReporter
from openmm.unit import kelvin, picosecond, picoseconds

pdb = PDBFile("alanine-dipeptide-implicit.pdb")
forcefield = ForceField("amber14-all.xml", "implicit/gbn2.xml")
system = forcefield.createSystem(pdb.topology, constraints=HBonds)
integrator = LangevinMiddleIntegrator(300 * kelvin, 1 / picosecond, 0.002 * picoseconds)
simulation = Simulation(pdb.topology, system, integrator)
simulation.context.setPositions(pdb.positions)
simulation.minimizeEnergy(maxIterations=60)
simulation.context.setVelocitiesToTemperature(300 * kelvin, 1)
simulation.reporters.append(XTCReporter("output.xtc", 10))
simulation.reporters.append(StateDataReporter(stdout, 10, step=True, potentialEnergy=True, temperature=True))
simulation.step(30)
simulation.saveState("state.xml")
simulation.loadState("state.xml")
simulation.step(10)
