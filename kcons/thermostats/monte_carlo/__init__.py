"""Monte Carlo on constraints: averages without any error of the time step.

- `hamiltonian_monte_carlo`: proposals by dynamics, accepted or rejected
- `tuning`: the time step for a wanted share of accepted proposals
- `replica_exchange`: configurations exchanged between temperatures
"""
