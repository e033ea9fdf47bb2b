"""The command `kcons`.

- `terminal`: the table of options of a command, and what is written to the terminal
- `compare`: `kcons compare` and `kcons plan`, of test systems and files
- `check`: `kcons check`, of trajectories
- `free_energy`: `kcons scan` and `kcons freeenergy`
- `machine`: `kcons doctor` and `kcons warmup`
- `main`: the command itself
"""
