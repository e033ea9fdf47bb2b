"""A Context, its states, and what is told to them.

- `settings`: what an integrator was made with, and may be told later
- `calls`: calls of `step`, and what they put off
- `hearing`: States, checkpoints and files that a Context loads
- `copies`, `serialization`: copies and pickles; XML and CompoundIntegrators
- `minimization`: the energy minimised on the constraints
- `states_on_constraints`: states on the constraints, with velocities of a temperature
- `outside_of_steps`: constraints applied outside of steps
"""
