"""Clusters of any connectivity, by sparse elimination of A M^-1 A^T.

- `elimination`: order and pattern, found once
- `substitution`: the sweeps over one cluster
- `step_control`: what the loops of Newton's method share
- `rows_at_once`: functions of many rows at once
- `row_functions`: rows that are called by their addresses
- `row_values`: values and gradients of compiled rows
- `distances`: held distances
- `mixed_rows`: rows of mixed kinds
"""
