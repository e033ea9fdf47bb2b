"""Which solver holds which rows.

- `clusters`: rows that belong together, the shape of each cluster, clusters of equal rows and an order in which the
  rows of one are eliminated, pieces of a cluster whose ranks add up
- `second_order`: rows that are singular only at second order, converted
- `plan`: the clusters of a set, with their ranks and a solver each, and the table which solver serves which shape
"""

from kcons.plan.plan import Plan, make_plan

__all__ = ["Plan", "make_plan"]
