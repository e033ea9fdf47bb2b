"""The command `kcons`.

- `terminal`, `progress`: what is written to the terminal
- `check`, `scan`, `studies`, `warmup`: `kcons check`, `scan`, `hardcases`, `stability`, `warmup`
- `main`: all others
"""
