"""Which solver holds which rows.

- `clusters`: rows that belong together, and the shape of each cluster
- `clusters_alike`: clusters of equal rows, and an order in which the rows of one are eliminated
- `independent_blocks`: pieces of a cluster whose ranks add up
- `second_order`: rows that are singular only at second order, converted
- `plan`: the clusters of a set, with their ranks and a solver each, and the table which solver serves which shape
"""

from kcons.plan.plan import Plan, make_plan

__all__ = ["Plan", "make_plan"]
