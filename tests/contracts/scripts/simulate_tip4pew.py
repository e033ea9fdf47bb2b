"""TIP4P-Ew water, whose charges sit on virtual sites; PME."""

from sys import stdout

from openmm import Vec3, VerletIntegrator
from openmm.app import PME, ForceField, Modeller, Simulation, StateDataReporter, Topology
from openmm.unit import femtoseconds, kelvin, nanometer

forcefield = ForceField("tip4pew.xml")
modeller = Modeller(Topology(), [])
modeller.addSolvent(forcefield, model="tip4pew", boxSize=Vec3(1.6, 1.6, 1.6))
system = forcefield.createSystem(modeller.topology, nonbondedMethod=PME, nonbondedCutoff=0.7 * nanometer)
integrator = VerletIntegrator(2 * femtoseconds)
simulation = Simulation(modeller.topology, system, integrator)
simulation.context.setPositions(modeller.positions)
simulation.minimizeEnergy(maxIterations=60)
simulation.context.setVelocitiesToTemperature(300 * kelvin, 1)
simulation.reporters.append(StateDataReporter(stdout, 10, step=True, totalEnergy=True, temperature=True))
simulation.step(40)
