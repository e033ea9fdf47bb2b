"""Everything that can run a test system.

- `method`: the contract of a method, and a run
- `engines`: one adapter for each MD engine
- `methods`: steppers of kcons, ASE's dynamics, SciPy
- `openmm`: integrators of OpenMM and of kcons in it
- `peers`: solvers and integrators of others
- `snippets`: the lines of code that run a method
"""
