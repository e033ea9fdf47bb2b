"""Collective coordinates held on OpenMM's own platforms.

- `coordinates`: Forces as coordinates
- `collective_rows`: `CollectiveRows`, the program that holds them, and the rows at the state of a Context
"""
