"""Which method, and which step? Measured on test systems and on the user's own.

- `study`: pages, machines and progress of all studies
- `scenes`: the test systems
- `methods`: everything that runs them
- `work_precision`: cost against error, and what follows from it
- `averages`: thermostats and the averages they give
- `solvers_alone`: constraint solvers without dynamics
- `hard_cases`, `stability`: where constraints are difficult, and how far steps can be pushed
"""
