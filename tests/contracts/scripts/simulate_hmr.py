"""Peptide in explicit solvent, heavy hydrogen, steps of 4 fs."""

from sys import stdout

from openmm import LangevinMiddleIntegrator, Vec3
from openmm.app import PME, AllBonds, ForceField, Modeller, PDBFile, Simulation, StateDataReporter
from openmm.unit import amu, femtoseconds, kelvin, nanometer, picosecond

pdb = PDBFile("alanine-dipeptide-implicit.pdb")
forcefield = ForceField("amber14-all.xml", "amber14/tip3pfb.xml")
modeller = Modeller(pdb.topology, pdb.positions)
modeller.addSolvent(forcefield, boxSize=Vec3(1.6, 1.6, 1.6))
system = forcefield.createSystem(
    modeller.topology,
    nonbondedMethod=PME,
    nonbondedCutoff=0.7 * nanometer,
    constraints=AllBonds,
    hydrogenMass=1.5 * amu,
)
integrator = LangevinMiddleIntegrator(300 * kelvin, 1 / picosecond, 4 * femtoseconds)
simulation = Simulation(modeller.topology, system, integrator)
simulation.context.setPositions(modeller.positions)
simulation.minimizeEnergy(maxIterations=60)
simulation.context.setVelocitiesToTemperature(300 * kelvin, 1)
simulation.reporters.append(StateDataReporter(stdout, 10, step=True, potentialEnergy=True, temperature=True))
simulation.step(40)
