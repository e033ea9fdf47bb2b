"""Water at constant temperature and pressure."""

from sys import stdout

from openmm import LangevinMiddleIntegrator, MonteCarloBarostat, Vec3
from openmm.app import PME, ForceField, Modeller, Simulation, StateDataReporter, Topology
from openmm.unit import bar, femtoseconds, kelvin, nanometer, picosecond

forcefield = ForceField("amber14/tip3pfb.xml")
modeller = Modeller(Topology(), [])
modeller.addSolvent(forcefield, boxSize=Vec3(1.8, 1.8, 1.8))
system = forcefield.createSystem(modeller.topology, nonbondedMethod=PME, nonbondedCutoff=0.7 * nanometer)
system.addForce(MonteCarloBarostat(1 * bar, 300 * kelvin, 2))
integrator = LangevinMiddleIntegrator(300 * kelvin, 1 / picosecond, 2 * femtoseconds)
simulation = Simulation(modeller.topology, system, integrator)
simulation.context.setPositions(modeller.positions)
simulation.minimizeEnergy(maxIterations=60)
simulation.context.setVelocitiesToTemperature(300 * kelvin, 1)
simulation.reporters.append(StateDataReporter(stdout, 10, step=True, temperature=True, volume=True, density=True))
simulation.step(40)
