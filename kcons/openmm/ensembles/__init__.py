"""Ensembles for the integrators: a new one is a module, and a name here.

- `conserved_momenta`: momenta that a thermostat leaves alone
- `langevin_ensemble`: Langevin dynamics, also with several time steps
- `isokinetic_ensemble`: constant kinetic energy
- `spheres_ensemble`: isokinetic spheres of molecules
- `nose_hoover_ensemble`: Nosé-Hoover chains
- `monte_carlo_sampler`: Monte Carlo without any error of the time step
"""

from kcons.openmm.ensembles.isokinetic_ensemble import Isokinetic
from kcons.openmm.ensembles.langevin_ensemble import Langevin, LangevinRespa
from kcons.openmm.ensembles.monte_carlo_sampler import HamiltonianMonteCarlo
from kcons.openmm.ensembles.nose_hoover_ensemble import NoseHoover, NoseHooverMiddle
from kcons.openmm.ensembles.spheres_ensemble import IsokineticSpheres

__all__ = [
    "HamiltonianMonteCarlo",
    "Isokinetic",
    "IsokineticSpheres",
    "Langevin",
    "LangevinRespa",
    "NoseHoover",
    "NoseHooverMiddle",
]
