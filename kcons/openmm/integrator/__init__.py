"""The integrators for OpenMM, and the programs they run.

- `program`, `schemes`: a program for CustomIntegrator, and the splittings
- `part`, `interface`, `ensemble`: what an integrator is put together from
- `step_variables`, `step_writer`, `lean_step_writer`, `step_counts`: the program of one step, and what it costs
- `precision`, `system_checks`, `guard`: what a platform can hold, what a System holds, and whether it was held
- `states`: a Context, its states, and what is told to them
- `projected`, `rattle_integrator`: `ProjectedIntegrator` and `RattleIntegrator`
"""
