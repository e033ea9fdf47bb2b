"""Constraint objects of kcons in OpenMM, held by callbacks on the CPU.

- `carried_constraints`: the part of an integrator that holds the rows, and the functions that OpenMM calls
- `hold`: constraints taken out of a System and carried
"""
