"""Collective coordinates held on OpenMM's own platforms.

- `coordinates`: Forces as coordinates
- `row_program`: the part of the program that holds them
- `rows_in_context`: the rows at the state of a Context, and what can be done to them
- `collective_rows`: `CollectiveRows`, what users make
"""

from kcons.openmm.collective.collective_rows import CollectiveRows

__all__ = ["CollectiveRows"]
