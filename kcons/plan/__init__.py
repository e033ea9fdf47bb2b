"""Which solver holds which rows.

- `clusters`: rows that belong together, and the shape of each cluster
- `independent_blocks`: pieces of a cluster whose ranks add up
- `rank`: the number of independent rows
- `second_order`: rows that are singular only at second order
- `plan`: the clusters, and the table that picks the solver of each
"""

from kcons.plan.plan import DistanceClusters, Plan, make_plan

__all__ = ["DistanceClusters", "Plan", "make_plan"]
