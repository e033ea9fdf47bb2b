"""The integrators for OpenMM, and the programs they run.

- `program`: ensembles, and the programs of steps
- `part`: what else is held, and how precisely a platform can hold it
- `guard`: what an integrator looks at in its System and its Context, and the way back
- `projected`: `ProjectedIntegrator`
"""
