"""The command `kcons`.

- `terminal`, `progress`: what is written to the terminal
- `check`, `freeenergy`, `scan`, `warmup`: the commands of these names
- `studies`: `kcons hardcases`, `kcons stability`
- `main`: all others
"""
