"""Clusters of any connectivity, by sparse elimination of A M^-1 A^T.

- `elimination`: order and pattern, found once
- `substitution`: the sweeps over one cluster, and the steps of Newton's method
- `row_functions`: rows that are called by their addresses, alone or many at once
- `row_values`: values and gradients of compiled rows
- `distances`: held distances
- `mixed_rows`: rows of mixed kinds
"""
