"""Constraint objects of kcons in OpenMM, held by callbacks on the CPU.

- `callbacks`: the functions that OpenMM calls, and the engine behind them
- `carried_constraints`: the part of an integrator that holds the rows
- `hold`: constraints taken out of a System and carried
"""
