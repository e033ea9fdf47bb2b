"""The command `kcons`.

- `terminal`: what is written to the terminal
- `parser`: the table of options of a command
- `systems`: the test system or file that a command is asked for, and `kcons plan`
- `check`, `compare`, `doctor`, `freeenergy`, `scan`, `warmup`: the commands of these names
- `compiled_systems`: what `kcons warmup` runs
- `main`: the command itself
"""
