"""Ensembles for the integrators.

- `conserved_momenta`: momenta that a thermostat leaves alone
- `langevin_ensemble`: Langevin dynamics, also with several time steps
- `isokinetic_ensemble`: constant kinetic energy
- `spheres_ensemble`: isokinetic spheres of molecules
- `nose_hoover_ensemble`: Nosé-Hoover chains
- `monte_carlo_sampler`: Monte Carlo without any error of the time step
"""
