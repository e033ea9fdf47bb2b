"""Collective coordinates held on OpenMM's own platforms.

- `coordinates`: Forces as coordinates
- `row_program`: the part of the program that holds them
- `collective_rows`: `CollectiveRows`, what users make, and the rows at the state of a Context
"""

from kcons.openmm.collective.collective_rows import CollectiveRows

__all__ = ["CollectiveRows"]
