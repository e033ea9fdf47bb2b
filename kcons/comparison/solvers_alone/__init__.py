"""Constraint solvers without an integrator around them.

- `bare_systems`: molecules without forces
- `bare_solvers`: kcons' engine and those of others on one task
- `solver_precision`: residual against time
- `scaling`: cost and memory against size
"""
