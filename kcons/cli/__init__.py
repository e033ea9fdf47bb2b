"""The command `kcons`.

- `terminal`, `progress`: what is written to the terminal
- `check`, `studies`: `kcons check`, `kcons hardcases`, `kcons stability`
- `main`: all others
"""
