"""Ensembles for the integrators.

- `conserved_momenta`: momenta that a thermostat leaves alone
- `langevin`: Langevin dynamics
- `isokinetic`: constant kinetic energy
"""
