"""Constraints of the core carried into OpenMM by callbacks on the CPU.

- `requirements`: what a Context must offer
- `passage`: what becomes of positions and corrections on their way
- `callbacks`: the functions that OpenMM calls
- `carried_program`: where in a step they are called
- `carried_constraints`: the part of an integrator that holds them
- `hold`: constraints taken out of a System and carried
"""
