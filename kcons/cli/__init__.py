"""The command `kcons`.

- `terminal`, `progress`: what is written to the terminal
- `parser`: what is said of names that are not known
- `systems`: the test system or file that a command is asked for
- `check`, `compare`, `doctor`, `freeenergy`, `plan`, `scan`, `warmup`: the commands of these names
- `compiled_systems`: what `kcons warmup` runs
- `listing`: what `--list` prints
- `main`: the command itself
"""
