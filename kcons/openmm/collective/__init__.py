"""Collective coordinates held on OpenMM's own platforms.

- `small_algebra`: small systems of equations in the language of CustomIntegrator
- `forecast`: pushes that are foreseen
- `clock`: the time of targets that move
- `row_forces`: values and gradients of rows by OpenMM's forces
- `formula_rows`: formulas as forces
- `plain_rows`: rows that are internal coordinates, as constraints of kcons
- `measured_rows`, `context_rows`: the rows in a Context, and what can be done to them
- `row_program`: the part of the program that holds them
- `reported_rows`: what they report, and why a step failed
- `collective_rows`: `CollectiveRows`, what users make
"""

from kcons.openmm.collective.collective_rows import CollectiveRows

__all__ = ["CollectiveRows"]
