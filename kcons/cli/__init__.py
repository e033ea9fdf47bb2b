"""The command `kcons`.

- `terminal`, `progress`: what is written to the terminal
- `check`, `studies`, `warmup`: `kcons check`, `kcons hardcases`, `kcons stability`, `kcons warmup`
- `main`: all others
"""
