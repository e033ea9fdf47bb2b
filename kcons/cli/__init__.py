"""The command `kcons`.

- `terminal`, `progress`: what is written to the terminal
- `parser`: what is said of names that are not known
- `check`, `completion`, `doctor`, `freeenergy`, `scan`, `warmup`: the commands of these names
- `compiled_systems`: what `kcons warmup` runs
- `listing`: what `--list` prints
- `long_steps`: `kcons compare --slow --fast`
- `main`: all others
"""
