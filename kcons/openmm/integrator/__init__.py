"""The integrators for OpenMM, and the programs they run.

- `program`, `schemes`: a program as plain data, and the splittings
- `ensemble`: a step, and what an ensemble puts into it
- `steps`: the programs of the kinds of step
- `part`, `precision`, `system_checks`: what else is held, what a platform can hold, and what a System holds
- `guard`: what an integrator looks at in its Context, and the way back
- `minimization`: minima on the constraints
- `projected`: `ProjectedIntegrator`
"""
